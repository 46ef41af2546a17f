"""Arguments of public functions that are of another kind, shape or value."""

import math

import numpy as np
import torch

import zsp_lite
from tests.hostile.harness import case
from zsp_lite.data.cameras import Camera
from zsp_lite.data.depth import inpaint_depth, unproject_depth
from zsp_lite.data.frames import Frame, crop_frame, mask_to_bbox, resize_frame
from zsp_lite.features import FeatureMap, log_bin
from zsp_lite.io.ply import write_ply

RNG = np.random.default_rng(0)
POINTS = RNG.normal(size=(20, 3))
CAMERA = Camera(np.eye(3), np.zeros(3), np.full(2, 30.0), np.full(2, 8.0), (16, 16))
ARRAYS = {
    "complex numbers": POINTS.astype(complex), "texts": POINTS.astype(str), "objects": np.array([[{}] * 3] * 20),
    "ragged lists": [[1, 2, 3], [1, 2]], "null": None, "a number": 5, "a text": "points", "not a number": POINTS * math.nan,
    "infinite": POINTS * math.inf, "1e155": POINTS * 1e155, "1e308": np.full((20, 3), 1e308), "two columns": POINTS[:, :2],
    "empty": POINTS[:0], "one point": POINTS[:1], "a line": np.outer(np.arange(20), [1, 1, 1]), "equal points": np.ones((20, 3)),
    "a set": {1, 2}, "a dictionary": {"a": 1},
}  # fmt: skip
for name, value in ARRAYS.items():
    case("API", f"umeyama of {name}", lambda _, value=value: zsp_lite.alignment.umeyama(value, value))
    case("API", f"ransac of {name}", lambda _, value=value: zsp_lite.alignment.ransac(value, value))
for options in ({"trials": 1.5}, {"trials": 0}, {"trials": 10**12}, {"trials": "5"}, {"threshold": math.nan}, {"threshold": "1"},
                {"threshold": None}, {"sample_size": 100}, {"sample_size": 2}, {"seed": -1}, {"seed": 1.5}, {"seed": "a"},
                {"scale_range": (5, 1)}, {"scale_range": (math.nan, 1)}, {"scale_range": "ab"}, {"scale_range": 1}):  # fmt: skip
    case("API", f"ransac with {options}", lambda _, o=options: zsp_lite.alignment.ransac(POINTS, POINTS + 1, **o))
ROTATIONS = {
    "not a number": np.full((3, 3), math.nan), "zeros": np.zeros((3, 3)), "mirrored": np.diag([1, 1, -1.0]),
    "two rows": np.eye(3)[:2], "complex": np.eye(3) * 1j, "texts": np.eye(3).astype(str), "null": None, "1e200": 1e200 * np.eye(3),
}  # fmt: skip
for name, value in ROTATIONS.items():
    case("API", f"rotation error of {name}", lambda _, value=value: zsp_lite.metrics.rotation_error(value, np.eye(3)))
    case("API", f"Sim3 of {name}", lambda _, value=value: zsp_lite.alignment.Sim3(1.0, value, np.zeros(3)))
    case("API", f"camera of {name}", lambda _, value=value: Camera(value, np.zeros(3), np.ones(2), np.ones(2), (9, 9)))
for scale in (0, -1, math.nan, math.inf, "1", None, 1j):
    case("API", f"Sim3 of scale {scale!r}", lambda _, s=scale: zsp_lite.alignment.Sim3(s, np.eye(3), np.zeros(3)))
for size in ((0, 5), (-1, 5), (5,), "ab", None, (math.nan, 5), (1.5, 5), (10**30, 5)):
    case("API", f"camera of size {size!r}", lambda _, s=size: Camera(np.eye(3), np.zeros(3), np.ones(2), np.ones(2), s))
ERRORS = {"negative": [-5.0], "above 180": [1e6], "not a number": [math.nan], "texts": ["a"], "complex": [1j], "empty": [],
          "null": None}  # fmt: skip
for name, value in ERRORS.items():
    case("API", f"summary of errors: {name}", lambda _, value=value: zsp_lite.metrics.summarise(value))
    case("API", f"median of errors: {name}", lambda _, value=value: zsp_lite.metrics.median(value))
KEYS = {
    "not a number": torch.full((4, 4, 8), math.nan), "infinite": torch.full((4, 4, 8), math.inf), "complex": torch.zeros(4, 4, 8) * 1j,
    "two axes": torch.zeros(4, 8), "empty": torch.zeros(0, 4, 8), "integers": torch.ones(4, 4, 8, dtype=torch.int64),
    "texts": np.full((4, 4, 8), "a"), "null": None,
}  # fmt: skip
GOOD = torch.rand(4, 4, 8)
for name, value in KEYS.items():
    case("API", f"similarity of keys: {name}", lambda _, value=value: zsp_lite.matching.similarity(value, GOOD),
         answers=name == "integers")  # fmt: skip
    case(
        "API", f"feature map of keys: {name}", lambda _, value=value: FeatureMap(value, torch.ones(4, 4), torch.ones(8))
    )
    case("API", f"binning of keys: {name}", lambda _, value=value: log_bin(None if value is None else value[None]),
         answers=name == "integers")  # fmt: skip
case(
    "API",
    "feature map whose global feature is not a number",
    lambda _: FeatureMap(GOOD, torch.ones(4, 4), torch.full((8,), math.nan)),
)
SIMILARITIES = {
    "not a number": torch.full((16, 16), math.nan), "infinite": torch.full((16, 16), math.inf), "null": None, "texts": np.full((16, 16), "a"),
    "another shape": torch.zeros(15, 16), "three axes": torch.zeros(1, 16, 16), "complex": torch.zeros(16, 16) * 1j,
}  # fmt: skip
for name, value in SIMILARITIES.items():
    case(
        "API",
        f"cyclical distances of {name}",
        lambda _, v=value: zsp_lite.matching.cyclical_distances(v, (4, 4), (4, 4)),
    )
for grid in ((0, 0), (4,), (-4, -4), "ab", None, (2.5, 4)):
    case(
        "API",
        f"cyclical distances of grid {grid!r}",
        lambda _, g=grid: zsp_lite.matching.cyclical_distances(torch.zeros(16, 16), g, (4, 4)),
    )
RGB, DEPTH = np.zeros((16, 16, 3), np.uint8), np.ones((16, 16), np.float32)
for name, arguments in {
    "colours of floats": (RGB.astype(float), DEPTH, DEPTH), "colours without channels": (DEPTH, DEPTH, DEPTH), "no colours": (None, DEPTH, DEPTH),
    "negative depth": (RGB, -DEPTH, DEPTH), "depth not a number": (RGB, DEPTH * math.nan, DEPTH), "depth of texts": (RGB, DEPTH.astype(str) + "x", DEPTH),
    "depth of 1e30": (RGB, DEPTH * 1e30, DEPTH), "mask above 1": (RGB, DEPTH, 2 * DEPTH), "mask of another size": (RGB, DEPTH, DEPTH[:5]),
    "complex depth": (RGB, DEPTH * 1j, DEPTH), "ragged depth": (RGB, [[1], [1, 2]], DEPTH),
}.items():  # fmt: skip
    case("API", f"frame with {name}", lambda _, a=arguments: Frame(*a, CAMERA))
FRAME = Frame(RGB, DEPTH, DEPTH, CAMERA)
for box in ((0, 0, 0, 0), (0, 0, 99, 99), (-1, 0, 5, 5), (0.5, 0, 5, 5), "abcd", None, (0, 0, 5), (math.nan, 0, 5, 5)):
    case("API", f"crop to {box!r}", lambda _, box=box: crop_frame(FRAME, box))
for size in ((0, 5), (-1, 5), (10**6, 10**6), "ab", (2.5, 3)):
    case("API", f"resize to {size!r}", lambda _, size=size: resize_frame(FRAME, size))
for threshold in (-1, 2, math.nan, "a", None):
    case("API", f"box of a mask above {threshold!r}", lambda _, t=threshold: mask_to_bbox(DEPTH, t))
for name, value in {
    "empty": DEPTH[:0],
    "zeros": 0 * DEPTH,
    "texts": DEPTH.astype(str),
    "complex": DEPTH * 1j,
    "null": None,
    "one axis": DEPTH[0],
}.items():
    case("API", f"box of a mask: {name}", lambda _, value=value: mask_to_bbox(value))
    case("API", f"in-painting of depth: {name}", lambda _, value=value: inpaint_depth(value))
    case(
        "API",
        f"points of depth: {name}",
        lambda _, value=value: unproject_depth(value, CAMERA),
        answers=name == "zeros",  # unknown depth
    )
for name, value in {"nothing": [], "null": [None], "texts": ["a"], "a number": 5, "grey": [DEPTH], "float of 255": [255.0 * np.ones((9, 9, 3))],
                    "complex": [RGB * 1j], "not a number": [np.full((9, 9, 3), math.nan)]}.items():  # fmt: skip
    case(
        "API",
        f"backbone on {name}",
        lambda _, value=value: zsp_lite.load_backbone("zsp-tiny", "cpu")(value),
        answers=name == "nothing",
    )
for name in (
    "\0",
    "",
    "x" * 10_000,
    "hf:",
    "hf:\0",
    "../../etc/passwd",
    "/dev/zero",
    "\udcff",
    5,
    None,
    b"zsp-tiny",
    ["zsp-tiny"],
):
    case("API", f"backbone named {str(name)[:20]!r}", lambda _, name=name: zsp_lite.load_backbone(name))
for k in (0, -1, 1.5, "5", None, True):
    case("API", f"k = {k!r}", lambda _, k=k: zsp_lite.ZeroShotPose(None, k=k), says="k is")
case("API", "no backbone", lambda _: zsp_lite.ZeroShotPose(None).estimate(FRAME, [FRAME]), says="backbone is None")
for arguments in ((None, [FRAME]), (FRAME, []), (FRAME, None), (FRAME, [None]), (FRAME, FRAME), ("a", ["b"])):
    case(
        "API",
        f"estimate {[type(a).__name__ for a in arguments]}",
        lambda _, a=arguments: zsp_lite.ZeroShotPose(zsp_lite.load_backbone("zsp-tiny", "cpu")).estimate(*a),
    )
for points in (POINTS[:, :2], POINTS * math.nan, POINTS.astype(complex), POINTS.astype(str), None):
    case(
        "API",
        f"write_ply {getattr(points, 'dtype', None)} {np.shape(points)}",
        lambda folder, p=points: write_ply(folder / "x.ply", p, np.zeros((20, 3), np.uint8)),
    )

for options in ({"solver": ["paper"]}, {"out": 3}, {"intrinsics": (1, 2, 3)}, {"intrinsics": "abcd"}, {"intrinsics": 5},
                {"reference_frame": "a"}, {"targets": "3"}, {"mask": ["auto"]}, {"backbone": 3}):  # fmt: skip
    case("API", f"estimate_pose with {options}",
         lambda folder, o=options: zsp_lite.estimation.estimate_pose(folder / "data/cup/a", folder / "data/cup/b", **o),
         says=next(iter(options)))  # fmt: skip
case("API", "estimate_pose of numbers", lambda _: zsp_lite.estimation.estimate_pose(3, 4), says="reference is 3")
for options in (
    {"box": (1, 2)},
    {"box": "abc"},
    {"depth": 3},
    {"intrinsics": "abcd"},
    {"mask": 1},
    {"depth_unit": "m"},
):
    case("API", f"open_source with {options}",
         lambda folder, o=options: zsp_lite.sources.open_source(folder / "data/cup/a", **o),
         says=next(iter(options)))  # fmt: skip
for positions in ([99], [-1], ["a"], 3, None):
    case("API", f"load of frames {positions!r}",
         lambda folder, p=positions: zsp_lite.sources.open_source(folder / "data/cup/a").load(p))  # fmt: skip

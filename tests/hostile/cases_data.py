"""Values that no camera, label, pair or capture can have; each is read by the library and by `data check`."""

import json
import math

import cv2
import numpy as np
import torch

from tests.hostile.harness import case, command, edit_frames, strange_files
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import read_upstream_pairs, sample_pairs, shipped_pairs
from zsp_lite.importers import READERS, import_capture

# frame annotations
FRAMES = {
    "T of 1e308": ("viewpoint", "T", [1e308, 0, 0]),
    "T of 1e155": ("viewpoint", "T", [1e155, 1e155, 0]),
    "T infinite": ("viewpoint", "T", [math.inf, 0, 0]),
    "T of two numbers": ("viewpoint", "T", [0, 0]),
    "T of texts": ("viewpoint", "T", ["0", "0", "0"]),
    "R of zeros": ("viewpoint", "R", np.zeros((3, 3)).tolist()),
    "R of 1e200": ("viewpoint", "R", (1e200 * np.eye(3)).tolist()),
    "R mirrored": ("viewpoint", "R", np.diag([1, 1, -1]).tolist()),
    "focal length of 1e-300": ("viewpoint", "focal_length", [1e-300, 1e-300]),
    "focal length of 1e300": ("viewpoint", "focal_length", [1e300, 1e300]),
    "focal length negative": ("viewpoint", "focal_length", [-1, 1]),
    "focal length not a number": ("viewpoint", "focal_length", [math.nan, 1]),
    "principal point of 1e300": ("viewpoint", "principal_point", [1e300, 0]),
    "unknown intrinsics": ("viewpoint", "intrinsics_format", "[red]$x_$"),
    "size negative": ("image", "size", [-24, 32]),
    "size of 10^30": ("image", "size", [10**30, 10**30]),
    "another size": ("image", "size", [25, 32]),
    "path out of the folder": ("image", "path", "../../../etc/passwd"),
    "absolute path": ("image", "path", "/etc/passwd"),
    "path with a null byte": ("image", "path", "cup/a\0.jpg"),
    "path of 100,000 characters": ("image", "path", "x/" * 50_000),
    "path that is a number": ("image", "path", 5),
    "path of another kind of file": ("image", "path", "cup/frame_annotations.jgz"),
    "depth scale of 1e300": ("depth", "scale_adjustment", 1e300),
    "depth scale negative": ("depth", "scale_adjustment", -1.0),
    "depth scale 0": ("depth", "scale_adjustment", 0.0),
    "depth scale not a number": ("depth", "scale_adjustment", math.nan),
    "depth path of a JPEG": ("depth", "path", "cup/a/images/frame000001.jpg"),
    "mask path of a point cloud": ("mask", "path", "cup/a/pointcloud.ply"),
}


def _damage(part, name, value):
    def change(entries):
        for entry in entries:
            entry[part][name] = value

    return lambda folder: edit_frames(folder, change)


def _load(folder):
    data = Co3D(folder / "data")
    return data.load(data.frames("cup", "a")[0])


for name, change in FRAMES.items():
    case("camera", name, lambda folder, change=change: (_damage(*change)(folder), _load(folder))[1])
    command("data check", name, "data", "check", "ROOT/data", "--deep", change=_damage(*change), codes=(1,))

# labels
EYE = np.eye(4).tolist()
_SCALED, _FAR, _MIRRORED = np.diag([2.0, 2, 2, 1]), np.eye(4), np.diag([1.0, 1, -1, 1])
_FAR[0, 3] = 1e300
LABELS = {
    "two references": {"trans": EYE, "seq": "b", "reference_seq": "b"},
    "scaled": {"trans": _SCALED.tolist(), "seq": "b", "reference_seq": "a"},
    "mirrored": {"trans": _MIRRORED.tolist(), "seq": "b", "reference_seq": "a"},
    "translation of 1e300": {"trans": _FAR.tolist(), "seq": "b", "reference_seq": "a"},
    "of 3 x 3": {"trans": np.eye(3).tolist(), "seq": "b", "reference_seq": "a"},
    "of texts": {"trans": [["1"] * 4] * 4, "seq": "b", "reference_seq": "a"},
    "of null": {"trans": None, "seq": "b", "reference_seq": "a"},
    "of another sequence": {"trans": EYE, "seq": "c", "reference_seq": "a"},
    "without a reference": {"trans": EYE, "seq": "b"},
    "a list": [],
    "not a number": {"trans": (np.eye(4) * math.nan).tolist(), "seq": "b", "reference_seq": "a"},
}


def _label(content):
    return lambda folder: (folder / "data/class_labels/cup/b.json").write_text(json.dumps(content))


for name, content in LABELS.items():
    case(
        "label", name, lambda folder, content=content: (_label(content)(folder), read_labels(folder / "data", "cup"))[1]
    )
    command("data check", f"label {name}", "data", "check", "ROOT/data", change=_label(content), codes=(1,))
    command("options", f"benchmark with a label {name}", "benchmark", "--data", "ROOT/data", "--pairs", "2",
            "--targets", "2", "--methods", "icp", "--out", "ROOT/out", change=_label(content))  # fmt: skip
for name, write in strange_files().items():
    if name != "missing":
        case("file", f"label: {name}", lambda folder, write=write: (
            write(folder / "data/class_labels/cup/b.json"), read_labels(folder / "data", "cup"))[1])  # fmt: skip

# pairs of the published code
PAIR = {
    "class": "cup",
    "reference_seq_name": "a",
    "reference_frame_id": 0,
    "target_seq_name": "b",
    "all_target_id": [6, 7],
}
_BOMB: list = []
for _ in range(40):
    _BOMB = [_BOMB, _BOMB]
PAIRS = {
    "of a sequence with itself": PAIR | {"target_seq_name": "a", "all_target_id": [1, 2]},
    "of another number of targets": PAIR | {"all_target_id": [6, 7, 8]},
    "of another category": PAIR | {"class": "../cup"},
    "of a category that is a list": PAIR | {"class": ["cup"]},
    "with a negative id": PAIR | {"reference_frame_id": -1},
    "with an id of 10^30": PAIR | {"reference_frame_id": 10**30},
    "with a fractional id": PAIR | {"reference_frame_id": 0.5},
    "with a truth value": PAIR | {"reference_frame_id": True},
    "with ids of another sequence": PAIR | {"all_target_id": [1, 2]},
    "without targets": PAIR | {"all_target_id": []},
    "with a text for targets": PAIR | {"all_target_id": "67"},
    "with 2^40 nested lists": PAIR | {"all_target_id": _BOMB},
    "with a giant tensor of stride 0": PAIR | {"all_target_id": torch.zeros(1).expand(10**11)},
    "with a sequence that is null": PAIR | {"target_seq_name": None},
    "of 1e6 targets": PAIR | {"all_target_id": [6] * 10**6},
}


def _set(item):
    def write(folder):
        path = folder / "data/determ_eval/1samples_2tgt/cup.pt"
        path.parent.mkdir(parents=True)
        torch.save([item], path)

    return write


for name, item in PAIRS.items():
    case(
        "pairs", name, lambda folder, item=item: (_set(item)(folder), shipped_pairs(Co3D(folder / "data"), "cup", 2))[1]
    )
    command("data check", f"pairs {name}", "data", "check", "ROOT/data", change=_set(item), codes=(1,))
for name, write in strange_files().items():
    case("file", f"pairs: {name}", lambda folder, write=write: (
        write(folder / "x.pt"), read_upstream_pairs(folder / "x.pt", Co3D(folder / "data")))[1])  # fmt: skip
for values in ((10**8, 2), (1, 10**9), (1.5, 2), (1, "2"), (True, 1)):
    case("pairs", f"sample {values}", lambda folder, values=values: sample_pairs(Co3D(folder / "data"), "cup", *values))


# captures
def _capture(folder, layout):
    """Write a capture of one frame."""
    root = folder / "capture"
    for part in ("rgb", "depth"):
        (root / part).mkdir(parents=True)
    cv2.imwrite(str(root / "rgb/0.png"), np.zeros((24, 32, 3), np.uint8))
    cv2.imwrite(str(root / "depth/0.png"), np.full((24, 32), 1000, np.uint16))
    if layout == "tum":
        (root / "rgb.txt").write_text("0.0 rgb/0.png\n")
        (root / "depth.txt").write_text("0.0 depth/0.png\n")
        (root / "groundtruth.txt").write_text("0.0 0 0 0 0 0 0 1\n")
    elif layout == "lists":
        (root / "rgb.txt").write_text("rgb/0.png\n")
        (root / "depth.txt").write_text("depth/0.png\n")
        (root / "poses.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
        (root / "intrinsics.txt").write_text("30 0 16\n0 30 12\n0 0 1\n")
    elif layout == "nerfstudio":
        frame = {"file_path": "rgb/0.png", "depth_file_path": "depth/0.png", "transform_matrix": EYE}
        content = {"fl_x": 30, "cx": 16, "cy": 12, "w": 32, "h": 24, "frames": [frame]}
        (root / "transforms.json").write_text(json.dumps(content))
    else:
        (root / "camera_intrinsic.json").write_text(
            json.dumps({"width": 32, "height": 24, "intrinsic_matrix": [30, 0, 0, 0, 30, 0, 16, 12, 1]})
        )
        (root / "trajectory.log").write_text("0 0 0\n" + "\n".join(" ".join(map(str, row)) for row in np.eye(4)) + "\n")
    return root


def _json(name, part=None, **values):
    def change(root):
        content = json.loads((root / name).read_text())
        (content if part is None else content["frames"][0]).update(values)
        (root / name).write_text(json.dumps(content))

    return change


def _text(name, text):
    return lambda root: (root / name).write_bytes(text.encode() if isinstance(text, str) else text)


def _link(name, target):
    return lambda root: ((root / name).unlink(), (root / name).symlink_to(target))


NERF = "transforms.json"
CAPTURES = [
    ("tum", "pose of 1e200", _text("groundtruth.txt", "0.0 1e200 0 0 0 0 0 1\n")),
    ("tum", "quaternion of 1e300", _text("groundtruth.txt", "0.0 0 0 0 1e300 0 0 1e300\n")),
    ("tum", "quaternion of zeros", _text("groundtruth.txt", "0.0 0 0 0 0 0 0 0\n")),
    ("tum", "time not a number", _text("rgb.txt", "nan rgb/0.png\n")),
    ("tum", "time of 1e308", _text("rgb.txt", "1e308 rgb/0.png\n")),
    ("tum", "path out of the folder", _text("rgb.txt", "0.0 ../../../etc/passwd\n")),
    ("tum", "null byte", _text("rgb.txt", "0.0 a\0b\n")),
    ("tum", "random bytes", _text("rgb.txt", np.random.default_rng(0).bytes(5000))),
    ("tum", "one line of 20 MB", _text("rgb.txt", "0.0 " + "x" * 20_000_000)),
    ("tum", "two million empty lines", _text("depth.txt", "\n" * 2_000_000)),
    ("tum", "link out of the folder", _link("rgb/0.png", "/etc/passwd")),
    ("tum", "list that is a link to /dev/zero", _link("rgb.txt", "/dev/zero")),
    ("lists", "pose of 1e200", _text("poses.txt", "1 0 0 1e200 0 1 0 0 0 0 1 0\n")),
    ("lists", "pose transposed", _text("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0 5 6 7 1\n")),
    ("lists", "focal length of 1e-300", _text("intrinsics.txt", "1e-300 0 16\n0 1e-300 12\n0 0 1\n")),
    ("lists", "focal length of 1e300", _text("intrinsics.txt", "1e300 0 16\n0 1e300 12\n0 0 1\n")),
    ("lists", "13 numbers", _text("poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0 1\n")),
    ("lists", "depth in objects", lambda root: (np.save(root / "depth/0.npy", np.array([[{}]]), allow_pickle=True),
                                                (root / "depth.txt").write_text("depth/0.npy\n"))),
    ("lists", "absolute path", _text("rgb.txt", "/etc/passwd\n")),
    ("nerfstudio", "focal length of 1e-300", _json(NERF, fl_x=1e-300)),
    ("nerfstudio", "width of 1e300", _json(NERF, w=1e300)),
    ("nerfstudio", "width of 10^9", _json(NERF, w=10**9, h=10**9)),
    ("nerfstudio", "width fractional", _json(NERF, w=32.5)),
    ("nerfstudio", "width not a number", _json(NERF, w=math.nan)),
    ("nerfstudio", "distortion of 1e300", _json(NERF, k1=1e300)),
    ("nerfstudio", "depth unit of 1e300", _json(NERF, depth_unit_scale_factor=1e300)),
    ("nerfstudio", "depth unit 0", _json(NERF, depth_unit_scale_factor=0)),
    ("nerfstudio", "depth unit negative", _json(NERF, depth_unit_scale_factor=-1)),
    ("nerfstudio", "pose of 1e200", _json(NERF, 0, transform_matrix=(1e200 * np.eye(4)).tolist())),
    ("nerfstudio", "pose mirrored", _json(NERF, 0, transform_matrix=np.diag([1, 1, -1, 1]).tolist())),
    ("nerfstudio", "path out of the folder", _json(NERF, 0, file_path="../../x.png")),
    ("nerfstudio", "image that is a folder", _json(NERF, 0, file_path="rgb")),
    ("nerfstudio", "100,000 levels", _text(NERF, "[" * 100_000)),
    ("nerfstudio", "no frames", _json(NERF, frames=[])),
    ("nerfstudio", "unknown camera", _json(NERF, camera_model="[/1]")),
    ("open3d", "intrinsics of 1e300", _json("camera_intrinsic.json", intrinsic_matrix=[1e300] * 9)),
    ("open3d", "8 intrinsics", _json("camera_intrinsic.json", intrinsic_matrix=[1] * 8)),
    ("open3d", "width of 10^30", _json("camera_intrinsic.json", width=10**30)),
    ("open3d", "width negative", _json("camera_intrinsic.json", width=-32)),
    ("open3d", "trajectory of texts", _text("trajectory.log", "0 0 0\n" + "a b c d\n" * 4)),
    ("open3d", "trajectory of 1e200", _text("trajectory.log", "0 0 0\n" + "1e200 0 0 1e200\n" * 4)),
    ("open3d", "image that is a link out of the folder", _link("rgb/0.png", "/etc/passwd")),
    ("open3d", "depth folder that is a link out of the folder", lambda root: (
        (root / "depth").rename(root.parent / "other"), (root / "depth").symlink_to(root.parent / "other"))),
    ("open3d", "trajectory that is a link out of the folder", _link("trajectory.log", "/etc/passwd")),
    ("nerfstudio", "distortion of 1e5", _json(NERF, k1=1e5)),
    ("nerfstudio", "depth unit of 1e8", _json(NERF, depth_unit_scale_factor=1e8)),
    ("lists", "list that is a link out of the folder", _link("rgb.txt", "/etc/passwd")),
    ("open3d", "image that is a pipe", lambda root: strange_files()["pipe"](root / "rgb/0.png")),
]  # fmt: skip


def _read(layout, change=lambda root: None):
    def call(folder):
        root = _capture(folder, layout)
        change(root)
        options = {"intrinsics": (30.0, 30.0, 16.0, 12.0)} if layout == "tum" else {}
        return [frame.load() for frame in READERS[layout](root, **options)]

    return call


for layout in READERS:
    case("capture", f"{layout}: nothing wrong", _read(layout), answers=True)
for layout, name, change in CAPTURES:
    case("capture", f"{layout}: {name}", _read(layout, change))
for box in ((0, 0, 10**9, 10**9), (-5, 0, 10, 10), (0, 0, 0, 0)):
    case("capture", f"box {box}", lambda folder, box=box: import_capture(
        READERS["lists"](_capture(folder, "lists")), folder / "data", "cup", "new", box=box), says="box")  # fmt: skip
for name in ("..", "a/b", "", "a\0b", ".hidden", "x" * 5000):
    case("capture", f"sequence named {name[:10]!r}", lambda folder, name=name: import_capture(
        READERS["lists"](_capture(folder, "lists")), folder / "data", "cup", name, box=(2, 2, 20, 20)),
        says="sequence name")  # fmt: skip

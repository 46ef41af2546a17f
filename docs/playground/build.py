"""Write what docs/playground.md loads.

    python -m docs.playground.build outputs/site/docs/playground

onnxruntime-web is fetched into the cache, from the npm registry or from the registry that
npm_config_registry names.
"""

import io
import json
import os
import sys
import tarfile
import warnings
import zlib
from base64 import b64encode
from copy import deepcopy
from pathlib import Path
from unittest.mock import MagicMock, patch

import cv2
import numpy as np
import torch
from jaxtyping import UInt8
from torch.overrides import TorchFunctionMode

from zsp_lite import Backbone, Co3D, InputError, ZeroShotPose, load_backbone
from zsp_lite.backbones.backbone import normalize
from zsp_lite.course.samples import sample_data
from zsp_lite.course.true_matches import ground_truth_matches, patch_coordinates
from zsp_lite.data.co3d import Pair
from zsp_lite.data.ground_truth import object_poses
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.io.download import fetch
from zsp_lite.io.files import cache_folder
from zsp_lite.metrics import SAME_ANGLE, rotation_error
from zsp_lite.points import near_median
from zsp_lite.views import View

# Indices of evaluation pairs with five target views: in each category the first, whatever its
# result, and the next with an error below 15 degrees.
PAIRS = {"bicycle": (0, 1), "car": (0, 6), "chair": (0, 4), "motorcycle": (0, 1)}
# Keys and points are stored as 16-bit integers in these steps. Cosines of descriptors are off by at
# most 5e-4, cosines of bare keys by at most 2e-3.
KEY_STEP = 1 / 64
POINT_STEP = 1 / 1024
GRID = (28, 28)  # rows and columns of patches
NUMBER = (28, 1)  # (row, column) @ NUMBER is the number of a patch
RUNTIME = "onnxruntime-web-1.30.0.tgz"
RUNTIME_SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"


def stored_pairs(dataset: Co3D) -> list[Pair]:
    """List the pairs of the page."""
    return [
        shipped_pairs(dataset, category, 5)[index]
        for category, indices in PAIRS.items()
        for index in indices
    ]


def pair_data(dataset: Co3D, pair: Pair, method: ZeroShotPose) -> tuple[list[dict], float]:
    """Compute what the page shows of a pair.

    Returns:
        The data of each view, the reference first, for targets with the truth and the matches; and
        the error of the method's pose in degrees.
    """
    reference, targets = dataset.load_pair(pair)
    views = method.views([reference, *targets])
    first, *others = views

    # Keys (views, patches, d) are turned to their principal axes and rounded, as (views, axes,
    # patches); on most axes they are 0 then.
    keys = np.stack([view.features.keys.flatten(0, 1).numpy() for view in views])
    axes = np.linalg.svd(np.concatenate(keys), full_matrices=False)[2]
    rounded = np.round(keys @ axes.T / KEY_STEP).astype("<i2").swapaxes(1, 2)
    rounded = rounded[:, rounded.any(axis=(0, 2))]  # without axes that are 0 everywhere
    data = [_view_data(view, view_keys) for view, view_keys in zip(views, rounded)]

    # True matches, true rotation and the method's matches of each target.
    labels = read_labels(dataset.root, pair.category)
    poses = object_poses(dataset, pair.category)
    seen = patch_coordinates(first.frame, poses[pair.reference_sequence], GRID)
    matched = method.match_views(first, others)
    for target, matched_view in zip(data[1:], matched):
        frame = matched_view.target.frame
        cells, valid = ground_truth_matches(
            seen, patch_coordinates(frame, poses[pair.target_sequence], GRID)
        )
        true = relative_pose(
            labels[pair.reference_sequence],
            first.frame.camera,
            labels[pair.target_sequence],
            frame.camera,
        )
        matches = matched_view.matches
        chosen = [matches.reference @ NUMBER, matches.target @ NUMBER]
        # The true match of each reference patch by its number, or -1.
        target["truth"] = packed(np.where(valid, cells @ NUMBER, -1).astype("<i2"))
        target["rotation"] = true[:3, :3].tolist()
        target["chosen"] = np.stack(chosen, axis=1).tolist()
    estimate = method.estimate_from_views(first, others, matched)
    return data, rotation_error(estimate.sim3.R, data[1 + estimate.view]["rotation"])


def packed(array: np.ndarray) -> str:
    """Compress the bytes of an array and encode them as text."""
    return b64encode(zlib.compress(array.tobytes())).decode()


def webp(rgb: UInt8[np.ndarray, "h w 3"]) -> str:
    """Compress an image and encode it as text."""
    return b64encode(
        cv2.imencode(".webp", rgb[..., ::-1], [cv2.IMWRITE_WEBP_QUALITY, 80])[1]
    ).decode()


def write_page_data(folder: Path) -> None:
    """Write the pairs, one script each, the network, and a script that lists them."""
    dataset = Co3D(sample_data())
    method = ZeroShotPose(load_backbone("zsp-tiny", "cpu"))
    titles = []
    folder.mkdir(parents=True, exist_ok=True)
    for index, pair in enumerate(stored_pairs(dataset)):
        views, error = pair_data(dataset, pair, method)
        mark = "✓ right" if error < SAME_ANGLE else "✕ wrong"
        titles.append(
            f"{pair.category}: {pair.reference_sequence} → {pair.target_sequence} ({mark}, "
            f"{error:.0f}°)"
        )
        (folder / f"pair{index}.js").write_text(
            f"STORED[{index}] = {json.dumps(views, separators=(',', ':'))};\n"
        )
    (folder / "zsp-tiny.onnx").write_bytes(onnx_model(method.backbone))
    # The random numbers that RANSAC draws in Python, for the same samples in the browser. Each of
    # the 5,000 has two halves of 32 bits: four for each of at most 2,000 trials, and some to spare.
    draws = np.random.default_rng(method.seed).bit_generator.random_raw(5000)
    content = {
        "titles": titles,
        "steps": (KEY_STEP, POINT_STEP),
        "draws": packed(draws.astype("<u8")),
        "runtime": fetch_runtime(folder),
    }
    (folder / "data.js").write_text(f"const STORED = [], DATA = {json.dumps(content)};\n")


def fetch_runtime(folder: Path) -> bool:
    """Unpack onnxruntime-web into the folder; returns False where it cannot be fetched."""
    registry = os.environ.get("npm_config_registry", "https://registry.npmjs.org").rstrip("/")
    try:
        archive = fetch(
            f"{registry}/onnxruntime-web/-/{RUNTIME}",
            cache_folder() / RUNTIME,
            digest=RUNTIME_SHA256,
        )
    except InputError as error:
        print(f"the page will have no part for one's own photographs: {error}", file=sys.stderr)
        return False
    with tarfile.open(archive) as package:
        for name in (
            "ort.wasm.min.js",
            "ort-wasm-simd-threaded.mjs",
            "ort-wasm-simd-threaded.wasm",
        ):
            (folder / name).write_bytes(package.extractfile(f"package/dist/{name}").read())
    return True


def _view_data(view: View, keys: np.ndarray) -> dict:
    """Compute the data of one view."""
    points, _ = view.patch_points  # `known_foreground` says where they are known
    camera = view.frame.camera
    solid = view.known_foreground
    # The 3D drawing leaves out points more than 2.5 median distances from the middle.
    solid[solid] = near_median(points[solid], 2.5)
    return {
        "webp": webp(view.frame.rgb),
        "keys": packed(keys),
        "saliency": packed(view.features.saliency.numpy()),
        "points": packed(np.round(points / POINT_STEP).astype("<i2")),
        "solid": np.flatnonzero(solid).tolist(),
        **{
            name: getattr(camera, name).tolist()
            for name in ("R", "t", "focal_length", "principal_point")
        },
    }


def onnx_model(backbone: Backbone) -> bytes:
    """Encode a backbone as an ONNX file.

    Its input is "image" (1, 3, side, side), RGB in [0, 1]; its outputs are "keys" (1, n, d) and
    "saliency" (1, n).
    """
    image = torch.zeros(1, 3, backbone.image_size, backbone.image_size)
    file = io.BytesIO()
    # Of torch's two exporters, the one with `dynamo` needs the package onnxscript. The other one
    # uses the package onnx only to search its result for functions of onnxscript. There are none
    # here: a stand-in for onnx, in which nothing is found, spares the dependency. Constants are not
    # folded, so that weights stay in float16. Warnings are about images of other sizes.
    with warnings.catch_warnings(action="ignore"), patch.dict(sys.modules, onnx=MagicMock()):
        torch.onnx.export(
            _Network(backbone),
            (image,),
            file,
            input_names=["image"],
            output_names=["keys", "saliency"],
            opset_version=17,  # the first with layer normalisation
            dynamo=False,
            do_constant_folding=False,
        )
    return file.getvalue()


class _Network(torch.nn.Module):
    """What the page computes of a photograph, with weights in float16 as in the embedded
    checkpoint."""

    def __init__(self, backbone: Backbone):
        super().__init__()
        self.backbone = backbone
        self.model = deepcopy(backbone.model).half()

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        backbone = self.backbone
        with _Float32Weights():
            tokens = self.model.extract(
                normalize(image, backbone.mean, backbone.std), backbone.layer
            )
        saliency = tokens.attention[:, list(backbone.saliency_heads)].mean(1)
        low = saliency.amin()
        return tokens.keys, (saliency - low) / (saliency.amax() - low)


class _Float32Weights(TorchFunctionMode):
    """Casts weights to float32 where they are used."""

    def __torch_function__(self, function, types, args=(), kwargs=None):
        def cast(value):
            return value.float() if isinstance(value, torch.nn.Parameter) else value

        named = {name: cast(value) for name, value in (kwargs or {}).items()}
        return function(*map(cast, args), **named)


if __name__ == "__main__":
    write_page_data(Path(sys.argv[1]))

"""Write what docs/playground.md loads.

    python -m docs.playground.build outputs/site/docs/playground

onnxruntime-web is fetched into the cache, from the npm registry or from the registry that
npm_config_registry names.
"""

import json
import os
import sys
import tarfile
import zlib
from base64 import b64encode
from pathlib import Path

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from zsp_lite import Backbone, Co3D, InputError, ZeroShotPose, load_backbone
from zsp_lite.course.samples import sample_data
from zsp_lite.course.true_matches import ground_truth_matches, patch_coordinates
from zsp_lite.data.co3d import Pair
from zsp_lite.data.ground_truth import object_poses
from zsp_lite.data.labels import read_labels, relative_pose
from zsp_lite.data.pairs import shipped_pairs
from zsp_lite.io.download import fetch
from zsp_lite.io.files import cache_folder
from zsp_lite.metrics import rotation_error
from zsp_lite.points import near_median
from zsp_lite.views import View

# Indices of evaluation pairs: in each category the first, whatever its result, and the next with an
# error below 15 degrees.
PAIRS = {"bicycle": (0, 1), "car": (0, 6), "chair": (0, 4), "motorcycle": (0, 1)}
# Keys and points are stored as 16-bit integers in these steps. Cosines of descriptors are off by at
# most 5e-4, cosines of bare keys by at most 2e-3.
KEY_STEP = 1 / 64
POINT_STEP = 1 / 1024
GRID = (28, 28)  # rows and columns of patches
NUMBER = (28, 1)  # row and column of a patch times these factors give its number
RUNTIME = "onnxruntime-web-1.30.0.tgz"
RUNTIME_SHA256 = "d2228df7e4616bc3348bf504ee888f3bec43789a273f0a63f3e68d203ce3bf71"
# Numbers of onnx.proto: types of tensors, and field and type of an attribute by its Python type.
_TYPES = {"float32": 1, "int64": 7, "float16": 10}
_ATTRIBUTES = {float: (2, 1), int: (3, 2), str: (4, 3), list: (8, 7)}
# Starts and ends of the slice [:1, 1:], which leaves out the token CLS; the last end is beyond any
# length.
_FROM_SECOND = (np.array([0, 1]), np.array([1, 1 << 30]))


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

    # Keys (views, patches, d) on their principal axes, of which few matter, and rounded.
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
        mark = "✓ right" if error < 30 else "✕ wrong"
        titles.append(
            f"{pair.category}: {pair.reference_sequence} → {pair.target_sequence} ({mark}, "
            f"{error:.0f}°)"
        )
        (folder / f"pair{index}.js").write_text(
            f"STORED[{index}] = {json.dumps(views, separators=(',', ':'))};\n"
        )
    (folder / "zsp-tiny.onnx").write_bytes(onnx_model(method.backbone))
    # The random numbers that RANSAC draws in Python, for the same samples in the browser.
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
    points, _ = view.patch_points
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


# ONNX files are protocol buffers. Weights are float16, as in the embedded checkpoint, and cast
# where they are used.
def onnx_model(backbone: Backbone) -> bytes:
    """Encode a backbone as an ONNX file.

    Its input is "image" (1, 3, side, side), RGB in [0, 1]; its outputs are "keys" (1, n, d) and
    "saliency" (1, 1, 1, n).
    """
    graph = _Graph()
    add = graph.add
    linear = graph.linear
    model = backbone.model

    # From the image to tokens: standardised colours, patches, positions.
    mean = np.float32(backbone.mean).reshape(1, 3, 1, 1)
    std = np.float32(backbone.std).reshape(1, 3, 1, 1)
    image = add("Div", add("Sub", "image", mean), std)
    patches = add(
        "Conv", image, *model.patch_embed.proj.parameters(), strides=[model.patch_size] * 2
    )
    patches = add(
        "Transpose", add("Reshape", patches, np.array([1, model.embed_dim, -1])), perm=[0, 2, 1]
    )
    tokens = add("Add", add("Concat", model.cls_token, patches, axis=1), model.pos_embed)

    # The blocks: (1, tokens, d) and, by heads, (1, tokens, heads, d / heads).
    joined = np.array([1, -1, model.embed_dim])
    split = np.array([1, 0, model.num_heads, -1])
    for index, block in enumerate(model.blocks):
        normed = add(
            "LayerNormalization", tokens, *block.norm1.parameters(), epsilon=block.norm1.eps
        )
        weights, biases = [p.chunk(3) for p in block.attn.qkv.parameters()]
        query, key, value = [linear(normed, *both) for both in zip(weights, biases)]
        if index == backbone.layer:
            add("Slice", key, *_FROM_SECOND, np.array([0, 1]), name="keys")
        query = add("Reshape", query, split)
        key = add("Reshape", key, split)
        value = add("Reshape", value, split)
        products = add("Einsum", query, key, equation="bihd,bjhd->bhij")
        attention = add("Softmax", add("Mul", products, np.float32(block.attn.scale)), axis=-1)
        if block is model.blocks[-1]:
            break  # Of the last block only the attention is needed.
        heads = add("Reshape", add("Einsum", attention, value, equation="bhij,bjhd->bihd"), joined)
        tokens = add("Add", tokens, linear(heads, *block.attn.proj.parameters()))
        normed = add(
            "LayerNormalization", tokens, *block.norm2.parameters(), epsilon=block.norm2.eps
        )
        hidden = add("Gelu", linear(normed, *block.mlp.fc1.parameters()))
        tokens = add("Add", tokens, linear(hidden, *block.mlp.fc2.parameters()))

    # Saliency: the attention of CLS to patches, averaged over heads, scaled to [0, 1].
    heads = add("Gather", attention, np.array(backbone.saliency_heads), axis=1)
    saliency = add(
        "ReduceMean", add("Slice", heads, *_FROM_SECOND, np.array([2, 3])), np.array([1])
    )
    low = add("ReduceMin", saliency)
    high = add("ReduceMax", saliency)
    add("Div", add("Sub", saliency, low), add("Sub", high, low), name="saliency")
    # Field 11 of the graph has its inputs, field 12 its outputs.
    side = backbone.image_size
    return graph.encode((11, "image", (1, 3, side, side)), (12, "keys", ()), (12, "saliency", ()))


class _Graph:
    """Nodes (field 1) and stored tensors (field 5) of a network, by the numbers of onnx.proto."""

    def __init__(self):
        self.fields = [(2, "vit")]  # the graph's name

    def add(
        self, operator: str, *inputs: str | np.ndarray | torch.Tensor, name: str = "", **attributes
    ) -> str:
        """Add a node and return the name of its output.

        Arrays are stored as they are, tensors as float16.
        """
        fields = []
        for value in inputs:
            fields.append((1, value if isinstance(value, str) else self._store(value)))
        name = name or f"{operator}{len(self.fields)}"
        for attribute, value in attributes.items():
            field, kind = _ATTRIBUTES[type(value)]
            values = [(field, number) for number in np.atleast_1d(value).tolist()]
            fields.append((5, _message((1, attribute), *values, (20, kind))))
        self.fields.append((1, _message(*fields, (2, name), (4, operator))))
        return name

    def linear(self, x: str, weight: torch.Tensor, bias: torch.Tensor) -> str:
        """Add a linear layer and return the name of its output."""
        return self.add("Add", self.add("MatMul", x, weight.T), bias)

    def _store(self, values: np.ndarray | torch.Tensor) -> str:
        """Store values and return their name: an array as it is, a tensor as float16 with a cast to
        float32."""
        name = f"tensor{len(self.fields)}"
        is_weight = torch.is_tensor(values)
        if is_weight:
            array = values.detach().cpu().numpy().astype(np.float16)
        else:
            array = np.asarray(values)
        shape = [(1, n) for n in array.shape]
        content = ((2, _TYPES[array.dtype.name]), (8, name), (9, array.tobytes()))
        self.fields.append((5, _message(*shape, *content)))
        return self.add("Cast", name, to=_TYPES["float32"]) if is_weight else name

    def encode(self, *ends: tuple[int, str, tuple[int, ...]]) -> bytes:
        """Encode the model with float32 inputs (field 11) and outputs (12); an output needs no
        shape."""
        for field, name, shape in ends:
            content = [(1, _TYPES["float32"])]
            if shape:
                sizes = [(1, _message((1, n))) for n in shape]
                content.append((2, _message(*sizes)))
            kind = _message((1, _message(*content)))
            self.fields.append((field, _message((1, name), (2, kind))))
        # Version 9 of the format (field 1), the graph (7), and version 20 of the operators (8).
        return _message((1, 9), (7, _message(*self.fields)), (8, _message((1, ""), (2, 20))))


def _message(*fields: tuple[int, int | float | str | bytes]) -> bytes:
    """Encode fields (number, value) of a protocol buffer.

    Each field begins with its number and, in the low three bits, the kind of its value: an integer
    (0), bytes with their length (2) or a float32 (5).
    """
    parts = []
    for number, value in fields:
        if isinstance(value, float):
            parts += [_varint(number << 3 | 5), np.float32(value).tobytes()]
        elif isinstance(value, int):
            parts += [_varint(number << 3), _varint(value)]
        else:
            value = value.encode() if isinstance(value, str) else value
            parts += [_varint(number << 3 | 2), _varint(len(value)), value]
    return b"".join(parts)


def _varint(value: int) -> bytes:
    """Encode an integer in groups of seven bits, the lowest first; bit 8 says that more follow."""
    # Negative numbers are in two's complement of 64 bits.
    rest, last = divmod(value & (1 << 64) - 1, 128)
    return bytes([last | 128]) + _varint(rest) if rest else bytes([last])


if __name__ == "__main__":
    write_page_data(Path(sys.argv[1]))

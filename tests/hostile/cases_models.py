"""Checkpoints and models: giant sizes, tensors without data, code, and values that are not finite."""

import json
import pickle
import struct
import zipfile

import torch
from safetensors.torch import save_file

from tests.hostile.harness import Wrong, case, command, strange_files
from zsp_lite.backbones.load import load_backbone
from zsp_lite.backbones.vit import VisionTransformer

LOADED = {key: x.clone() for key, x in VisionTransformer(32, 8, 64, 2, 1).state_dict().items()}


class Code:
    def __reduce__(self):
        import os

        return os.system, ("touch pwned",)


def _nested(levels):
    inner: object = {"a": torch.zeros(1)}
    for _ in range(levels):
        inner = [inner]
    return inner


def _deep_pickle(folder):
    with zipfile.ZipFile(folder / "x.pth", "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("x/data.pkl", b"\x80\x02" + b"]" * 500_000 + b"a" * 499_999 + b".")
        archive.writestr("x/version", b"3\n")
        archive.writestr("x/byteorder", b"little")


def _compressed(folder):
    torch.save({"a": torch.zeros(1 << 28)}, folder / "y.pth")
    with zipfile.ZipFile(folder / "y.pth") as old, zipfile.ZipFile(folder / "x.pth", "w", zipfile.ZIP_DEFLATED) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))


def _save(content):
    return lambda folder: torch.save(content() if callable(content) else content, folder / "x.pth")


def _legacy(content):
    return lambda folder: torch.save(content(), folder / "x.pth", _use_new_zipfile_serialization=False)


def _safetensors(header: dict | bytes, data: bytes = b""):
    def write(folder):
        encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
        (folder / "x.safetensors").write_bytes(struct.pack("<Q", len(encoded)) + encoded + data)

    return write


def _with(**changed):
    return LOADED | {key.replace("__", "."): value for key, value in changed.items()}


def _metadata(**values):
    return lambda folder: save_file(LOADED, folder / "x.safetensors", values)


big = torch.zeros(1)
CHECKPOINTS = {
    "tensor of 400 GB, stride 0": _save(lambda: _with(norm__weight=big.expand(10**11))),
    "weights of stride 0": _save(lambda: {k: big.expand(x.shape) for k, x in LOADED.items()} | {"pos_embed": big.expand(1, 10**8 + 1, 64)}),
    "block 100000000": _save(lambda: LOADED | {"blocks.100000000.norm1.weight": torch.zeros(64)}),
    "block 10^30": _save(lambda: LOADED | {f"blocks.{10**30}.norm1.weight": torch.zeros(64)}),
    "block -1": _save(lambda: LOADED | {"blocks.-1.norm1.weight": torch.zeros(64)}),
    "block x": _save(lambda: LOADED | {"blocks.x.norm1.weight": torch.zeros(64)}),
    "no block": _save(lambda: {k: x for k, x in LOADED.items() if not k.startswith("blocks.")}),
    "code": _save(lambda: {"a": Code()}),
    "code, legacy": _legacy(lambda: {"a": Code()}),
    "plain pickle with code": lambda folder: (folder / "x.pth").write_bytes(pickle.dumps(Code())),
    "100 nested lists": _save(lambda: _nested(100)),
    "500,000 nested lists": _deep_pickle,
    "a gigabyte of compressed zeros": _compressed,
    "not a number": _save(lambda: _with(norm__weight=torch.full((64,), float("nan")))),
    "infinite": _save(lambda: _with(norm__weight=torch.full((64,), float("inf")))),
    "integers": _save(lambda: _with(norm__weight=torch.zeros(64, dtype=torch.int64))),
    "complex numbers": _save(lambda: _with(norm__weight=torch.zeros(64, dtype=torch.complex64))),
    "sparse tensor of 10^12": _save(lambda: _with(norm__weight=torch.sparse_coo_tensor([[0]], [1.0], (10**12,)))),
    "meta tensor": _save(lambda: _with(norm__weight=torch.zeros(10**12, device="meta"))),
    "quantised": _save(lambda: _with(norm__weight=torch.quantize_per_tensor(torch.zeros(64), 0.1, 0, torch.qint8))),
    "empty tensors": _save(lambda: {k: torch.zeros(0) for k in LOADED}),
    "patch size 0": _save(lambda: _with(patch_embed__proj__weight=torch.zeros(64, 3, 0, 0))),
    "oblong patches": _save(lambda: _with(patch_embed__proj__weight=torch.zeros(64, 3, 8, 4))),
    "five axes": _save(lambda: _with(patch_embed__proj__weight=torch.zeros(64, 3, 8, 8, 1))),
    "no positions": _save(lambda: _with(pos_embed=torch.zeros(1, 0, 64))),
    "keys that are numbers": _save(lambda: {1: torch.zeros(1)}),
    "a number": _save(lambda: 5),
    "empty dictionary": _save(dict),
    "cut": lambda folder: (_save(LOADED)(folder), (folder / "x.pth").write_bytes((folder / "x.pth").read_bytes()[:-900])),
    "header of 2^63 bytes": lambda folder: (folder / "x.safetensors").write_bytes(struct.pack("<Q", 2**63) + b"{}"),
    "header of 100,000 levels": _safetensors(b'{"a":' * 100_000),
    "shape beyond the data": _safetensors({"a": {"dtype": "F32", "shape": [10**12], "data_offsets": [0, 4]}}, bytes(4)),
    "shape that overflows": _safetensors({"a": {"dtype": "F32", "shape": [2**62, 4], "data_offsets": [0, 0]}}),
    "overlapping tensors": _safetensors({n: {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]} for n in "ab"}, bytes(4)),
    "unknown type": _safetensors({"a": {"dtype": "X9", "shape": [1], "data_offsets": [0, 4]}}, bytes(4)),
    "heads of 10^9": _metadata(num_heads="1000000000"),
    "heads 0": _metadata(num_heads="0"),
    "heads negative": _metadata(num_heads="-1"),
    "heads of a text": _metadata(num_heads="many"),
    "heads of 5000 digits": _metadata(num_heads="1" * 5000),
    "block 10^9 in the metadata": _metadata(num_heads="1", key_block="1000000000"),
    "saliency head 99": _metadata(num_heads="1", saliency_heads="[99]"),
    "saliency heads of 1e6 entries": _metadata(num_heads="1", saliency_heads=",".join(["0"] * 10**6) + ",7"),
}  # fmt: skip


def _load(write):
    def call(folder):
        write(folder)
        path = next(path for path in (folder / "x.safetensors", folder / "x.pth") if path.exists())
        found = None
        try:
            found = load_backbone(path, "cpu")
        finally:
            if (folder / "pwned").exists():
                raise Wrong("code was executed")
        return found

    return call


for name, write in CHECKPOINTS.items():
    case("checkpoint", name, _load(write))
for name in strange_files():
    for suffix in (".pth", ".safetensors"):
        command("file", f"checkpoint{suffix}: {name}", "weights", "verify", f"ROOT/x{suffix}",
                change=lambda folder, name=name, suffix=suffix: strange_files()[name](folder / f"x{suffix}"))  # fmt: skip

# models in Hugging Face's format
VIT = {"model_type": "vit", "architectures": ["ViTModel"], "hidden_size": 32, "num_hidden_layers": 1,
       "num_attention_heads": 2, "intermediate_size": 32, "image_size": 32, "patch_size": 8}  # fmt: skip
CONFIGS = {
    "10^9 layers": {"num_hidden_layers": 10**9},
    "10^6 layers": {"num_hidden_layers": 10**6},
    "layers negative": {"num_hidden_layers": -1},
    "layers of a text": {"num_hidden_layers": "12"},
    "hidden size of 10^9": {"hidden_size": 10**9, "num_attention_heads": 10**9},
    "hidden size 0": {"hidden_size": 0},
    "heads 0": {"num_attention_heads": 0},
    "intermediate size of 10^12": {"intermediate_size": 10**12},
    "image size of 10^9": {"image_size": 10**9},
    "patch size 0": {"patch_size": 0},
    "patch size of 10^9": {"patch_size": 10**9},
    "channels of 10^9": {"num_channels": 10**9},
    "code of its own": {"auto_map": {"AutoModel": "code.Model"}, "model_type": "own"},
    "unknown model": {"model_type": "[/1]"},
    "another model": {"model_type": "bert"},
}


def _model(change=lambda model: None):
    def call(folder):
        from transformers import ViTConfig, ViTModel

        model = folder / "model"
        ViTModel(ViTConfig(**VIT), add_pooling_layer=False).save_pretrained(model)
        change(model)
        return load_backbone(f"hf:{model}", image_size=32)

    return call


def _configured(**values):
    def change(model):
        path = model / "config.json"
        path.write_text(json.dumps(json.loads(path.read_text()) | values))

    return change


case("model", "nothing wrong", _model(), answers=True)
for name, values in CONFIGS.items():
    case("model", name, _model(_configured(**values)))
case("model", "100,000 levels", _model(lambda model: (model / "config.json").write_text('{"a":' * 100_000)))
case("model", "missing weights", _model(lambda model: save_file({"a": torch.zeros(1)}, model / "model.safetensors")))

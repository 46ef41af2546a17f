"""Vision transformers in Hugging Face's format: small random ones of each architecture, against
transformers itself."""

import functools
import json
import re
import shutil
import sys
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
import transformers
from refusals import refused
from safetensors.torch import load, load_file, save_file
from small_backbones import ARCHITECTURES, DEPTH, DIM, HEADS, configuration, save_all, save_model
from torch.testing import assert_close
from transformers import AutoModel

from zsp_lite import load_backbone
from zsp_lite.backbones.backbone import prepare_images
from zsp_lite.backbones.load import download
from zsp_lite.benchmark.runs import fingerprint
from zsp_lite.choices import FACETS


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    return save_all(tmp_path_factory.mktemp("models"))


SHAPES = (64, 64, 3), (50, 90, 3)
PICTURES = [np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8) for shape in SHAPES]


@functools.cache
def by_transformers(folder: Path, kind: str, size: int):
    """For `PICTURES`, return input and output of every block of the eager model, its output, and
    its blocks."""
    architecture = ARCHITECTURES[kind]
    model = AutoModel.from_pretrained(folder, attn_implementation="eager", dtype=torch.float32)
    model = getattr(model, "vision_model", model).eval()
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    options = {"interpolate_pos_encoding": True} if architecture.interpolates else {}
    if kind == "vit_mae":
        model.config.mask_ratio = 0.0
        options["noise"] = (
            torch.arange((size // architecture.patch) ** 2).float().repeat(len(PICTURES), 1)
        )
    (blocks,) = [module for module in model.modules() if isinstance(module, torch.nn.ModuleList)]
    seen = []
    for block in blocks:
        block.register_forward_hook(lambda module, inputs, output: seen.append((inputs[0], output)))
    with torch.no_grad():
        images = (prepare_images(PICTURES, size) - mean.view(3, 1, 1)) / std.view(3, 1, 1)
        output = model(images, output_attentions=True, **options)
    return [(x, y if torch.is_tensor(y) else y[0]) for x, y in seen], output, blocks


def projection(architecture, block, x, facet: str):
    """Return queries, keys or values of a block for its input."""
    names = f"{facet[0]}_proj", facet  # of newer and of older releases of transformers
    (project,) = [
        module for name, module in block.named_modules() if name.rpartition(".")[2] in names
    ]
    return project(block.get_submodule(architecture.norm)(x)).detach()


@pytest.mark.parametrize("kind", ARCHITECTURES)
@pytest.mark.parametrize("facet", FACETS)
def test_facets_are_the_projections_of_the_blocks_normalised_input_and_its_output(
    kind, folders, facet
):
    architecture = ARCHITECTURES[kind]
    size = 4 * architecture.patch
    seen, _, blocks = by_transformers(folders[kind], kind, size)
    for layer in range(DEPTH):
        before, after = seen[layer]
        expected = (
            after if facet == "token" else projection(architecture, blocks[layer], before, facet)
        )
        backbone = load_backbone(
            f"hf:{folders[kind]}", "cpu", layer=layer, facet=facet, image_size=size
        )
        for features, values in zip(
            backbone(PICTURES), expected[:, architecture.special :], strict=True
        ):
            assert_close(features.keys, values.view(4, 4, DIM), atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", ARCHITECTURES)
def test_saliency_is_the_last_cls_attention_and_the_global_feature_the_cls_output(kind, folders):
    architecture = ARCHITECTURES[kind]
    size = 4 * architecture.patch
    seen, output, blocks = by_transformers(folders[kind], kind, size)
    if kind == "dinov3_vit":  # its attention adds a rotary embedding
        attention = output.attentions[-1][:, :, 0]
    else:
        q, k = (
            projection(architecture, blocks[-1], seen[-1][0], facet)
            .unflatten(-1, (HEADS, -1))
            .transpose(1, 2)
            for facet in ("query", "key")
        )
        attention = (q @ k.transpose(-1, -2) / (DIM / HEADS) ** 0.5).softmax(-1)[:, :, 0]
    expected = attention[:, :, architecture.special :].mean(1)
    expected = expected - expected.amin(1, keepdim=True)
    expected = (expected / expected.amax(1, keepdim=True)).view(-1, 4, 4)
    features = load_backbone(f"hf:{folders[kind]}", "cpu", image_size=size)(PICTURES)
    for one, saliency, cls in zip(features, expected, output.last_hidden_state[:, 0], strict=True):
        assert_close(one.saliency, saliency, atol=2e-5, rtol=1e-4)
        assert_close(one.global_feature, cls, atol=2e-5, rtol=1e-4)


def test_a_model_that_nobody_thought_of_is_read_by_the_names_of_its_parts(tmp_path):
    backbone = load_backbone(
        f"hf:{save_model(tmp_path, configuration('beit'))}", "cpu", image_size=48
    )
    assert [features.grid for features in backbone(PICTURES)] == [(3, 3), (3, 3)]


@pytest.mark.parametrize(
    "file, content, mean, std",
    [
        ("preprocessor_config.json", {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}, 0.5, 0.25),
        (
            "preprocessor_config.json",
            {"do_normalize": False, "image_mean": [0.5] * 3, "image_std": [1] * 3},
            0,
            1,
        ),
    ],
)
def test_the_image_processors_mean_and_deviation_are_taken(file, content, mean, std, tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    plain = load_backbone(f"hf:{folder}", "cpu", image_size=48)
    (folder / file).write_text(json.dumps(content))
    backbone = load_backbone(f"hf:{folder}", "cpu", image_size=48)
    assert (backbone.mean, backbone.std) == ((mean,) * 3, (std,) * 3)
    assert not torch.allclose(backbone(PICTURES)[0].keys, plain(PICTURES)[0].keys)


def test_without_transformers_the_package_is_named(folders, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused(r"pip install transformers", load_backbone, f"hf:{folders['vit']}", "cpu")


@pytest.mark.parametrize(
    "kind, settings, match",
    [
        ("siglip", {}, "a siglip_vision_model model, expected .* a CLS token"),
        ("blip", {}, "a blip_vision_model model, expected .* the projections q_proj or query"),
        ("vit", {"num_channels": 1}, "does not run"),
        ("vit", {"patch_size": [8, 16]}, "one square patch_size"),
        ("yolos", {"image_size": [32, 32], "num_detection_tokens": 7}, "11 tokens without"),
        (
            "resnet",
            {"embedding_size": 8, "hidden_sizes": [8, 8], "depths": [1, 1]},
            "a resnet model",
        ),
    ],
)
def test_models_that_cannot_be_read_are_refused(kind, settings, match, tmp_path):
    config = (
        transformers.ResNetConfig(**settings)
        if kind == "resnet"
        else configuration(kind, **settings)
    )
    refused(
        match, load_backbone, f"hf:{save_model(tmp_path / 'model', config)}", "cpu", image_size=32
    )


def test_missing_weights_are_refused_and_not_made_up(tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    weights = load((folder / "model.safetensors").read_bytes())
    kept = {key: x for key, x in weights.items() if "pooler" not in key}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    # Nobody reads the pooler.
    first, second = (load_backbone(f"hf:{folder}", "cpu", image_size=48) for _ in range(2))
    assert fingerprint(first) == fingerprint(second)
    del kept["layernorm.weight"]
    # Windows keeps a file whose tensors are in use
    other = shutil.copytree(folder, tmp_path / "other")
    save_file(kept, other / "model.safetensors", metadata={"format": "pt"})
    refused(
        "1 weights are not in the file, first layernorm.weight", load_backbone, f"hf:{other}", "cpu"
    )


def test_pickles_are_not_read(tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    refused("no model.safetensors", load_backbone, f"hf:{folder}", "cpu")
    refused("no config.json", load_backbone, f"hf:{tmp_path}", "cpu")


@pytest.mark.parametrize(
    "file, content, match",
    [
        ("model.safetensors", b"<html>404</html>" + bytes(1 << 20), ""),
        ("config.json", b"{", "config.json"),
        (
            "preprocessor_config.json",
            b'{"image_mean": [0.5], "image_std": [1]}',
            "expected three numbers",
        ),
    ],
)
def test_damaged_folders_are_refused_in_one_line(file, content, match, tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    (folder / file).write_bytes(content)
    told = re.escape(f"hf:{folder}") + f": cannot be loaded by the package transformers .*{match}"
    refused(told, load_backbone, f"hf:{folder}", "cpu")


@pytest.fixture()
def offline(tmp_path, monkeypatch) -> Path:
    """No hub, and an empty cache."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_what_is_in_the_cache_needs_no_hub(offline):
    repository = offline / "models--someone--small"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs/main").write_text("0" * 40)
    folder = save_model(repository / "snapshots" / ("0" * 40), configuration("vit"))
    backbone = load_backbone("hf:someone/small", "cpu")
    assert backbone.name == "hf:someone/small"
    assert backbone(PICTURES)[0].grid == (14, 14)
    assert download("hf:someone/small").samefile(folder)


@pytest.mark.parametrize("name", ["hf:", "hf:../nowhere", "hf:facebook/dinov2-small"])
def test_what_is_neither_a_folder_nor_a_name_is_refused(name, offline):
    refused(
        "neither a folder nor a model OWNER/MODEL that the Hugging Face hub gives",
        load_backbone,
        name,
        "cpu",
    )

"""Vision transformers in Hugging Face's format: small random ones of each architecture, against
transformers itself."""

import functools
import json
import re
import sys
from pathlib import Path

import huggingface_hub
import pytest
import torch
import transformers
from refusals import refused
from safetensors.torch import load, load_file, save_file
from small_backbones import (
    ARCHITECTURES,
    MEAN,
    PICTURES,
    STD,
    close,
    configuration,
    save_all,
    save_model,
)
from transformers import AutoModel

from zsp_lite import load_backbone
from zsp_lite.backbones.backbone import prepare_images
from zsp_lite.backbones.released import download
from zsp_lite.benchmark.runs import fingerprint
from zsp_lite.choices import FACETS


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    """The folder of a small model of each architecture."""
    return save_all(tmp_path_factory.mktemp("models"))


@pytest.fixture
def vit(tmp_path) -> Path:
    """The folder of a small ViT that a test may change."""
    return save_model(tmp_path / "vit", configuration("vit"))


@functools.cache
def by_transformers(folder: Path, kind: str, size: int):
    """Run a model of transformers on `PICTURES`; returns (input, output) of each of its blocks,
    its output, and its blocks."""
    architecture = ARCHITECTURES[kind]
    # The eager implementation of attention is the one that returns attention weights.
    model = AutoModel.from_pretrained(folder, attn_implementation="eager", dtype=torch.float32)
    model = getattr(model, "vision_model", model).eval()
    options = {"interpolate_pos_encoding": True} if architecture.interpolates else {}
    if kind == "vit_mae":
        # A masked autoencoder hides patches and sorts them by noise: hide none, keep their order.
        model.config.mask_ratio = 0.0
        patches = (size // architecture.patch) ** 2
        options["noise"] = torch.arange(patches).float().repeat(len(PICTURES), 1)
    (blocks,) = [module for module in model.modules() if isinstance(module, torch.nn.ModuleList)]
    calls = []
    for block in blocks:
        block.register_forward_hook(lambda _, inputs, output: calls.append((inputs[0], output)))
    with torch.no_grad():
        images = (prepare_images(PICTURES, size) - MEAN) / STD
        output = model(images, output_attentions=True, **options)
    # Some blocks return their tokens in a tuple.
    return [(x, y if torch.is_tensor(y) else y[0]) for x, y in calls], output, blocks


def projection(architecture, block, x, facet: str) -> torch.Tensor:
    """Return queries, keys or values of a block for its input x."""
    # Newer and older releases of transformers name the projection in different ways.
    names = f"{facet[0]}_proj", facet
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
    calls, _, blocks = by_transformers(folders[kind], kind, size)
    for layer, (x, tokens) in enumerate(calls):
        if facet != "token":
            tokens = projection(architecture, blocks[layer], x, facet)
        patches = tokens[:, architecture.special :].unflatten(1, (4, 4))
        backbone = load_backbone(
            f"hf:{folders[kind]}", "cpu", layer=layer, facet=facet, image_size=size
        )
        for features, expected in zip(backbone(PICTURES), patches, strict=True):
            close(features.keys, expected)


@pytest.mark.parametrize("kind", ARCHITECTURES)
def test_saliency_is_the_last_cls_attention_and_the_global_feature_the_cls_output(kind, folders):
    architecture = ARCHITECTURES[kind]
    size = 4 * architecture.patch
    _, output, _ = by_transformers(folders[kind], kind, size)
    # The attention of the CLS token to all tokens, (pictures, heads, tokens).
    attention = output.attentions[-1][:, :, 0]
    mean = attention[:, :, architecture.special :].mean(1)
    # Saliency is scaled to 0 to 1 in each picture.
    raised = mean - mean.amin(1, keepdim=True)
    saliencies = (raised / raised.amax(1, keepdim=True)).view(-1, 4, 4)
    maps = load_backbone(f"hf:{folders[kind]}", "cpu", image_size=size)(PICTURES)
    for features, saliency, cls in zip(
        maps, saliencies, output.last_hidden_state[:, 0], strict=True
    ):
        close(features.saliency, saliency)
        close(features.global_feature, cls)


def test_a_model_that_nobody_thought_of_is_read_by_the_names_of_its_parts(tmp_path):
    backbone = load_backbone(
        f"hf:{save_model(tmp_path, configuration('beit'))}", "cpu", image_size=48
    )
    assert backbone(PICTURES)[0].grid == (3, 3)


@pytest.mark.parametrize(
    "processor, mean, std",
    [
        ({"image_mean": [0.5] * 3, "image_std": [0.25] * 3}, 0.5, 0.25),
        ({"do_normalize": False, "image_mean": [0.5] * 3, "image_std": [1] * 3}, 0, 1),
    ],
)
def test_the_image_processors_mean_and_deviation_are_taken(processor, mean, std, vit):
    plain = load_backbone(f"hf:{vit}", "cpu", image_size=48)
    (vit / "preprocessor_config.json").write_text(json.dumps(processor))
    backbone = load_backbone(f"hf:{vit}", "cpu", image_size=48)
    assert (backbone.mean, backbone.std) == ((mean,) * 3, (std,) * 3)
    assert not torch.allclose(backbone(PICTURES)[0].keys, plain(PICTURES)[0].keys)


def test_without_transformers_the_package_is_named(folders, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused("pip install transformers", load_backbone, f"hf:{folders['vit']}")


@pytest.mark.parametrize(
    "kind, settings, message",
    [
        ("siglip", {}, "a siglip_vision_model model, expected .* a CLS token"),
        ("blip", {}, "a blip_vision_model model, expected .* the projections q_proj or query"),
        ("vit", {"num_channels": 1}, "does not run"),
        ("vit", {"patch_size": [8, 16]}, "one square patch_size"),
        # Four patches and seven tokens for detection.
        ("yolos", {"image_size": [32, 32], "num_detection_tokens": 7}, "11 tokens without"),
        (
            "resnet",
            {"embedding_size": 8, "hidden_sizes": [8, 8], "depths": [1, 1]},
            "a resnet model",
        ),
    ],
)
def test_models_that_cannot_be_read_are_refused(kind, settings, message, tmp_path):
    # A convolutional network has none of the settings of a transformer.
    make = transformers.ResNetConfig if kind == "resnet" else functools.partial(configuration, kind)
    folder = save_model(tmp_path / "model", make(**settings))
    refused(message, load_backbone, f"hf:{folder}", image_size=32)


def without(vit: Path, part: str) -> str:
    """Take the weights whose names contain a part from a folder; returns the model's name."""
    # From bytes: Windows does not replace a file whose tensors are in use.
    weights = load((vit / "model.safetensors").read_bytes())
    remaining = {name: weight for name, weight in weights.items() if part not in name}
    save_file(remaining, vit / "model.safetensors", metadata={"format": "pt"})
    return f"hf:{vit}"


def test_a_missing_pooler_changes_nothing_because_no_feature_depends_on_it(vit):
    name = without(vit, "pooler")
    # transformers draws weights that are missing: two models would differ.
    assert fingerprint(load_backbone(name, "cpu")) == fingerprint(load_backbone(name, "cpu"))


def test_missing_weights_are_refused(vit):
    name = without(vit, "layernorm.weight")
    refused("1 weights are not in the file, first layernorm.weight", load_backbone, name)


def test_pickles_are_not_read(vit):
    torch.save(load_file(vit / "model.safetensors"), vit / "pytorch_model.bin")
    (vit / "model.safetensors").unlink()
    refused("no model.safetensors", load_backbone, f"hf:{vit}")
    refused("no config.json", load_backbone, f"hf:{vit.parent}")


@pytest.mark.parametrize(
    "file, content, message",
    [
        # A page of an error instead of the weights, with a length that is plausible for weights.
        ("model.safetensors", b"<html>404</html>" + bytes(1 << 20), ""),
        ("config.json", b"{", "config.json"),
        (
            "preprocessor_config.json",
            b'{"image_mean": [0.5], "image_std": [1]}',
            "expected three numbers",
        ),
    ],
)
def test_damaged_folders_are_refused_in_one_line(file, content, message, vit):
    (vit / file).write_bytes(content)
    name = f"hf:{vit}"
    refusal = f"{re.escape(name)}: cannot be loaded by the package transformers .*{message}"
    refused(refusal, load_backbone, name)


@pytest.fixture
def offline(tmp_path, monkeypatch) -> Path:
    """The empty cache of a machine without a hub."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_what_is_in_the_cache_needs_no_hub(offline):
    repository = offline / "models--someone--small"
    commit = 40 * "0"  # the hub names commits by 40 hexadecimal digits
    (repository / "refs").mkdir(parents=True)
    (repository / "refs/main").write_text(commit)
    folder = save_model(repository / "snapshots" / commit, configuration("vit"))
    backbone = load_backbone("hf:someone/small", "cpu")
    assert backbone.name == "hf:someone/small"
    assert backbone(PICTURES)[0].grid == (14, 14)  # 224 pixels in patches of 16
    assert download("hf:someone/small").samefile(folder)


@pytest.mark.parametrize("name", ["hf:", "hf:../nowhere", "hf:facebook/dinov2-small"])
def test_what_is_neither_a_folder_nor_a_name_is_refused(name, offline):
    refused(
        "neither a folder nor a model OWNER/MODEL that the Hugging Face hub gives",
        load_backbone,
        name,
    )

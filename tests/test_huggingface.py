"""Vision transformers in Hugging Face's format: small random ones of each architecture, against transformers itself."""

import json
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import huggingface_hub
import numpy as np
import pytest
import torch
import transformers
from safetensors.torch import load_file, save_file
from torch import nn
from transformers import AutoModel

from zsp_lite import ZeroShotPose, load_backbone
from zsp_lite.backbones.backbone import prepare_images
from zsp_lite.backbones.facets import FACETS
from zsp_lite.backbones.huggingface import nearest_multiple
from zsp_lite.backbones.load import verify
from zsp_lite.backbones.pretrained import download
from zsp_lite.benchmark.identity import fingerprint
from zsp_lite.cli import main as cli
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.samples import sample_data
from zsp_lite.demo import demo_pairs
from zsp_lite.errors import InputError

SIZES = {
    "hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 4, "intermediate_size": 64,
}  # fmt: skip
DEPTH, HEADS = 3, 4


@dataclass(frozen=True)
class Architecture:
    """What the tests know of an architecture by themselves: where its parts are and what stands before the patches."""

    patch: int
    special: int  # tokens before the patches
    stack: str = "layers"
    norm: str = "layernorm_before"
    attention: str = "attention"
    settings: dict = field(default_factory=dict)
    interpolates: bool = True  # only when asked to


ARCHITECTURES = {
    "vit": Architecture(16, 1),
    "deit": Architecture(16, 2),
    "dinov2": Architecture(14, 1, "encoder.layer", "norm1", interpolates=False),
    "dinov2_with_registers": Architecture(
        14, 5, "encoder.layer", "norm1", settings={"num_register_tokens": 4}, interpolates=False
    ),
    "dinov3_vit": Architecture(
        16, 5, "model.layer", "norm1", settings={"num_register_tokens": 4}, interpolates=False
    ),
    "vit_mae": Architecture(16, 1),
    "clip": Architecture(14, 1, "encoder.layers", "layer_norm1", "self_attn"),
}  # fmt: skip


def configuration(kind: str, patch: int = 16, **settings):
    # Positions are stored for 3 x 3 patches, so every other image size interpolates them.
    sizes = SIZES | {"patch_size": patch, "image_size": 3 * patch} | settings
    if kind in ("clip", "siglip", "blip"):
        text = SIZES | {"vocab_size": 99, "bos_token_id": 1, "eos_token_id": 2, "pad_token_id": 0}
        return transformers.CONFIG_MAPPING[kind](vision_config=sizes, text_config=text)
    return transformers.CONFIG_MAPPING[kind](**sizes)


def save_model(folder: Path, config, seed: int = 0) -> Path:
    torch.manual_seed(seed)
    model = AutoModel.from_config(config)
    for parameter in model.parameters():  # the usual initial weights are too small to tell tokens apart
        nn.init.normal_(parameter, std=0.2)
    model.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("models")
    return {
        kind: save_model(root / kind, configuration(kind, a.patch, **a.settings)) for kind, a in ARCHITECTURES.items()
    }


@pytest.fixture(params=ARCHITECTURES)
def kind(request) -> str:
    return request.param


@pytest.fixture()
def pictures() -> list[np.ndarray]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, shape, dtype=np.uint8) for shape in ((64, 64, 3), (50, 90, 3))]


def by_transformers(folder: Path, kind: str, pictures, size: int):
    """The eager model's own hidden states, attentions and output, and its blocks."""
    architecture = ARCHITECTURES[kind]
    model = AutoModel.from_pretrained(folder, attn_implementation="eager", dtype=torch.float32)
    model = getattr(model, "vision_model", model).eval()
    images = prepare_images(pictures, size)
    mean, std = torch.tensor([0.485, 0.456, 0.406]), torch.tensor([0.229, 0.224, 0.225])
    options = {"interpolate_pos_encoding": True} if architecture.interpolates else {}
    if kind == "vit_mae":
        model.config.mask_ratio = 0.0
        options["noise"] = torch.arange((size // architecture.patch) ** 2).float().repeat(len(pictures), 1)
    with torch.no_grad():
        output = model(
            (images - mean.view(3, 1, 1)) / std.view(3, 1, 1), output_hidden_states=True, output_attentions=True,
            **options,
        )  # fmt: skip
    return output, model.get_submodule(architecture.stack)


# what it computes


@pytest.mark.parametrize("facet", FACETS)
def test_facets_are_the_projections_of_the_normalised_input_of_the_block_and_its_output(kind, folders, pictures, facet):
    architecture = ARCHITECTURES[kind]
    size = 4 * architecture.patch
    output, blocks = by_transformers(folders[kind], kind, pictures, size)
    if facet == "token":
        expected = output.hidden_states[2]
    else:
        normed = blocks[1].get_submodule(architecture.norm)(output.hidden_states[1])
        attention = blocks[1].get_submodule(architecture.attention)
        expected = getattr(attention, f"{facet[0]}_proj")(normed)
    backbone = load_backbone(f"hf:{folders[kind]}", "cpu", layer="block1", facet=facet, image_size=size)
    for features, values in zip(backbone(pictures), expected[:, architecture.special :], strict=True):
        torch.testing.assert_close(features.keys, values.view(4, 4, 32).detach(), atol=2e-5, rtol=1e-4)


@pytest.mark.parametrize("heads", [None, (1, 3)])
def test_saliency_is_the_eager_models_last_cls_attention(kind, folders, pictures, heads):
    architecture = ARCHITECTURES[kind]
    size = 4 * architecture.patch
    output, _ = by_transformers(folders[kind], kind, pictures, size)
    attention = output.attentions[-1][:, :, 0, architecture.special :]
    expected = attention[:, list(range(HEADS) if heads is None else heads)].mean(1)
    expected = expected - expected.amin(1, keepdim=True)
    expected = (expected / expected.amax(1, keepdim=True)).view(-1, 4, 4)
    backbone = load_backbone(f"hf:{folders[kind]}", "cpu", saliency_heads=heads, image_size=size)
    for features, saliency, cls in zip(backbone(pictures), expected, output.last_hidden_state[:, 0], strict=True):
        torch.testing.assert_close(features.saliency, saliency, atol=2e-5, rtol=1e-4)
        torch.testing.assert_close(features.global_feature, cls, atol=2e-5, rtol=1e-4)
    assert features.saliency.std() > 0.05  # not one value everywhere


def test_the_grid_comes_from_the_patch_size_and_special_tokens_are_not_in_it(kind, folders, pictures):
    patch = ARCHITECTURES[kind].patch
    backbone = load_backbone(f"hf:{folders[kind]}", "cpu")
    assert (backbone.image_size, backbone.patch_size, backbone.embed_dim) == (224, patch, 32)
    assert backbone.layer == 2  # three quarters of the depth, rounded down
    features = backbone(pictures)[0]
    assert features.grid == (224 // patch, 224 // patch) == features.saliency.shape
    assert backbone.name == f"hf:{kind}"


@pytest.mark.parametrize("kind", ["vit_msn", "beit", "pixio"])
def test_models_that_nobody_thought_of_are_read_by_the_names_of_their_parts(kind, tmp_path, pictures):
    backbone = load_backbone(f"hf:{save_model(tmp_path / kind, configuration(kind))}", "cpu", image_size=48)
    assert [features.grid for features in backbone(pictures)] == [(3, 3), (3, 3)]


def test_a_rotary_embedding_reaches_the_saliency_and_not_the_keys(folders, pictures):
    # Patches of one colour differ by their position alone, which DINOv3 gives to nothing but queries and keys in the
    # attention: all keys of the first block are the same.
    backbone = load_backbone(f"hf:{folders['dinov3_vit']}", "cpu", layer=0, image_size=64)
    keys = backbone([np.full((64, 64, 3), 90, np.uint8)])[0].keys.flatten(0, 1)
    torch.testing.assert_close(keys, keys[:1].expand_as(keys), atol=1e-5, rtol=1e-5)


# settings


@pytest.mark.parametrize(
    "size, of, nearest", [(224, 14, 224), (224, 16, 224), (230, 14, 224), (233, 14, 238), (3, 14, 14), (448, 32, 448)]
)
def test_sizes_go_to_the_nearest_multiple_of_the_patch(size, of, nearest):
    assert nearest_multiple(size, of) == nearest


def test_an_image_size_that_does_not_divide_gets_the_nearest_multiple(folders, pictures):
    backbone = load_backbone(f"hf:{folders['dinov2']}", "cpu", image_size=100)
    assert backbone.image_size == 98
    assert backbone(pictures)[0].grid == (7, 7)


@pytest.mark.parametrize(
    "file, content, mean, std",
    [
        ("preprocessor_config.json", {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}, 0.5, 0.25),
        (
            "processor_config.json",
            {"image_processor": {"image_mean": [0.5] * 3, "image_std": [0.25] * 3}}, 0.5, 0.25,
        ),
        ("preprocessor_config.json", {"do_normalize": False, "image_mean": [0.5] * 3, "image_std": [1] * 3}, 0, 1),
    ],
)  # fmt: skip
def test_the_image_processors_mean_and_deviation_are_taken(file, content, mean, std, tmp_path, pictures):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    plain = load_backbone(f"hf:{folder}", "cpu", image_size=48)
    (folder / file).write_text(json.dumps(content))
    backbone = load_backbone(f"hf:{folder}", "cpu", image_size=48)
    assert (backbone.mean, backbone.std) == ((mean,) * 3, (std,) * 3)
    # Pixels that the two normalisations take to the same value give the same features.
    grey = torch.full((48, 48, 3), 0.4)
    same = (grey - mean) / std * torch.tensor(plain.std) + torch.tensor(plain.mean)
    if 0 <= same.min() and same.max() <= 1:
        torch.testing.assert_close(backbone([grey])[0].keys, plain([same])[0].keys, atol=1e-5, rtol=1e-4)
    assert not torch.allclose(backbone(pictures)[0].keys, plain(pictures)[0].keys)


def test_names_tell_what_was_chosen(folders):
    name = f"hf:{folders['dinov2']}"
    assert load_backbone(name, "cpu", facet="value", image_size=56).name == "hf:dinov2 (value, 56 px)"
    assert load_backbone("zsp-tiny", "cpu", facet="token").name == "zsp-tiny (token)"


def test_half_precision_weights_are_computed_with_in_float32(tmp_path, pictures):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    full = load_backbone(f"hf:{folder}", "cpu", image_size=48)(pictures)
    AutoModel.from_pretrained(folder, dtype=torch.float16).save_pretrained(folder)
    half = load_backbone(f"hf:{folder}", "cpu", image_size=48)
    assert {parameter.dtype for parameter in half.model.parameters()} == {torch.float32}
    torch.testing.assert_close(half(pictures)[0].keys, full[0].keys, atol=0.05, rtol=0.05)


# the pipeline and the command line on top


def test_the_pipeline_estimates_a_pose_with_it(folders):
    dataset = Co3D(sample_data())
    pair = demo_pairs(dataset)[0]
    reference, targets = dataset.load_pair(replace(pair, target_frames=pair.target_frames[:2]))
    method = ZeroShotPose(load_backbone(f"hf:{folders['dinov2_with_registers']}", "cpu"), k=20)
    estimate = method.estimate(reference, targets)
    assert estimate.reference_view.features.grid == (16, 16)
    assert len(estimate.points[0]) == len(estimate.matches.similarity) > 0
    np.testing.assert_allclose(estimate.sim3.R @ estimate.sim3.R.T, np.eye(3), atol=1e-9)
    assert np.isfinite(estimate.sim3.matrix).all()


@pytest.mark.slow
def test_the_command_line_takes_it(folders, ellipsoids, tmp_path, capsys):
    name = f"hf:{folders['dinov3_vit']}"
    assert cli.main(["weights", "verify", name]) == 0
    assert cli.main(["weights", "fetch", name]) == 0
    arguments = ["benchmark", "--data", str(ellipsoids.root), "--pairs", "1", "--targets", "2", "--backbone", name]
    assert cli.main([*arguments, "--methods", "ours,random", "--out", str(tmp_path / "run")]) == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["backbone"] == "hf:dinov3_vit"
    assert summary["methods"].keys() == {"ours", "random"}
    capsys.readouterr()
    assert cli.main(["weights", "verify", "hf:no/such/folder"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


# what is refused


def refused(name, match: str, **options):
    with pytest.raises(InputError, match=match) as caught:
        load_backbone(name, "cpu", **options)
    assert len(str(caught.value).splitlines()) == 1


def test_without_transformers_the_extra_is_named(folders, monkeypatch):
    monkeypatch.setitem(sys.modules, "transformers", None)
    refused(f"hf:{folders['vit']}", r"pip install transformers")


@pytest.mark.parametrize(
    "options, match",
    [({"layer": 3}, "layer is 3.*from -3 to 2"), ({"num_heads": 4}, "num_heads"), ({"image_size": 0}, "image_size")],
)
def test_settings_out_of_range_are_refused(folders, options, match):
    refused(f"hf:{folders['vit']}", match, **options)


@pytest.mark.parametrize(
    "kind, settings, match",
    [
        ("siglip", {}, "no CLS token"),
        ("resnet", {"embedding_size": 8, "hidden_sizes": [8, 8], "depths": [1, 1]}, "a resnet model"),
        ("swin", {"embed_dim": 8, "depths": [1, 1], "num_heads": [1, 1], "patch_size": 4}, "a swin model"),
        ("bert", SIZES | {"vocab_size": 99}, "a bert model"),
        ("vit", SIZES | {"num_channels": 1}, "takes 1 channels"),
        ("vit", SIZES | {"patch_size": [8, 16]}, "one square patch_size"),
        ("yolos", SIZES | {"image_size": [32, 32], "num_detection_tokens": 7}, "11 tokens without"),
        ("blip", {}, "is not a supported vision transformer"),
    ],
)
def test_models_that_cannot_be_read_are_refused(kind, settings, match, tmp_path):
    config = transformers.CONFIG_MAPPING[kind](**settings) if settings else configuration(kind)
    refused(f"hf:{save_model(tmp_path / 'model', config)}", match, image_size=32)


def test_missing_weights_are_refused_and_not_made_up(tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    weights = load_file(folder / "model.safetensors")
    kept = {key: x for key, x in weights.items() if "pooler" not in key}
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    first, second = (load_backbone(f"hf:{folder}", "cpu", image_size=48) for _ in range(2))  # nobody reads the pooler
    assert fingerprint(first) == fingerprint(second)
    del kept["layernorm.weight"]
    save_file(kept, folder / "model.safetensors", metadata={"format": "pt"})
    refused(f"hf:{folder}", "1 weights are not in the file, first layernorm.weight")


def test_pickles_are_not_read(tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    torch.save(load_file(folder / "model.safetensors"), folder / "pytorch_model.bin")
    (folder / "model.safetensors").unlink()
    refused(f"hf:{folder}", "no model.safetensors")


@pytest.mark.parametrize(
    "file, content, match",
    [
        ("model.safetensors", b"<html>404</html>" + bytes(1 << 20), "cannot be loaded"),
        ("config.json", b"{", "config.json"),
        ("config.json", b'{"model_type": "no such"}', "config.json"),
        ("preprocessor_config.json", b"{", "preprocessor_config.json is not JSON"),
        ("preprocessor_config.json", b"[]", "contains a list"),
        ("preprocessor_config.json", b'{"image_mean": [0.5], "image_std": [1]}', "expected three numbers"),
    ],
)
def test_damaged_folders_are_refused_in_one_line(file, content, match, tmp_path):
    folder = save_model(tmp_path / "vit", configuration("vit"))
    (folder / file).write_bytes(content)
    refused(f"hf:{folder}", match)


def test_a_folder_that_is_no_model_is_refused(tmp_path):
    refused(f"hf:{tmp_path}", "no config.json")


# the hub


@pytest.fixture()
def offline(tmp_path, monkeypatch) -> Path:
    """No hub, and an empty cache."""
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_where_the_hub_cannot_be_reached_the_one_line_says_so(offline):
    refused("hf:facebook/dinov2-small", "hub cannot be reached; .* zsp-lite weights fetch hf:facebook/dinov2-small")


def test_what_is_in_the_cache_needs_no_hub(offline, pictures):
    repository = offline / "models--someone--small"
    (repository / "refs").mkdir(parents=True)
    (repository / "refs" / "main").write_text("0" * 40)
    folder = save_model(repository / "snapshots" / ("0" * 40), configuration("vit"))
    backbone = load_backbone("hf:someone/small", "cpu")
    assert backbone.name == "hf:someone/small"
    assert backbone(pictures)[0].grid == (14, 14)
    assert download("hf:someone/small").samefile(folder)
    verify("hf:someone/small")


@pytest.mark.parametrize(
    "error, match",
    [
        (huggingface_hub.errors.GatedRepoError, "licence.*https://huggingface.co/someone/closed"),
        (huggingface_hub.errors.RepositoryNotFoundError, "no such public model"),
        (OSError, "cannot be downloaded.*503 Service Unavailable"),
    ],
)
def test_what_the_hub_refuses_is_told_in_one_line(error, match, monkeypatch):
    def refuse(name, local_files_only=False, **_):
        if local_files_only:
            raise huggingface_hub.errors.LocalEntryNotFoundError("not here")
        # The hub's own errors want a whole HTTP response to be made from.
        raise error("503\n\nService Unavailable") if error is OSError else error.__new__(error)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", refuse)
    refused("hf:someone/closed", match)


@pytest.mark.parametrize("name", ["hf:", "hf:a/b/c", "hf:../nowhere", "hf:a b"])
def test_what_is_neither_a_folder_nor_a_name_is_refused(name, offline):
    refused(name, "folder.* hub name OWNER/MODEL")

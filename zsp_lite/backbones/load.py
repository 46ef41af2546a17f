"""Loading of backbones, from a checkpoint file, a model in Hugging Face's format, or by name.

There are names for the backbone in the package, and for the DINO models of Caron et al. (2021).
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import torch

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD, Backbone
from zsp_lite.backbones.checkpoints import build_vit, metadata_integers, read_checkpoint
from zsp_lite.backbones.huggingface import PREFIX, load_huggingface, model_folder
from zsp_lite.choices import Facet
from zsp_lite.errors import InputError, check_choice
from zsp_lite.features import FeatureExtractor
from zsp_lite.io.download import cache_folder, fetch, has_size_and_hash
from zsp_lite.io.modules import import_object

# Address of the released files, unless the environment variable ZSP_LITE_DINO_URL gives another
# one.
DINO_URL = "https://dl.fbaipublicfiles.com/dino/"
# Limit of the size of a released file: a ViT-B, the largest, has 86 million weights of 4 bytes.
MOST_BYTES = 400_000_000
# The backbone that is part of the package: its name and its file.
DEFAULT = "zsp-tiny"
TINY = Path(__file__).parents[1] / "weights/zsp-tiny.safetensors"


@dataclass(frozen=True)
class PretrainedWeights:
    """A released checkpoint."""

    file: str  # path below the DINO URL
    # First digits of the file's MD5 digest in hexadecimal; only these were published.
    md5_prefix: str
    size: int | None = None  # bytes, None where it is not known

    @property
    def url(self) -> str:
        """Address of the file."""
        return os.environ.get("ZSP_LITE_DINO_URL", DINO_URL).rstrip("/") + "/" + self.file

    @property
    def path(self) -> Path:
        """Path of the downloaded file."""
        return cache_folder() / Path(self.file).name


PRETRAINED = {
    "dino_vits8": PretrainedWeights(
        "dino_deitsmall8_pretrain/dino_deitsmall8_pretrain.pth", "230cd5", 86_728_949
    ),
    "dino_vits16": PretrainedWeights(
        "dino_deitsmall16_pretrain/dino_deitsmall16_pretrain.pth", "cf0f22"
    ),
    "dino_vitb8": PretrainedWeights("dino_vitbase8_pretrain/dino_vitbase8_pretrain.pth", "556550"),
    "dino_vitb16": PretrainedWeights(
        "dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth", "552daf"
    ),
}
_IMPORT_PATH = r"[\w.]+:[\w.]+"  # module:name


@dataclass(frozen=True)
class BackboneConfig:
    """Name of a backbone with the options that change its features; picklable.

    `load_backbone` accepts it in place of a name and documents the options.
    """

    name: str
    layer: int | str | None = None
    facet: Facet = "key"
    image_size: int | None = None


# A backbone, or what `load_backbone` takes.
BackboneLike = FeatureExtractor | str | Path | BackboneConfig


def load_backbone(
    name_or_path: str | Path | BackboneConfig = DEFAULT,
    device: str | torch.device | None = None,
    *,
    layer: int | str | None = None,
    facet: Facet = "key",
    image_size: int | None = None,
) -> Backbone:
    """Load a backbone.

    Args:
        name_or_path: One of:

            - a name of `available_backbones`: "zsp-tiny" (part of the package), or a DINO model
              such as "dino_vits8", which is downloaded to `cache_folder()` on first use;
            - a checkpoint in the DINO layout: a .safetensors file, or a torch file of tensors only,
              also nested under "teacher", "state_dict" or "model". Metadata of a .safetensors file
              may give the number of heads ("num_heads", default: one per 64 channels), the block
              ("key_block") and "saliency_heads";
            - "hf:NAME": a model of the Hugging Face hub or a folder in its format (needs the
              package transformers);
            - a `BackboneConfig`, without further options.
        device: Default: the GPU if there is one, else the CPU.
        layer: Block that describes the patches: "block9", "last", or an integer from 0; negative
            integers count from the end. Default: the checkpoint's metadata, else block 9 counted
            from 0, as in the published code (the paper writes "the 9th ViT layer"); three quarters
            of the depth for "hf:NAME".
        facet: Activation of that block used as descriptor: "key" (as in the paper), "query",
            "value", or "token" (the block's output).
        image_size: Side in pixels to which images are resized, rounded to a multiple of the patch
            size. Default: the checkpoint's; 224 for "hf:NAME".

    Raises:
        InputError: If the name or an option is unknown, a download fails, the file is not such a
            checkpoint, or options are given beside a `BackboneConfig`.
    """
    options = {"layer": layer, "facet": facet, "image_size": image_size}
    config = name_or_path
    if not isinstance(config, BackboneConfig):
        config = BackboneConfig(str(name_or_path), **options)
    # A config has the options already: all others must be the defaults.
    elif BackboneConfig("", **options) != BackboneConfig(""):
        raise InputError(f"got {options} beside {config}, expected them in the config only")

    load = _load_huggingface if config.name.startswith(PREFIX) else _load_checkpoint
    backbone = load(config, device)

    # Options other than the defaults are part of the name: benchmark runs are distinguished by it.
    parts = []
    if config.layer is not None:
        parts.append(f"block{backbone.layer}")
    if config.facet != "key":
        parts.append(config.facet)
    if config.image_size is not None:
        parts.append(f"{config.image_size} px")
    if parts:
        backbone.name += f" ({', '.join(parts)})"
    return backbone


def as_backbone(backbone: BackboneLike) -> FeatureExtractor:
    """Return a backbone as it is; load one that is given by name, file or config."""
    if isinstance(backbone, str | Path | BackboneConfig):
        return load_backbone(backbone)
    return backbone


def named_backbone(
    name: str, layer: str | None, facet: Facet, image_size: int | None
) -> BackboneLike:
    """Return what `as_backbone` takes for a name with options.

    "module:thing" is imported: a backbone of the user's own.
    """
    config = BackboneConfig(name, layer, facet, image_size)
    has_options = config != BackboneConfig(name)
    if name.startswith(PREFIX) or os.path.isfile(name) or not re.fullmatch(_IMPORT_PATH, name):
        return config if has_options else name
    extractor = import_object(name)
    if isinstance(extractor, type) or not callable(extractor):
        raise InputError(
            f"backbone {name!r} is of type {type(extractor).__name__}, "
            "expected a function of images"
        )
    if has_options:
        raise InputError(
            f"backbone {name!r} is your own, expected no layer, facet or image size beside it"
        )
    return extractor


def available_backbones() -> dict[str, Path | None]:
    """Return the names of all backbones with their file, or None if it is not downloaded."""
    paths = {DEFAULT: TINY}
    for name, weights in PRETRAINED.items():
        paths[name] = weights.path
    return {name: path if path.is_file() else None for name, path in paths.items()}


def how_to_obtain(name: str) -> str:
    """Say how to get the file of a backbone for which `available_backbones` has None."""
    if name == DEFAULT:
        return "missing: reinstall zsp-lite"
    return f"not downloaded: zsp-lite weights fetch {name}"


def download(name: str) -> Path:
    """Return the file of a named backbone, or the folder of "hf:NAME"; download it if missing.

    InputError if the file is not the released one.
    """
    if name.startswith(PREFIX):
        return model_folder(name)
    if name == DEFAULT:
        return TINY
    check_choice("backbone", name, available_backbones())
    weights = PRETRAINED[name]
    try:
        path = fetch(weights.url, weights.path, weights.size, weights.md5_prefix, most=MOST_BYTES)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; download that file on another machine and copy it to "
            f"{weights.path}, or use {DEFAULT}"
        ) from error
    # `fetch` checks what it downloads, but not a file that exists already.
    if not has_size_and_hash(path, weights.size, weights.md5_prefix):
        raise InputError(
            f"{name}: {path} is not the released file, expected "
            f"{weights.size or 'any number of'} bytes with MD5 "
            f"{weights.md5_prefix}...; remove it, then run zsp-lite weights fetch {name}"
        )
    return path


def _load_huggingface(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    """Load the backbone of "hf:NAME"."""
    model, normalisation = load_huggingface(config.name, config.image_size)
    mean, std = normalisation or (IMAGENET_MEAN, IMAGENET_STD)
    # A folder is named without its parents, so that results do not depend on where it lies.
    folder = Path(config.name.removeprefix(PREFIX)).expanduser()
    label = PREFIX + folder.resolve().name if os.path.isdir(folder) else config.name
    # Three quarters of the depth, as block 9 is of DINO's 12 blocks.
    layer = 3 * model.depth // 4 if config.layer is None else config.layer
    # One image at a time, because transformers returns the attention of all blocks.
    return Backbone(
        model,
        label,
        layer,
        range(model.num_heads),
        device,
        batch_size=1,
        facet=config.facet,
        mean=mean,
        std=std,
    )


def _load_checkpoint(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    """Load a backbone from a checkpoint in the DINO layout."""
    name = config.name
    path = Path(name).expanduser()
    if name in available_backbones():
        path = download(name)
        label = name
    elif os.path.isfile(path):  # False for a name that is too long, where Path.is_file raises
        label = path.stem
    else:
        raise InputError(
            f"backbone {name!r}: neither a file nor one of "
            f"{', '.join(available_backbones())}, nor {PREFIX}NAME"
        )
    weights, metadata = read_checkpoint(path)
    # Each is a list of integers, or None if the file has no such entry. The first two have one
    # entry.
    num_heads = metadata_integers(metadata, "num_heads", path)
    key_block = metadata_integers(metadata, "key_block", path)
    saliency_heads = metadata_integers(metadata, "saliency_heads", path)
    model = build_vit(weights, num_heads[0] if num_heads else None, path)
    layer = key_block[0] if config.layer is None and key_block else config.layer
    return Backbone(
        model,
        label,
        layer,
        saliency_heads,
        device,
        facet=config.facet,
        image_size=config.image_size,
    )

"""Loading of backbones, from a checkpoint file, a model in Hugging Face's format, or by name.

The modules for models in Hugging Face's format and for the released DINO models are imported when
such a name is loaded.
"""

import os
import pkgutil
from dataclasses import dataclass
from pathlib import Path

import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.checkpoints import build_vit, metadata_integers, read_checkpoint
from zsp_lite.choices import Facet
from zsp_lite.errors import InputError

# The backbone that is part of the package: its name and its file.
DEFAULT = "zsp-tiny"
TINY = Path(__file__).parents[1] / "weights/zsp-tiny.safetensors"
# What names of models in Hugging Face's format begin with.
PREFIX = "hf:"


@dataclass(frozen=True)
class BackboneConfig:
    """Name of a backbone with the options that change its features; picklable.

    `load_backbone` accepts it in place of a name and documents the options.
    """

    name: str
    layer: int | str | None = None
    facet: Facet = "key"
    image_size: int | None = None


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

    load = _load_checkpoint
    if config.name.startswith(PREFIX):
        load = pkgutil.resolve_name("zsp_lite.backbones.huggingface:load_huggingface")
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


def _find_checkpoint(name: str) -> tuple[Path, str]:
    """Return the checkpoint file of a name or path, and the name of its backbone."""
    if name == DEFAULT:
        return TINY, name
    released = pkgutil.resolve_name("zsp_lite.backbones.released")
    if name in released.PRETRAINED:
        return released.download(name), name
    path = Path(name).expanduser()
    if os.path.isfile(path):  # False for a name that is too long, where Path.is_file raises
        return path, path.stem
    raise InputError(
        f"backbone {name!r}: neither a file nor one of "
        f"{', '.join(released.available_backbones())}, nor {PREFIX}NAME"
    )


def _load_checkpoint(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    """Load a backbone from a checkpoint in the DINO layout."""
    path, label = _find_checkpoint(config.name)
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

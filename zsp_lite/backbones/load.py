"""Loading of backbones: by name, from a checkpoint file, or from a model in Hugging Face's format."""

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from zsp_lite.backbones.backbone import IMAGENET_MEAN, IMAGENET_STD, Backbone
from zsp_lite.backbones.checkpoints import build_vit, metadata_integers, read_checkpoint
from zsp_lite.backbones.huggingface import PREFIX, load_huggingface
from zsp_lite.backbones.pretrained import DEFAULT, available_backbones, check_authentic, download, obtained_by
from zsp_lite.choices import Facet
from zsp_lite.errors import InputError


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

            - a name of `available_backbones`: "zsp-tiny" (part of the package), or a DINO model such as "dino_vits8",
              which is downloaded to `cache_folder()` on first use;
            - a checkpoint in the DINO layout: a .safetensors file, or a torch file of tensors only, also nested under
              "teacher", "state_dict" or "model". Metadata of a .safetensors file may give the number of heads
              ("num_heads", default: one per 64 channels), the block ("key_block") and "saliency_heads";
            - "hf:NAME": a model of the Hugging Face hub or a folder in its format (needs the package transformers);
            - a `BackboneConfig`, without further options.
        device: Default: the GPU if there is one, else the CPU.
        layer: Block that describes the patches: "block9", "last", or an integer from 0; negative integers count from
            the end. Default: the checkpoint's metadata, else block 9 counted from 0, as in the published code (the
            paper writes "the 9th ViT layer"); three quarters of the depth for "hf:NAME".
        facet: Activation of that block used as descriptor: "key" (as in the paper), "query", "value", or "token" (the
            block's output).
        image_size: Side in pixels to which images are resized, rounded to a multiple of the patch size. Default:
            the checkpoint's; 224 for "hf:NAME".

    Raises:
        InputError: If the name or an option is unknown, a download fails, the file is not such a checkpoint, or options
            are given beside a `BackboneConfig`.
    """
    options = {"layer": layer, "facet": facet, "image_size": image_size}
    config = name_or_path
    if not isinstance(config, BackboneConfig):
        config = BackboneConfig(str(name_or_path), **options)
    elif options != {"layer": None, "facet": "key", "image_size": None}:
        raise InputError(f"got {options} beside {config}, expected them in the config only")
    load = _load_huggingface if config.name.startswith(PREFIX) else _load_checkpoint
    backbone = load(config, device)
    # The options are part of the name, because benchmark runs are distinguished by it.
    parts = [] if config.layer is None else [f"block{backbone.layer}"]
    parts += [] if config.facet == "key" else [config.facet]
    parts += [] if config.image_size is None else [f"{config.image_size} px"]
    if parts:
        backbone.name = f"{backbone.name} ({', '.join(parts)})"
    return backbone


def verify(name_or_path: str | Path) -> None:
    """Raise InputError unless a backbone is there, loads, and has finite features of an image."""
    name = str(name_or_path)
    if available_backbones().get(name, name) is None:
        raise InputError(f"backbone {name}: {obtained_by(name)}")
    backbone = load_backbone(name_or_path, "cpu")
    side = backbone.image_size
    backbone([np.broadcast_to(np.linspace(0, 255, side, dtype=np.uint8)[:, None, None], (side, side, 3))])


def _load_huggingface(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    model, normalisation = load_huggingface(config.name, config.image_size)
    mean, std = normalisation or (IMAGENET_MEAN, IMAGENET_STD)
    folder = Path(config.name.removeprefix(PREFIX)).expanduser()
    label = PREFIX + folder.resolve().name if os.path.isdir(folder) else config.name
    layer = 3 * model.depth // 4 if config.layer is None else config.layer
    # One image at a time, because transformers returns the attention of all blocks.
    return Backbone(
        model, label, layer, range(model.num_heads), device, batch_size=1, facet=config.facet, mean=mean, std=std
    )


def _load_checkpoint(config: BackboneConfig, device: str | torch.device | None) -> Backbone:
    name, path = config.name, Path(config.name).expanduser()
    if name in available_backbones():
        path, label = download(name), name
        check_authentic(name, path)
    elif os.path.isfile(path):  # False for a name that is too long, where Path.is_file raises
        label = path.stem
    else:
        raise InputError(
            f"backbone {name!r}: neither a file nor one of {', '.join(available_backbones())}, nor {PREFIX}NAME"
        )
    weights, metadata = read_checkpoint(path)
    num_heads, key_block, saliency_heads = (
        metadata_integers(metadata, key, path) for key in ("num_heads", "key_block", "saliency_heads")
    )
    model = build_vit(weights, num_heads[0] if num_heads else None, path)
    layer = key_block[0] if config.layer is None and key_block else config.layer
    return Backbone(model, label, layer, saliency_heads, device, facet=config.facet, image_size=config.image_size)

"""Loading of backbones: by name, from a checkpoint file, or from a model in Hugging Face's format."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.checkpoints import build_vit, metadata_integer, metadata_integers, read_checkpoint
from zsp_lite.backbones.facets import Facet, block_index, check_facet
from zsp_lite.backbones.huggingface import PREFIX, load_huggingface
from zsp_lite.backbones.pretrained import (
    DEFAULT,
    available_backbones,
    check_geometry,
    download,
    using,
    verify_download,
)
from zsp_lite.errors import InputError


@dataclass(frozen=True)
class BackboneConfig:
    """Name of a backbone with the options that change its features; picklable.

    `load_backbone` accepts it in place of a name and documents the options. Raises InputError for an unknown facet.
    """

    name: str
    layer: int | str | None = None
    facet: Facet = "key"
    image_size: int | None = None

    def __post_init__(self):
        check_facet(self.facet, self.name)


def load_backbone(
    name_or_path: str | Path | BackboneConfig = DEFAULT,
    device: str | torch.device | None = None,
    *,
    num_heads: int | None = None,
    layer: int | str | None = None,
    facet: Facet | None = None,
    saliency_heads: Sequence[int] | None = None,
    image_size: int | None = None,
    batch_size: int = 8,
) -> Backbone:
    """Load a backbone.

    Args:
        name_or_path: One of:

            - a name of `available_backbones`: "zsp-tiny" (part of the package), or a DINO model such as "dino_vits8",
              which is downloaded to `cache_folder()` on first use;
            - a checkpoint in the DINO layout: a .safetensors file, or a torch file of tensors only, also nested under
              "teacher", "state_dict" or "model";
            - "hf:NAME": a model of the Hugging Face hub or a folder in its format (needs the extra "transformers");
            - a `BackboneConfig`, whose layer, facet and image_size then must not be given a second time.
        device: Default: the GPU if there is one, else the CPU.
        num_heads: Default: the checkpoint's metadata, else one head per 64 channels. Not for "hf:NAME".
        layer: Block that describes the patches: "block9", "last", or an integer from 0; negative integers count from
            the end. Default: the checkpoint's metadata, else block 9 counted from 0, as in the published code (the
            paper writes "the 9th ViT layer"); three quarters of the depth for "hf:NAME".
        facet: Activation of that block used as descriptor: "key" (default, as in the paper), "query", "value", or
            "token" (the block's output).
        saliency_heads: Heads of the last block whose CLS attention is averaged. Default: the checkpoint's metadata,
            else see `Backbone`; all heads for "hf:NAME".
        image_size: Side in pixels to which images are resized, rounded to a multiple of the patch size. Default:
            the checkpoint's; 224 for "hf:NAME".
        batch_size: Number of images in one forward pass.

    Raises:
        InputError: If the name, layer or facet is unknown, a download fails, the file is not such a checkpoint, or an
            option is given that this backbone does not have, or beside a `BackboneConfig` that has it.
    """
    if isinstance(name_or_path, BackboneConfig):
        config = name_or_path
        where = f" beside {config}, expected them in the config only"
        _refuse(config.name, where, layer=layer, facet=facet, image_size=image_size)
        name, layer, facet, image_size = config.name, config.layer, config.facet, config.image_size
    else:
        name = str(name_or_path)
        facet = check_facet("key" if facet is None else facet, name)
    options = {"device": device, "batch_size": batch_size, "facet": facet}

    def full_name(label: str, depth: int) -> str:
        """Name with the options that differ from the default, because benchmark runs are distinguished by name."""
        parts = [] if layer is None else [f"block{block_index(layer, depth, name)}"]
        parts += [] if facet == "key" else [facet]
        parts += [] if image_size is None else [f"{image_size} px"]
        return f"{label} ({', '.join(parts)})" if parts else label

    if name.startswith(PREFIX):
        _refuse(name, ", expected none: the model's configuration has it", num_heads=num_heads)
        model = load_huggingface(name, image_size)
        block = 3 * model.depth // 4 if layer is None else layer
        heads = range(model.num_heads) if saliency_heads is None else saliency_heads
        if model.mean is not None:
            options |= {"mean": model.mean, "std": model.std}
        folder = Path(name.removeprefix(PREFIX)).expanduser()
        label = PREFIX + folder.resolve().name if os.path.isdir(folder) else name
        return Backbone(model, full_name(label, model.depth), block, heads, **options)

    path = Path(name).expanduser()
    if name in available_backbones():
        path, label = download(name), name
    elif os.path.isfile(path):  # False for a name that is too long, where Path.is_file raises
        label = path.stem
    else:
        raise InputError(
            f"backbone {name!r}: neither a file nor one of {', '.join(available_backbones())}, nor {PREFIX}NAME"
        )
    with using(name, path):
        weights, metadata = read_checkpoint(path)
        model = build_vit(weights, num_heads or metadata_integer(metadata, "num_heads", path), path.name)
        check_geometry(name, model)
    block = metadata_integer(metadata, "key_block", path) if layer is None else layer
    if saliency_heads is None:
        saliency_heads = metadata_integers(metadata, "saliency_heads", path)
    return Backbone(model, full_name(label, model.depth), block, saliency_heads, image_size=image_size, **options)


def verify(name_or_path: str | Path) -> None:
    """Check that a backbone is complete, loads, and has finite features of an image.

    Raises:
        InputError: It is not downloaded, differs from the released file, cannot be loaded, or overflows.
    """
    name = str(name_or_path)
    verify_download(name)
    backbone = load_backbone(name_or_path, "cpu")
    side = backbone.image_size
    ramp = np.broadcast_to(np.linspace(0, 255, side, dtype=np.uint8)[:, None, None], (side, side, 3))
    try:
        backbone([ramp])
    except InputError as error:
        raise InputError(f"{name_or_path}: {error}") from error


def _refuse(name: str, reason: str, **options) -> None:
    """Raise InputError if an option is not None."""
    if given := [f"{option} {value!r}" for option, value in options.items() if value is not None]:
        raise InputError(f"{name}: got {', '.join(given)}{reason}")

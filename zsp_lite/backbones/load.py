"""Loading of backbones: by name, from a checkpoint file, from a model in Hugging Face's format, or several of these."""

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.checkpoints import build_vit, load_weights, metadata_integer, metadata_integers, read_checkpoint
from zsp_lite.backbones.combined import CombinedBackbone, is_combination, parse_combination
from zsp_lite.backbones.convolutional import ConvolutionalBackbone, ConvolutionalNetwork
from zsp_lite.backbones.efficientnet import EfficientNetLite0
from zsp_lite.backbones.facets import Facet, block_index, check_facet
from zsp_lite.backbones.huggingface import PREFIX, load_huggingface
from zsp_lite.backbones.photo_informed import CHANNELS, TRANSFORMER, PhotoInformedViT
from zsp_lite.backbones.positions import SUFFIX, load_position_head
from zsp_lite.backbones.precision import Precision
from zsp_lite.backbones.pretrained import (
    DEFAULT,
    EMBEDDED,
    available_backbones,
    check_geometry,
    check_shipped,
    download,
    using,
    verify_download,
)
from zsp_lite.errors import InputError
from zsp_lite.io.files import plain_name

# Convolutional networks with trained weights, by name. `pretrained.PACKAGED` says where the weights are.
CONVOLUTIONAL: dict[str, Callable[[], ConvolutionalNetwork]] = {"effnet-lite0": EfficientNetLite0}


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
    precision: Precision = "float32",
    batch_size: int = 8,
) -> Backbone | ConvolutionalBackbone | CombinedBackbone:
    """Load a backbone.

    Args:
        name_or_path: One of:

            - a name of `available_backbones`: "zsp-tiny-photo" or "zsp-tiny" (part of the package), or a DINO model
              such as "dino_vits8", which is downloaded to `cache_folder()` on first use;
            - "effnet-lite0", a convolutional network trained with ImageNet's class labels, which has no saliency;
            - a checkpoint in the DINO layout: a .safetensors file, or a torch file of tensors only, also nested under
              "teacher", "state_dict" or "model";
            - "hf:NAME": a model of the Hugging Face hub or a folder in its format (needs the extra "transformers");
            - several of the above joined by "+", each with an optional weight, such as "zsp-tiny+0.5*effnet-lite0" (see
              `CombinedBackbone`); device, precision and batch_size are the only options;
            - a `BackboneConfig`, whose layer, facet and image_size then must not be given a second time.
        device: Default: the GPU if there is one, else the CPU.
        num_heads: Default: the checkpoint's metadata, else one head per 64 channels. Not for "hf:NAME" and
            "effnet-lite0".
        layer: Block that describes the patches: "block9", "last", or an integer from 0; negative integers count from
            the end. Default: the checkpoint's metadata, else block 9 counted from 0, as in the published code (the
            paper writes "the 9th ViT layer"); three quarters of the depth for "hf:NAME"; block 10 of "effnet-lite0".
        facet: Activation of that block used as descriptor: "key" (default, as in the paper), "query", "value", or
            "token" (the block's output). Not for "effnet-lite0".
        saliency_heads: Heads of the last block whose CLS attention is averaged. Default: the checkpoint's metadata,
            else see `Backbone`; all heads for "hf:NAME". Not for "effnet-lite0".
        image_size: Side in pixels to which images are resized, rounded to a multiple of the patch size (of 32
            with photo features). Default: the checkpoint's; 224 for "hf:NAME", 448 for "effnet-lite0".
        precision: "bfloat16" runs the network in bfloat16 where the device computes it faster than float32; elsewhere
            float32 is used and a warning is logged.
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
    options = {"device": device, "precision": precision, "batch_size": batch_size}
    # None where they have their default.
    of_attention = {
        "num_heads": num_heads,
        "saliency_heads": saliency_heads,
        "facet": None if facet == "key" else facet,
    }

    if is_combination(name):
        names, weights = parse_combination(name)
        _refuse(name, ", expected none for a combination", layer=layer, image_size=image_size, **of_attention)
        return CombinedBackbone([load_backbone(part, **options) for part in names], weights)

    def full_name(label: str, depth: int) -> str:
        """Name with the options that differ from the default, because benchmark runs are distinguished by name."""
        parts = [] if layer is None else [f"block{block_index(layer, depth, name)}"]
        parts += [] if facet == "key" else [facet]
        parts += [] if image_size is None else [f"{image_size} px"]
        return f"{label} ({', '.join(parts)})" if parts else label

    if name in CONVOLUTIONAL:
        _refuse(name, ", expected none for a convolutional network", **of_attention)
        network = CONVOLUTIONAL[name]()
        return ConvolutionalBackbone(network, full_name(name, network.depth), layer, image_size=image_size, **options)

    options["facet"] = facet
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
            f"backbone {name!r}: neither a file nor one of {', '.join(available_backbones())}, nor {PREFIX}NAME, nor "
            "several of these joined by +"
        )
    with using(name, path):
        weights, metadata = read_checkpoint(path)
        photo_input = None
        if TRANSFORMER in metadata:
            photo_input, photo_path, path = weights, path, _transformer_beside(path, metadata)
            if path in EMBEDDED.values():
                check_shipped(path)
            weights, metadata = read_checkpoint(path)
        model = build_vit(weights, num_heads or metadata_integer(metadata, "num_heads", path), path.name)
        check_geometry(name, model)
        if photo_input is not None:
            model = PhotoInformedViT(model)
            load_weights(model.photo_input, photo_input, photo_path.name)
            options |= {"mean": (0.0, 0.0, 0.0), "std": (1.0, 1.0, 1.0)}  # the network normalises its parts' inputs
    block = metadata_integer(metadata, "key_block", path) if layer is None else layer
    if saliency_heads is None:
        saliency_heads = metadata_integers(metadata, "saliency_heads", path)
    if photo_input is not None and layer is None and facet == "key" and image_size is None:
        head = photo_path.with_name(photo_path.stem + SUFFIX)
        if head.is_file():
            if photo_path in EMBEDDED.values():
                check_shipped(head)
            options["position_head"] = load_position_head(head, model.embed_dim, CHANNELS)
    return Backbone(model, full_name(label, model.depth), block, saliency_heads, image_size=image_size, **options)


def verify(name_or_path: str | Path) -> None:
    """Check that a backbone is complete, loads, and has finite features of an image.

    Raises:
        InputError: It is not downloaded, differs from the released file, cannot be loaded, or overflows.
    """
    name = str(name_or_path)
    for part in parse_combination(name)[0] if is_combination(name) else [name]:
        verify_download(part)
    backbone = load_backbone(name_or_path, "cpu")
    side = backbone.image_size
    ramp = np.broadcast_to(np.linspace(0, 255, side, dtype=np.uint8)[:, None, None], (side, side, 3))
    try:
        backbone([ramp])
    except InputError as error:
        raise InputError(f"{name_or_path}: {error}") from error


def _transformer_beside(path: Path, metadata: dict[str, str]) -> Path:
    """Return the file of the transformer that a photo input belongs to; it is in the same folder."""
    transformer = path.with_name(plain_name(metadata[TRANSFORMER], f"checkpoint {path}: transformer"))
    if not transformer.is_file():
        raise InputError(f"{path} is the photo input of {transformer.name}, expected that file beside it")
    return transformer


def _refuse(name: str, reason: str, **options) -> None:
    """Raise InputError if an option is not None."""
    if given := [f"{option} {value!r}" for option, value in options.items() if value is not None]:
        raise InputError(f"{name}: got {', '.join(given)}{reason}")

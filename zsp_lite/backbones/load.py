"""Backbones by name or by checkpoint file, and what makes one: images in, one FeatureMap each out.

The released DINO models (Caron et al. 2021) are plain data below; "zsp-tiny" is this project's own small
model, part of the package. Any checkpoint in the DINO layout works by its path; its geometry is read off its shapes.
"hf:NAME" is a vision transformer in Hugging Face's format (see `huggingface`).
"""

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from zsp_lite.backbones.checkpoints import build_vit, read_checkpoint
from zsp_lite.backbones.facets import Facet, block_index, check_facet, extract
from zsp_lite.backbones.huggingface import PREFIX, HuggingFaceViT, load_huggingface, model_folder, nearest_multiple
from zsp_lite.backbones.precision import Precision, autocast, supported_precision
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.features import FeatureMap
from zsp_lite.io.download import cache_folder, fetch, has_size_and_hash

Image = Float[np.ndarray, "_ _ 3"] | UInt8[np.ndarray, "_ _ 3"] | Float[Tensor, "_ _ 3"] | UInt8[Tensor, "_ _ 3"]

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
DINO_URL = "https://dl.fbaipublicfiles.com/dino/"  # $ZSP_LITE_DINO_URL overrides it
TINY = Path(__file__).parents[1] / "weights" / "zsp-tiny.safetensors"


@dataclass(frozen=True)
class BackboneConfig:
    """A backbone by name, with the options that decide what it says of a picture; not loaded yet.

    Small enough to be sent to other machines, and as good as a name for `load_backbone`, which explains the options.
    Raises InputError for a facet that there is not.
    """

    name: str
    layer: int | str | None = None
    facet: str = "key"
    image_size: int | None = None

    def __post_init__(self):
        check_facet(self.facet, self.name)


@dataclass(frozen=True)
class PretrainedWeights:
    """A checkpoint that others host."""

    file: str  # below DINO_URL
    md5_prefix: str
    size: int | None = None  # bytes, where known

    @property
    def url(self) -> str:
        return os.environ.get("ZSP_LITE_DINO_URL", DINO_URL).rstrip("/") + "/" + self.file

    @property
    def path(self) -> Path:
        return cache_folder() / Path(self.file).name


PRETRAINED = {
    "dino_vits8": PretrainedWeights("dino_deitsmall8_pretrain/dino_deitsmall8_pretrain.pth", "230cd5", 86_728_949),
    "dino_vits16": PretrainedWeights("dino_deitsmall16_pretrain/dino_deitsmall16_pretrain.pth", "cf0f22"),
    "dino_vitb8": PretrainedWeights("dino_vitbase8_pretrain/dino_vitbase8_pretrain.pth", "556550"),
    "dino_vitb16": PretrainedWeights("dino_vitbase16_pretrain/dino_vitbase16_pretrain.pth", "552daf"),
}


class Backbone:
    """A vision transformer ready for the method: call it on a list of images.

    Attributes: name, image_size (pixels, square), patch_size, embed_dim, key_block (0-based), facet, saliency_heads,
    mean, std (of RGB in [0, 1], normalised by), device, precision, batch_size, model.
    """

    def __init__(
        self,
        model: VisionTransformer | HuggingFaceViT,
        name: str,
        key_block: int | str | None = None,
        saliency_heads: Sequence[int] | None = None,
        device: str | torch.device | None = None,
        precision: Precision = "float32",
        batch_size: int = 8,
        facet: Facet = "key",
        image_size: int | None = None,
        mean: Sequence[float] = IMAGENET_MEAN,
        std: Sequence[float] = IMAGENET_STD,
    ):
        if precision not in ("float32", "bfloat16"):
            raise InputError(f"precision: expected 'float32' or 'bfloat16', got {precision!r}")
        if batch_size < 1:
            raise InputError(f"batch_size: expected at least 1, got {batch_size}")
        if key_block is None:
            key_block = min(9, model.depth - 1)  # the paper's ninth layer
        if saliency_heads is None:
            # Of DINO's ViT-S these heads see objects best (Amir et al. 2021); of others nothing is known.
            small = (model.embed_dim, model.num_heads, model.depth) == (384, 6, 12)
            saliency_heads = (0, 2, 4, 5) if small else range(model.num_heads)
        saliency_heads = tuple(int(head) for head in saliency_heads)
        key_block = block_index(key_block, model.depth, name)
        if not saliency_heads or not set(saliency_heads) <= set(range(model.num_heads)):
            raise InputError(
                f"{name}: saliency_heads are {saliency_heads}, expected some of 0 to {model.num_heads - 1}"
            )
        self.name, self.key_block, self.saliency_heads = name, key_block, saliency_heads
        self.facet, self.mean, self.std = check_facet(facet, name), tuple(mean), tuple(std)
        self.batch_size = batch_size
        self.patch_size, self.embed_dim = model.patch_size, model.embed_dim
        self.image_size = nearest_multiple(model.image_size if image_size is None else image_size, model.patch_size)
        self.device = _device(device)
        self.precision = supported_precision(precision, self.device.type)
        self.model = model.to(self.device).eval().requires_grad_(False)

    def __call__(self, images: Sequence[Image]) -> list[FeatureMap]:
        """Features of (H, W, 3) images, uint8 or float in [0, 1], of any sizes, in float32 on its device.

        Images are resized to a square (of 224 pixels unless told) without keeping their aspect, as in the paper.
        A FeatureMap's keys are the chosen facet of the chosen block.
        Saliency is the CLS attention averaged over the saliency heads, minimum
        to 0, maximum to 1. Raises InputError on others.
        """
        features = []
        for first in range(0, len(images), self.batch_size):
            batch = prepare_images(images[first : first + self.batch_size], self.image_size, first)
            features += self._extract(batch.to(self.device))
        return features

    def _extract(self, batch: Float[Tensor, "b 3 s s"]) -> list[FeatureMap]:
        with torch.inference_mode(), autocast(self.device.type, self.precision):
            mean, std = (batch.new_tensor(x).view(3, 1, 1) for x in (self.mean, self.std))
            tokens = extract(self.model, (batch - mean) / std, self.key_block, self.facet)
            saliency = tokens.attention[:, list(self.saliency_heads)].float().mean(1)
            low, high = saliency.amin(1, keepdim=True), saliency.amax(1, keepdim=True)
            saliency = (saliency - low) / (high - low).clamp_min(1e-12)
            grids = tokens.keys.unflatten(1, tokens.grid), saliency.unflatten(1, tokens.grid), tokens.cls
        # Copies made outside inference mode: ordinary tensors, on which a trainable layer may be put, and
        # which do not keep the whole batch's queries, keys and values alive.
        return [FeatureMap(*(x.to(torch.float32, copy=True) for x in one)) for one in zip(*grids)]


def load_backbone(
    name_or_path: str | Path | BackboneConfig = "zsp-tiny",
    device: str | torch.device | None = None,
    *,
    num_heads: int | None = None,
    layer: int | str | None = None,
    facet: Facet = "key",
    key_block: int | None = None,
    saliency_heads: Sequence[int] | None = None,
    image_size: int | None = None,
    precision: Precision = "float32",
    batch_size: int = 8,
) -> Backbone:
    """A backbone by name ("zsp-tiny", "dino_vits8", ...: see `available_backbones`), by checkpoint file, or "hf:NAME".

    DINO models are downloaded on first use to `cache_folder()`. A checkpoint is a .safetensors file or a
    torch file of tensors alone, also nested under "teacher", "state_dict" or "model". hf:NAME is a model of the
    Hugging Face hub, or a folder in its format (see `huggingface.load_huggingface`; needs the extra "transformers").
    layer: the block that describes patches, as "block9", "last", or a number from 0, negative ones from the end;
    key_block is its older name. facet: what of that block, "key" (the paper's), "query", "value" or "token" (its
    output). image_size: pixels, to the nearest multiple of the patch size; default the checkpoint's, 224 for hf:NAME.
    num_heads, layer and saliency_heads default to the file's metadata, then to the DINO conventions; for hf:NAME to
    the paper's depth (three quarters of the blocks) and all heads.
    device: None takes a GPU if there is one. precision="bfloat16" is faster on hardware with
    bfloat16 instructions; elsewhere float32 is used, with a logged warning (see `precision`). Raises
    InputError for unknown names, layers and facets, downloads that fail (saying what to do) and files that are not
    such a checkpoint. A `BackboneConfig` has layer, facet and image_size of its own; others beside it are not used.
    """
    if isinstance(name_or_path, BackboneConfig):
        own = asdict(name_or_path)
        others = dict(num_heads=num_heads, saliency_heads=saliency_heads, precision=precision, batch_size=batch_size)
        return load_backbone(own.pop("name"), device, **own, **others)
    name = str(name_or_path)
    path = Path(name).expanduser()
    if layer is not None and key_block is not None:
        raise InputError(f"{name}: layer {layer!r} and key_block {key_block} are one thing, expected one of the two")
    layer = key_block if layer is None else layer
    check_facet(facet, name)
    options = {"device": device, "precision": precision, "batch_size": batch_size, "facet": facet}

    def named(label: str, depth: int) -> str:
        """With what was asked for: benchmark runs are told apart by name."""
        asked = [] if layer is None else [f"block{block_index(layer, depth, name)}"]
        asked += [] if facet == "key" else [facet]
        asked += [] if image_size is None else [f"{image_size} px"]
        return f"{label} ({', '.join(asked)})" if asked else label

    if name.startswith(PREFIX):
        if num_heads is not None:
            raise InputError(f"{name}: num_heads is {num_heads}, expected none: the model's configuration has it")
        model = load_huggingface(name, image_size)
        block = 3 * model.depth // 4 if layer is None else layer
        heads = range(model.num_heads) if saliency_heads is None else saliency_heads
        if model.mean is not None:
            options |= {"mean": model.mean, "std": model.std}
        folder = Path(name.removeprefix(PREFIX)).expanduser()
        label = PREFIX + folder.resolve().name if folder.is_dir() else name
        return Backbone(model, named(label, model.depth), block, heads, **options)
    if name in available_backbones():
        path, label = download(name), name
    elif path.is_file():
        label = path.stem
    else:
        raise InputError(
            f"backbone {name!r}: neither a file nor one of {', '.join(available_backbones())}, nor {PREFIX}NAME"
        )
    weights, metadata = read_checkpoint(path)
    model = build_vit(weights, num_heads or _metadata_int(metadata, "num_heads", path), path.name)
    block = _metadata_int(metadata, "key_block", path) if layer is None else layer
    if saliency_heads is None and "saliency_heads" in metadata:
        saliency_heads = _metadata_ints(metadata, "saliency_heads", path)
    return Backbone(model, named(label, model.depth), block, saliency_heads, image_size=image_size, **options)


def available_backbones() -> dict[str, Path | None]:
    """Every backbone that has a name, with its file, or None where that is not at hand."""
    paths = {"zsp-tiny": TINY} | {name: release.path for name, release in PRETRAINED.items()}
    return {name: path if path.is_file() else None for name, path in paths.items()}


def download(name: str) -> Path:
    """The file (of hf:NAME: the folder) of a named backbone, fetched if it is not at hand.

    Raises InputError saying what to do.
    """
    if name.startswith(PREFIX):
        return model_folder(name)
    if name == "zsp-tiny":
        if not TINY.is_file():
            raise InputError(f"zsp-tiny: {TINY.name} is not in the package; `zsp-lite train` makes it")
        return TINY
    if name not in PRETRAINED:
        raise InputError(f"backbone {name!r}: not one of {', '.join(available_backbones())}")
    release = PRETRAINED[name]
    try:
        return fetch(release.url, release.path, release.size, release.md5_prefix)
    except InputError as error:
        raise InputError(
            f"{name}: {error}; fetch that file elsewhere and put it at {release.path}, or use zsp-tiny"
        ) from error


def verify(name_or_path: str | Path) -> None:
    """Raises InputError where a backbone is not at hand, not the released file, damaged, or of another layout."""
    name = str(name_or_path)
    backbones = available_backbones()
    if name in backbones and backbones[name] is None:
        raise InputError(f"{name} is not at hand; zsp-lite weights fetch {name}")
    release = PRETRAINED.get(name)
    if release is not None and not has_size_and_hash(release.path, release.size, release.md5_prefix):
        raise InputError(
            f"{name}: {release.path} is not the released file, expected "
            f"{release.size or 'any number of'} bytes with MD5 {release.md5_prefix}...; "
            f"remove it, then zsp-lite weights fetch {name}"
        )
    load_backbone(name, "cpu")


def prepare_images(images: Sequence[Image], size: int = 224, first: int = 0) -> Float[Tensor, "b 3 s s"]:
    """Images (H, W, 3), uint8 or float in [0, 1], as one batch in [0, 1], resized (bilinear, antialiased).

    `first` is the number of the first image in error messages. Raises InputError on other types, shapes or values.
    """
    prepared = []
    for index, image in enumerate(images, first):
        try:
            # A copy, since arrays may be read-only or flipped views, which torch does not take.
            image = image if torch.is_tensor(image) else torch.from_numpy(np.array(image))
        except (TypeError, ValueError) as error:
            raise InputError(f"image {index}: not an array of numbers ({type(image).__name__})") from error
        if image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
            raise InputError(f"image {index}: expected shape (H, W, 3), got {tuple(image.shape)}")
        if image.dtype == torch.uint8:
            image = image.to(torch.float32) / 255
        elif image.is_floating_point():
            image = image.to(torch.float32)
            if not bool(((image >= 0) & (image <= 1)).all()):  # false for NaN too
                low, high = image.min().item(), image.max().item()
                raise InputError(f"image {index}: expected floats in [0, 1], got {low:g} to {high:g}")
        else:
            raise InputError(f"image {index}: expected uint8 or float in [0, 1], got {image.dtype}")
        image = image.permute(2, 0, 1)[None]
        if image.shape[2:] != (size, size):
            image = F.interpolate(image, (size, size), mode="bilinear", align_corners=False, antialias=True)
        prepared.append(image)
    return torch.cat(prepared)


def _device(device: str | torch.device | None) -> torch.device:
    if device is None:
        device = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        reason = str(error).splitlines()[0][:120]
        raise InputError(f"device {str(device)!r} cannot be used: {reason}") from error


def _metadata_ints(metadata: dict[str, str], key: str, path: Path) -> list[int]:
    try:
        return [int(x) for x in metadata[key].strip("()[] ").split(",") if x.strip()]
    except ValueError as error:
        raise InputError(f"checkpoint {path}: metadata {key} {metadata[key]!r} is not integers") from error


def _metadata_int(metadata: dict[str, str], key: str, path: Path) -> int | None:
    values = _metadata_ints(metadata, key, path) if key in metadata else [None]
    if len(values) != 1:
        raise InputError(f"checkpoint {path}: metadata {key} is {metadata[key]!r}, expected one integer")
    return values[0]

"""Checkpoint files of vision transformers in the DINO layout."""

import math
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.io.files import MAX_WEIGHTS, file_size, load_torch

# Keys of Meta's own files of later models, and where the same models are in a layout that is read.
_LATER = {
    "rope_embed.periods": "DINOv3, expected hf:facebook/dinov3-vits16-pretrain-lvd1689m",
    "blocks.0.ls1.gamma": "DINOv2, expected hf:facebook/dinov2-small",
}


def read_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read weights with DINO's state-dict keys, and metadata, from a .safetensors or a torch file.

    No code from the file is executed. A torch file has no metadata. InputError if there is anything
    but tensors.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        file_size(path, "checkpoint", MAX_WEIGHTS)
        try:
            with safe_open(path, framework="pt") as file:
                weights = {key: file.get_tensor(key) for key in file.keys()}
                return weights, dict(file.metadata() or {})
        except Exception as error:  # a damaged file can raise almost any exception
            raise InputError(
                f"checkpoint {path}: damaged, or contains more than tensors ({one_line(error)})"
            ) from error

    content = load_torch(path, "checkpoint")
    # DINO's training checkpoints hold a teacher and a student, and other programs nest weights,
    # too.
    for nested in ("teacher", "state_dict", "model"):
        if isinstance(content, dict) and isinstance(content.get(nested), dict):
            content = content[nested]
            break
    if (
        not isinstance(content, dict)
        or not content
        or not all(torch.is_tensor(x) for x in content.values())
    ):
        raise InputError(
            f"checkpoint {path}: expected a state dict of tensors, got {type(content).__name__}"
        )
    # Parameters are named as in the plain transformer: the prefixes are from wrappers of the
    # training, and its head is left out.
    weights = {}
    for key, values in content.items():
        key = str(key).removeprefix("module.").removeprefix("backbone.")
        if not key.startswith("head."):
            weights[key] = values
    return weights, {}


def metadata_integers(metadata: dict[str, str], key: str, path: Path) -> list[int] | None:
    """Parse integers separated by commas; None if the metadata does not contain `key`."""
    if key not in metadata:
        return None
    try:
        return [int(word) for word in metadata[key].split(",")]
    except ValueError as error:
        raise InputError(
            f"checkpoint {path}: metadata {key} is {metadata[key]!r}, expected integers"
        ) from error


def build_vit(weights: dict[str, Tensor], num_heads: int | None, path: Path) -> VisionTransformer:
    """Build a transformer from weights in the DINO layout, whose shapes give its sizes."""
    for key, model in _LATER.items():
        if key in weights:
            raise InputError(f"{path.name} is Meta's own file of {model} or its like")
    try:
        dim, _, patch_size, _ = weights["patch_embed.proj.weight"].shape
        # The position embedding has one token for CLS, and side * side for the patches.
        side = math.isqrt(weights["pos_embed"].shape[1] - 1)
        depth = len({key.split(".")[1] for key in weights if key.startswith("blocks.")})
        if num_heads is None:
            # Heads usually have 64 channels. For other widths, the transformer refuses 0 heads.
            num_heads = dim // 64 if dim % 64 == 0 else 0
        # The checkpoint replaces the initial values: do not compute them.
        with torch.device("meta"):
            model = VisionTransformer(side * patch_size, patch_size, dim, depth, num_heads)
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(
            f"{path.name}: not a vision transformer in the DINO layout ({error}); num_heads "
            "is read from the metadata, by default one per 64 channels"
        ) from error
    for key, values in weights.items():
        if not values.isfinite().all():
            raise InputError(f"{path.name}: {key} holds values that are not finite")
    try:
        model.load_state_dict({key: values.float() for key, values in weights.items()}, assign=True)
    except RuntimeError as error:  # several lines that name every key
        raise InputError(f"{path.name}: the weights do not fit: {one_line(error)}") from error
    return model


def one_line(error: Exception) -> str:
    """Return the beginning of an error's message in one line, or its type if it has none."""
    return " ".join(str(error).split())[:300] or type(error).__name__

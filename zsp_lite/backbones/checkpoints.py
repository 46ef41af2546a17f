"""Checkpoint files of vision transformers in the DINO layout: read them, tell the model by its shapes."""

import math
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError


def read_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Weights under the plain DINO keys, and the metadata (empty but for safetensors). Runs no code from it.

    Raises InputError where the file is damaged or holds anything but tensors.
    """
    path = Path(path)
    try:
        if path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                return {key: file.get_tensor(key) for key in file.keys()}, dict(file.metadata() or {})
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:
        # Damaged files surface as whatever the unpickler stumbled over: a dozen types, none documented. Torch's own
        # advice is to load the file unsafely.
        reason = (str(error).splitlines() or [""])[0]
        reason = type(error).__name__ if not reason or reason.startswith("Weights only load failed") else reason
        raise InputError(f"checkpoint {path}: damaged, or not of tensors alone ({reason[:120]})") from error
    for nested in ("teacher", "state_dict", "model"):  # DINO's training checkpoints hold teacher and student
        if isinstance(content, dict) and isinstance(content.get(nested), dict):
            content = content[nested]
            break
    if not isinstance(content, dict) or not content or not all(torch.is_tensor(x) for x in content.values()):
        raise InputError(f"checkpoint {path}: expected a state dict of tensors, got {type(content).__name__}")
    plain = {str(key).removeprefix("module.").removeprefix("backbone."): x for key, x in content.items()}
    return {key: x for key, x in plain.items() if not key.startswith("head.")}, {}


def build_vit(weights: dict[str, Tensor], num_heads: int | None = None, name: str = "checkpoint") -> VisionTransformer:
    """The transformer with these weights; sizes come from their shapes, heads have 64 channels unless told.

    Raises InputError where keys or shapes are not those of the DINO layout, or a weight is not finite.
    """
    try:
        dim, _, patch_size, _ = weights["patch_embed.proj.weight"].shape
        side = math.isqrt(weights["pos_embed"].shape[1] - 1)
        depth = 1 + max(int(key.split(".")[1]) for key in weights if key.startswith("blocks."))
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{name}: not a vision transformer in the DINO layout ({error})") from error
    if num_heads is None:
        if dim % 64:
            raise InputError(f"{name}: {dim} channels do not say how many heads there are; pass num_heads")
        num_heads = dim // 64
    with torch.device("meta"):  # no time spent on initial values that the checkpoint replaces
        model = VisionTransformer(side * patch_size, patch_size, dim, depth, num_heads)
    expected = {key: tuple(x.shape) for key, x in model.state_dict().items()}
    found = {key: tuple(x.shape) for key, x in weights.items()}
    wrong = sorted(key for key in expected.keys() | found.keys() if expected.get(key) != found.get(key))
    if wrong:
        key = wrong[0]
        raise InputError(
            f"{name}: {len(wrong)} weights do not fit the DINO layout, first {key}: "
            f"expected {expected.get(key, 'none')}, got {found.get(key, 'none')}"
        )
    for key, x in weights.items():
        if not x.is_floating_point() or not bool(x.isfinite().all()):
            raise InputError(f"{name}: {key} holds values that are not finite floats")
    model.load_state_dict({key: x.to(torch.float32) for key, x in weights.items()}, strict=True, assign=True)
    return model

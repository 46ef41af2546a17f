"""Checkpoint files of vision transformers in the DINO layout."""

import math
import reprlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from safetensors import safe_open
from torch import Tensor, nn

from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.errors import InputError
from zsp_lite.io.tensors import check_weights_size, load_torch


def read_checkpoint(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a .safetensors file, or a torch file that contains tensors only. No code from the file is executed.

    Returns:
        Weights with DINO's state-dict keys, and the metadata (empty unless the file is a .safetensors file).

    Raises:
        InputError: If the file is damaged or contains anything but tensors.
    """
    path = Path(path)
    if path.suffix == ".safetensors":
        check_weights_size(path, "checkpoint")
        try:
            with safe_open(path, framework="pt") as file:
                return {key: file.get_tensor(key) for key in file.keys()}, dict(file.metadata() or {})
        except Exception as error:  # a damaged file can raise almost any exception
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise InputError(f"checkpoint {path}: damaged, or contains more than tensors ({reason[:120]})") from error
    content = load_torch(path, "checkpoint")
    for nested in ("teacher", "state_dict", "model"):  # DINO's training checkpoints contain teacher and student
        if isinstance(content, dict) and isinstance(content.get(nested), dict):
            content = content[nested]
            break
    if not isinstance(content, dict) or not content or not all(torch.is_tensor(x) for x in content.values()):
        raise InputError(f"checkpoint {path}: expected a state dict of tensors, got {type(content).__name__}")
    plain = {str(key).removeprefix("module.").removeprefix("backbone."): x for key, x in content.items()}
    return {key: x for key, x in plain.items() if not key.startswith("head.")}, {}


def metadata_integers(metadata: dict[str, str], key: str, path: Path) -> list[int] | None:
    """Parse integers separated by commas; None if the metadata does not contain `key`. Raises InputError."""
    if key not in metadata:
        return None
    try:
        return [int(x) for x in metadata[key].strip("()[] ").split(",") if x.strip()]
    except ValueError as error:
        raise InputError(f"checkpoint {path}: metadata {key} {metadata[key]!r} is not integers") from error


def metadata_integer(metadata: dict[str, str], key: str, path: Path) -> int | None:
    """Parse one integer; None if the metadata does not contain `key`. Raises InputError."""
    values = metadata_integers(metadata, key, path)
    if values is None:
        return None
    if len(values) != 1:
        raise InputError(f"checkpoint {path}: metadata {key} is {metadata[key]!r}, expected one integer")
    return values[0]


def build_vit(weights: dict[str, Tensor], num_heads: int | None = None, name: str = "checkpoint") -> VisionTransformer:
    """Build a transformer from weights in the DINO layout; its sizes are read from their shapes.

    Args:
        weights: State dict of finite floats.
        num_heads: Default: one head per 64 channels.
        name: Name for error messages.

    Raises:
        InputError: If keys or shapes are not in the DINO layout, or a weight is not finite.
    """
    try:
        dim, _, patch_size, _ = weights["patch_embed.proj.weight"].shape
        side = math.isqrt(weights["pos_embed"].shape[1] - 1)
        blocks = {int(key.split(".")[1]) for key in weights if key.startswith("blocks.")}
        if (depth := len(blocks)) == 0 or blocks != set(range(depth)):
            raise ValueError(f"{depth} blocks, not numbered from 0 to {depth - 1}")
    except (KeyError, ValueError, IndexError) as error:
        raise InputError(f"{name}: not a vision transformer in the DINO layout ({error})") from error
    if num_heads is None:
        if dim % 64:
            raise InputError(
                f"{name}: the number of heads is unknown, {dim} channels are not a multiple of 64; pass num_heads"
            )
        num_heads = dim // 64
    with torch.device("meta"):  # the checkpoint replaces the initial values: do not compute them
        model = VisionTransformer(side * patch_size, patch_size, dim, depth, num_heads)
    load_weights(model, weights, name)
    return model


def load_weights(model: nn.Module, weights: Mapping[str, Tensor], name: str, ignored: Sequence[str] = ()) -> None:
    """Load a state dict into a module, as float32.

    Args:
        model: The module.
        weights: The state dict.
        name: Name for error messages.
        ignored: Prefixes of keys that are not loaded.

    Raises:
        InputError: A key is missing, unknown or of another shape, or a weight is not of finite floats.
    """
    if strange := [key for key, x in weights.items() if not (isinstance(key, str) and torch.is_tensor(x))]:
        raise InputError(f"{name}: entry {reprlib.repr(strange[0])} is no named tensor, expected weights")
    state = model.state_dict()
    weights = {key: x for key, x in weights.items() if not key.startswith(tuple(ignored))}
    expected, found = ({key: tuple(x.shape) for key, x in tensors.items()} for tensors in (state, weights))
    # Older checkpoints have no counter of the batches in batch normalisation, which inference does not use.
    counters = {key for key in expected.keys() - found.keys() if key.endswith("num_batches_tracked")}
    wrong = sorted(key for key in (expected.keys() | found.keys()) - counters if expected.get(key) != found.get(key))
    if wrong:
        key = wrong[0]
        raise InputError(
            f"{name}: {len(wrong)} weights do not fit the architecture, first {key}: "
            f"expected {expected.get(key, 'none')}, got {found.get(key, 'none')}"
        )
    for key, x in weights.items():
        if state[key].is_floating_point() and not (x.is_floating_point() and bool(x.isfinite().all())):
            raise InputError(f"{name}: {key} contains values that are not finite floats")
    model.load_state_dict({key: x.to(state[key].dtype) for key, x in weights.items()}, strict=False, assign=True)

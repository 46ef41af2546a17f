"""Reading of torch files: tensors and plain data only."""

import io
from pathlib import Path
from typing import Any

import torch

from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size

MAX_WEIGHTS = 4 << 30  # bytes of a file of weights


def load_torch(source: str | Path | bytes, what: str) -> Any:
    """Read a torch file, given by its path or content, into CPU memory. No code from the file is executed.

    Raises:
        InputError: There is no file, it is too large or damaged, or contains more than tensors and plain data.
    """
    if not isinstance(source, bytes):
        check_weights_size(source, what)
        what = f"{what} {source}"
    try:
        file = io.BytesIO(source) if isinstance(source, bytes) else source
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can raise almost any; torch's message recommends unsafe loading
        raise InputError(f"{what}: damaged, or contains more than tensors ({type(error).__name__})") from error


def check_weights_size(path: str | Path, what: str) -> None:
    """Raise InputError if there is no file at `path`, or one of more than `MAX_WEIGHTS` bytes."""
    if (size := file_size(path, what)) > MAX_WEIGHTS:
        raise InputError(f"{what} {path} is {size} bytes long, expected at most {MAX_WEIGHTS}")

"""Reading of torch files: tensors and plain data only."""

from pathlib import Path
from typing import Any

import torch

from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size

MAX_WEIGHTS = 4 << 30  # bytes of a file of weights


def load_torch(path: str | Path, what: str) -> Any:
    """Read a torch file without executing code in it; InputError if it is damaged, or has more than plain data."""
    file_size(path, what, MAX_WEIGHTS)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can raise almost any; torch's message recommends unsafe loading
        raise InputError(f"{what} {path}: damaged, or contains more than tensors ({type(error).__name__})") from error

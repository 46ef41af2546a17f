"""Reading of torch files: tensors and plain data only."""

import io
from pathlib import Path
from typing import Any

import torch

from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size

MAX_WEIGHTS = 4 << 30  # bytes of a file of weights


def load_torch(source: str | Path | bytes, what: str) -> Any:
    """Read a torch file, given by its path or content; InputError if it is damaged, or contains more than plain data.

    No code from the file is executed.
    """
    if isinstance(source, bytes):
        file = io.BytesIO(source)
    else:
        file_size(source, what, MAX_WEIGHTS)
        file, what = source, f"{what} {source}"
    try:
        return torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:  # a damaged file can raise almost any; torch's message recommends unsafe loading
        raise InputError(f"{what}: damaged, or contains more than tensors ({type(error).__name__})") from error

"""Reading of torch files: tensors and plain data only, and no tensor that is larger than its stored values."""

import io
import zipfile
from pathlib import Path
from typing import Any

import torch

from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size

MAX_WEIGHTS = 4 << 30  # bytes of a file of weights


def check_weights_size(path: str | Path, what: str) -> None:
    """Raise InputError if there is no file at `path`, or one of more than `MAX_WEIGHTS` bytes."""
    if (size := file_size(path, what)) > MAX_WEIGHTS:
        raise InputError(f"{what} {path} is {size} bytes long, expected at most {MAX_WEIGHTS}")


def load_torch(source: str | Path | bytes, what: str) -> Any:
    """Read a torch file into CPU memory. No code from the file is executed.

    Args:
        source: The file, or its content.
        what: Its kind for error messages; of content, its kind and name.

    Returns:
        Tensors in lists, tuples and dictionaries.

    Raises:
        InputError: There is no file, it is too large, damaged or compressed, contains more than tensors and plain
            data, or has a tensor that is not dense or has more values than are stored (with a stride of 0).
    """
    if not isinstance(source, bytes):
        check_weights_size(source, what)
        what = f"{what} {source}"
    try:
        file = io.BytesIO(source) if isinstance(source, bytes) else source
        if zipfile.is_zipfile(file):
            with zipfile.ZipFile(file) as archive:  # torch does not compress, but would decompress to any size
                if any(member.compress_type for member in archive.infolist()):
                    raise ValueError("compressed entries")
        if isinstance(source, bytes):
            file.seek(0)
        content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as error:
        # A damaged file can raise almost any exception. torch's own message recommends unsafe loading: not shown.
        reason = (str(error).splitlines() or [""])[0]
        reason = type(error).__name__ if not reason or reason.startswith("Weights only load failed") else reason
        raise InputError(f"{what}: damaged, or contains more than tensors ({reason[:120]})") from error
    for tensor in _tensors(content):
        dense = tensor.layout == torch.strided and tensor.device.type == "cpu" and not tensor.is_quantized
        if not dense or tensor.numel() * tensor.element_size() > tensor.untyped_storage().nbytes():
            raise InputError(f"{what}: tensor of shape {tuple(tensor.shape)} is not dense, expected stored values")
    return content


def _tensors(content: Any) -> list[torch.Tensor]:
    """Find all tensors, without recursion; an object that is contained many times is visited once."""
    found, visited, waiting = [], {id(content)}, [content]
    while waiting:
        one = waiting.pop()
        if isinstance(one, torch.Tensor):
            found.append(one)
        parts = [*one.keys(), *one.values()] if isinstance(one, dict) else one
        if isinstance(parts, list | tuple | set):
            new = {id(part): part for part in parts if id(part) not in visited}
            visited.update(new)
            waiting += new.values()
    return found

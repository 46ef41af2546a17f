"""Atomic writes, reads with limits and errors that name the file, JSON, and checks of paths and
names."""

import codecs
import gzip
import hashlib
import io
import math
import os
import re
import secrets
import stat
import zlib
from pathlib import Path
from typing import Any

import msgspec

from zsp_lite.errors import InputError

# The root of the repository; for an installed copy, the folder of the packages.
REPOSITORY = Path(__file__).resolve().parents[2]
MAX_FILE = 1 << 30  # bytes of a file that is read at once, and of what is decompressed from it
MAX_WEIGHTS = 4 << 30  # bytes of a file of weights
# Compressed data may grow to this many bytes, or by the factor below if that is more. Annotations
# grow by a factor of 10.
GROWTH_ALLOWED = 1 << 26
_GROWTH_FACTOR = 32
_LONGEST_NAME = 255  # bytes of a file's name, on most file systems


def cache_folder() -> Path:
    """Return the folder of downloaded files: $ZSP_LITE_CACHE, or ~/.cache/zsp-lite."""
    return Path(os.environ.get("ZSP_LITE_CACHE") or Path.home() / ".cache" / "zsp-lite")


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a file and missing folders above it; readers see the old or all of the new content."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: str | Path, what: str) -> bytes:
    """Read a file of at most `MAX_FILE` bytes; `what` is its kind, for messages."""
    file_size(path, what, MAX_FILE)
    return Path(path).read_bytes()


def read_json(path: str | Path, kind: Any, what: str) -> Any:
    """Read a JSON file as a type of msgspec; `what` is the kind of file, for messages."""
    data = without_nan(read_bytes(path, what)).removeprefix(codecs.BOM_UTF8)
    return decode_json(data, kind, f"{what} {path}")


def without_nan(data: bytes) -> bytes:
    """Replace NaN and Infinity, which Python's json writes although they are no JSON, by null."""
    # Optional fields accept null, and the others refuse it with the name of the field.
    if b"NaN" in data or b"Infinity" in data:
        data = re.sub(rb"(?<=[:,\[\s])-?(?:NaN|Infinity)(?=[,\]}\s])", b"null", data)
    return data


def decode_json(data: bytes | msgspec.Raw, kind: Any, what: str) -> Any:
    """Decode JSON as a type of msgspec; an InputError begins with `what` and names the field."""
    try:
        return msgspec.json.decode(data, type=kind)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise InputError(f"{what}: {error}") from error


def file_size(path: str | Path, what: str, most: float = math.inf) -> int:
    """Return the size of a file in bytes; InputError if it exceeds `most` or cannot be read."""
    try:
        status = os.stat(path)
        if stat.S_ISDIR(status.st_mode):
            problem = "is a directory"
        elif not stat.S_ISREG(status.st_mode):  # what a pipe or device sends may never end
            problem = "a pipe or a device, expected a file"
        elif status.st_size > most:
            problem = f"{status.st_size} bytes, expected at most {most}"
        elif os.access(path, os.R_OK):
            return status.st_size
        else:
            problem = "permission denied"
    except (OSError, ValueError) as error:
        problem = str(getattr(error, "strerror", error)).lower()
    raise InputError(f"{what} {shown(path)} cannot be read: {problem}")


def load_torch(path: str | Path, what: str) -> Any:
    """Read a torch file of plain data, without executing code in it."""
    import torch  # takes seconds, and most callers of this module do not need it

    file_size(path, what, MAX_WEIGHTS)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    # A damaged file can raise almost anything; torch's message recommends unsafe loading.
    except Exception as error:
        raise InputError(
            f"{what} {path}: damaged, or contains more than tensors ({type(error).__name__})"
        ) from error


def digest(*parts: str | bytes) -> str:
    """Return a hash of texts and bytes, 16 hexadecimal digits."""
    hasher = hashlib.sha256()
    for part in parts:
        is_text = isinstance(part, str)
        hasher.update(part.encode(errors="surrogateescape") if is_text else part)
    return hasher.hexdigest()[:16]


def stable_hash(text: str) -> int:
    """Hash text to 64 bits; unlike Python's `hash`, the result is the same in every process."""
    return int(digest(text), 16)


def decompress(data: bytes, what: str) -> bytes:
    """Decompress the gzip data `what`; InputError if they are incomplete or grow too much."""
    limit = min(MAX_FILE, max(GROWTH_ALLOWED, _GROWTH_FACTOR * len(data)))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(limit + 1)
            if len(content) <= limit:
                return content
        problem = f"{len(data)} bytes grow to more than {limit}"
    except (OSError, EOFError, zlib.error) as error:
        problem = str(error)
    raise InputError(f"{what}: no gzip data that can be read: {problem}")


def path_inside(root: str | Path, relative: str) -> Path:
    """Resolve a path relative to a folder; InputError if it, or a link on it, leads out."""
    root = Path(root).resolve()
    try:
        resolved = (root / relative).resolve()
        resolved.exists()  # raises OSError where a name is too long
        if resolved.is_relative_to(root) and not Path(relative).is_absolute():
            return resolved
        problem = "leads out of"
    except (ValueError, OSError, RuntimeError):  # null byte, name too long, cyclic links
        problem = "is invalid in"
    raise InputError(
        f"path {shown(relative)} {problem} the data folder {root}, expected a path inside"
    )


def plain_name(name: str, what: str) -> str:
    """Return the name of a file or folder; InputError, beginning with `what`, if it is a path."""
    is_path = not name or name.startswith(".") or any(character in "/\\:\0" for character in name)
    if is_path or len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(
            f"{what} name is {shown(name)!r}, expected a plain folder name of at most "
            f"{_LONGEST_NAME} bytes"
        )
    return name


def shown(path: str | Path) -> str:
    """Format a path that may be very long or hold control characters."""
    text = str(path)
    return text if text.isprintable() and len(text) < 500 else f"{text[:100]!r}..."

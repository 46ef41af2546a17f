"""Atomic writes, reads with limits and errors that name the file, and checks of paths and names."""

import gzip
import hashlib
import io
import lzma
import os
import secrets
import stat
import zipfile
import zlib
from pathlib import Path

from zsp_lite.errors import InputError

MAX_FILE = 1 << 30  # bytes of a file that is read at once, and of what is decompressed from it
# Compressed data may grow to this many bytes, or by this factor if that is more. Annotations grow by 10.
_GROWTH_ALLOWED, _GROWTH_FACTOR = 1 << 26, 32
_LONGEST_NAME = 255  # bytes, on most file systems
# Exceptions of zipfile and of decompression for truncated, damaged or encrypted files and unknown methods.
ARCHIVE_ERRORS = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, RuntimeError, ValueError, KeyError)


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a file atomically: a reader sees the old content or the new one, never a part.

    The data is written to a temporary file in the same folder, which is then renamed. Missing folders are created.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def make_folder(path: str | Path, what: str) -> Path:
    """Make a folder unless it exists, with those above it. Raises InputError if that is not possible."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(f"{what} {_shown(path)} cannot be made: {_reason(error)}, expected a folder") from error
    return Path(path)


def read_bytes(path: str | Path, what: str) -> bytes:
    """Read a file of at most `MAX_FILE` bytes; InputError, which names its kind `what`, if it cannot be read."""
    if (size := file_size(path, what)) > MAX_FILE:
        raise InputError(f"{what} {path} is {size} bytes long, expected at most {MAX_FILE}")
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {_reason(error)}") from error


def file_size(path: str | Path, what: str) -> int:
    """Return the size of a regular file in bytes; InputError for a pipe or a device, which may never end."""
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{what} {_shown(path)} cannot be read: {_reason(error)}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "is a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or a device, expected a file"
        raise InputError(f"{what} {path} cannot be read: {kind}")
    return status.st_size


def sha256(path: str | Path, what: str) -> str:
    """Return the SHA-256 digest of a file in hexadecimal digits. Raises InputError if it cannot be read."""
    file_size(path, what)
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def growth_limit(size: int) -> int:
    """Return the number of bytes to which `size` compressed bytes may grow."""
    return min(MAX_FILE, max(_GROWTH_ALLOWED, _GROWTH_FACTOR * size))


def decompress(data: bytes, where: str) -> bytes:
    """Decompress gzip data of the file `where`; InputError if it is incomplete or grows beyond `growth_limit`."""
    limit = growth_limit(len(data))
    try:
        with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
            content = file.read(limit + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{where} are not complete gzip data: {error}") from error
    if len(content) > limit:
        raise InputError(f"{where} grow from {len(data)} to more than {limit} bytes, expected less")
    return content


def path_inside(root: str | Path, relative: str) -> Path:
    """Resolve a path relative to a folder.

    Raises:
        InputError: The path leads out of the folder (by "..", as an absolute path or by a link).
    """
    resolved_root = Path(root).resolve()
    try:
        resolved = (resolved_root / relative).resolve()
        resolved.exists()  # raises OSError where a name is too long
    except (ValueError, OSError, RuntimeError) as error:  # null byte, name too long, cyclic links
        raise InputError(f"path {_shown(relative)} in {root} is invalid: {_reason(error)}") from error
    if not resolved.is_relative_to(resolved_root) or Path(relative).is_absolute():
        raise InputError(f"path {relative!r} leads out of the data folder {root}, expected a path inside")
    return resolved


def plain_name(name: str, what: str) -> str:
    """Return `name` if it is a valid name of a single file or folder; `what` says of which, for error messages.

    Raises:
        InputError: The name is empty, begins with a dot, or contains a separator.
    """
    if not name or name.startswith(".") or any(c in "/\\:\0" for c in name):
        raise InputError(f"{what} name is {name!r}, expected a plain folder name")
    if len(os.fsencode(name)) > _LONGEST_NAME:
        raise InputError(f"{what} name has {len(name)} characters, expected at most {_LONGEST_NAME} bytes")
    return name


def _reason(error: Exception) -> str:
    """Describe an error of the file system, or a ValueError, which Python raises for a null byte in a path."""
    return (getattr(error, "strerror", None) or str(error)).lower()


def _shown(path: str | Path) -> str:
    """Format a path that may be very long or hold control characters."""
    text = str(path)
    return text if text.isprintable() and len(text) < 500 else f"{text[:100]!r}..."

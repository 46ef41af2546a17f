"""Atomic writes, reads with limits and errors that name the file, and checks of paths and names.

The standard library has no atomic write, and the package `atomicwrites` is no longer maintained.
"""

import gzip
import hashlib
import io
import lzma
import math
import os
import platform
import re
import secrets
import stat
import zipfile
import zlib
from pathlib import Path

import numpy as np

from zsp_lite.errors import InputError

MAX_FILE = 1 << 30  # bytes of a file that is read at once, and of what is decompressed from it
# Compressed data may grow to this many bytes, or by this factor if that is more. Annotations grow by 10.
_GROWTH_ALLOWED, _GROWTH_FACTOR = 1 << 26, 32
_LONGEST_NAME, _LONGEST_PATH = 255, 4096  # bytes, on most file systems
_MACHINE = f"{zlib.crc32(platform.node().encode()):08x}"  # folders can be shared with other machines
_TEMPORARY = re.compile(r"\..*\.([0-9a-f]{8})-(\d+)\.[0-9a-f]{8}\.tmp")
_cleaned: set[Path] = set()  # folders without leftovers
# Exceptions of zipfile and of decompression for truncated, damaged or encrypted files and unknown methods.
ARCHIVE_ERRORS = (zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError, OSError, RuntimeError, ValueError, KeyError)


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a file atomically: a reader sees the old content or the new one, never a part.

    The data is written to a temporary file in the same folder, which is then renamed. Missing folders are created.
    Temporary files that killed processes of this machine left in the folder are removed at the first write to it.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    if (folder := path.parent.resolve()) not in _cleaned:
        _cleaned.add(folder)
        _remove_leftovers(folder)
    # The random part is for threads, which share the process id.
    temporary = path.with_name(f".{path.name}.{_MACHINE}-{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _remove_leftovers(folder: Path) -> None:
    with os.scandir(folder) as entries:
        found = [(entry.path, _TEMPORARY.fullmatch(entry.name)) for entry in entries]
    for path, match in found:
        if match and match[1] == _MACHINE and not os.path.exists(f"/proc/{match[2]}") and os.path.isdir("/proc/self"):
            Path(path).unlink(missing_ok=True)


def make_folder(path: str | Path, what: str) -> Path:
    """Make a folder unless it exists, with those above it. Raises InputError if that is not possible."""
    try:
        Path(path).mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError) as error:
        raise InputError(f"{what} {_shown(path)} is a file or lies in one, expected a folder") from error
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{what} {_shown(path)} cannot be made: {reason.lower()}") from error
    return Path(path)


def read_bytes(path: str | Path, what: str) -> bytes:
    """Read a file.

    Args:
        path: The file.
        what: Its kind for error messages, such as "image".

    Raises:
        InputError: The file cannot be read.
    """
    if (size := file_size(path, what)) > MAX_FILE:
        raise InputError(f"{what} {path} is {size} bytes long, expected at most {MAX_FILE}")
    try:
        return Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{what} {path} cannot be read: {reason.lower()}") from error


def file_size(path: str | Path, what: str) -> int:
    """Return the size of a regular file in bytes. A pipe or a device, which may never end, is not opened.

    Raises:
        InputError: There is no file at `path`.
    """
    try:
        status = os.stat(path)
    except (OSError, ValueError) as error:  # ValueError: a null byte in the path
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{what} {_shown(path)} cannot be read: {reason.lower()}") from error
    if not stat.S_ISREG(status.st_mode):
        kind = "is a directory" if stat.S_ISDIR(status.st_mode) else "a pipe or a device, expected a file"
        raise InputError(f"{what} {path} cannot be read: {kind}")
    return status.st_size


def sha256(path: str | Path, what: str) -> str:
    """Return the SHA-256 digest of a file in hexadecimal digits. Raises InputError if it cannot be read."""
    file_size(path, what)
    try:
        with open(path, "rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise InputError(f"{what} {path} cannot be read: {(error.strerror or str(error)).lower()}") from error


def growth_limit(size: int) -> int:
    """Return the number of bytes to which `size` compressed bytes may grow."""
    return max(size, min(MAX_FILE, max(_GROWTH_ALLOWED, _GROWTH_FACTOR * size)))


def decompress(data: bytes, where: str) -> bytes:
    """Decompress gzip data of one or several members.

    Args:
        data: The compressed data.
        where: Kind and name of the file, for error messages.

    Raises:
        InputError: The data is damaged or incomplete, or grows beyond `growth_limit`.
    """
    limit = growth_limit(len(data))
    try:
        member = zlib.decompressobj(wbits=31)  # 31: gzip
        content = member.decompress(data, limit + 1)
        if member.unused_data:
            with gzip.GzipFile(fileobj=io.BytesIO(data)) as file:
                content = file.read(limit + 1)
        elif not member.eof and len(content) <= limit:
            raise EOFError("the end is missing")
    except (OSError, EOFError, zlib.error) as error:
        raise InputError(f"{where} are not complete gzip data: {error}") from error
    if len(content) > limit:
        raise InputError(f"{where} grow from {len(data)} to more than {limit} bytes, expected less")
    return content


def read_arrays(path: str | Path, names: tuple[str, ...], what: str) -> list[np.ndarray]:
    """Read arrays of an .npz file.

    Args:
        path: The file.
        names: Names of the arrays.
        what: Kind of the file for error messages.

    Raises:
        InputError: The file is missing or damaged, lacks an array, has one that is not of numbers, or grows beyond
            `growth_limit`.
    """
    limit = growth_limit(file_size(path, what))
    try:
        with zipfile.ZipFile(path) as archive:
            members = [archive.getinfo(f"{name}.npy") for name in names]
            if (grown := sum(member.file_size for member in members)) > limit:
                raise InputError(f"arrays of {grown} bytes, expected at most {limit}")
            arrays = []
            for member in members:
                with archive.open(member) as file:
                    arrays.append(read_npy(file, member.file_size))
            return arrays
    except ARCHIVE_ERRORS as error:
        raise InputError(f"{what} {path} cannot be read: {error}; delete the file to create it again") from error


def read_npy(file: io.BufferedIOBase, size: int) -> np.ndarray:
    """Read an array of numbers or truth values in NumPy's .npy format.

    Args:
        file: The file, at its start.
        size: Its size in bytes, which the array's shape must fit.

    Raises:
        InputError: The file is damaged, or its array is of another type or size.
    """
    try:
        version = np.lib.format.read_magic(file)
        if version not in ((1, 0), (2, 0)):
            raise ValueError(f"version {version} of the format")
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = header(file)
        expected = size - file.tell()
        if dtype.kind not in "biuf" or min(shape, default=1) < 0 or math.prod(shape) * dtype.itemsize != expected:
            raise ValueError(f"{dtype} of shape {shape} in {expected} bytes")
        file.seek(0)
        return np.lib.format.read_array(file, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise InputError(f"not an array of numbers ({error})") from error


def path_inside(root: str | Path, relative: str) -> Path:
    """Resolve a path relative to a folder.

    Raises:
        InputError: The path leads out of the folder (by "..", as an absolute path or by a link).
    """
    resolved_root = Path(root).resolve()
    try:
        if (
            any(len(os.fsencode(part)) > _LONGEST_NAME for part in Path(relative).parts)
            or len(relative) > _LONGEST_PATH
        ):
            raise ValueError("too long")
        resolved = (resolved_root / relative).resolve()
        inside = resolved.is_relative_to(resolved_root) and not Path(relative).is_absolute()
    except (ValueError, OSError, RuntimeError) as error:  # null byte, name too long, cyclic links
        raise InputError(f"path {relative!r} in {root} is invalid: {error}") from error
    if not inside:
        raise InputError(f"path {relative!r} leads out of the data folder {root}, expected a path inside")
    return resolved


def plain_name(name: str, what: str) -> str:
    """Return `name` if it is a valid name of a single file or folder.

    Args:
        name: The name.
        what: What it names, for the error message.

    Raises:
        InputError: The name is empty, begins with a dot, or contains a separator.
    """
    if not isinstance(name, str) or not name or name.startswith(".") or any(c in "/\\:\0" for c in name):
        raise InputError(f"{what} name is {name!r}, expected a plain folder name")
    if len(name.encode(errors="surrogateescape")) > _LONGEST_NAME:
        raise InputError(f"{what} name has {len(name)} characters, expected at most {_LONGEST_NAME} bytes")
    return name


def _shown(path: str | Path) -> str:
    """Format a path that may be very long or hold control characters."""
    text = str(path)
    return text if text.isprintable() and len(text) < 500 else f"{text[:100]!r}..."

"""Atomic writes, reads with errors that name the file, and checks of paths and names.

The standard library has no atomic write, and the package `atomicwrites` is no longer maintained.
"""

import os
import secrets
import zipfile
import zlib
from pathlib import Path

import numpy as np

from zsp_lite.errors import InputError


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write a file atomically: a reader sees the old content or the new one, never a part.

    The data is written to a temporary file in the same folder, which is then renamed. Missing folders are created.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The random part is for threads, which share the process id.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: str | Path, what: str) -> bytes:
    """Read a file.

    Args:
        path: The file.
        what: Its kind for error messages, such as "image".

    Raises:
        InputError: The file cannot be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{what} {path} cannot be read: {reason.lower()}") from error


def read_arrays(path: str | Path, names: tuple[str, ...], what: str) -> list[np.ndarray]:
    """Read arrays of an .npz file.

    Args:
        path: The file.
        names: Names of the arrays.
        what: Kind of the file for error messages.

    Raises:
        InputError: The file is missing or damaged, or lacks an array.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            return [file[name] for name in names]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{what} {path} cannot be read: {error}; delete the file to create it again") from error


def path_inside(root: str | Path, relative: str) -> Path:
    """Resolve a path relative to a folder.

    Raises:
        InputError: The path leads out of the folder (by "..", as an absolute path or by a link).
    """
    resolved_root = Path(root).resolve()
    try:
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
    return name

"""Files on disk: atomic writes, reads that say what is wrong, and paths that must stay inside a folder."""

import os
import secrets
import zipfile
import zlib
from pathlib import Path

import numpy as np

from zsp_lite.errors import InputError


def write_atomic(path: str | Path, data: bytes) -> None:
    """Write `data` to `path` so that a reader sees the old file or the new one, never half of one.

    Missing folders are made. The bytes go to a temporary neighbour first (same folder, hence same file
    system), which then takes the name.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    # The process id alone would let two threads share a name.
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.tmp")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def read_bytes(path: str | Path, what: str) -> bytes:
    """The bytes of `path`; InputError naming `what` it should be ("image", ...) where it cannot be read."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        reason = error.strerror or type(error).__name__
        raise InputError(f"{what} {path} cannot be read: {reason.lower()}") from error


def read_arrays(path: str | Path, names: tuple[str, ...], what: str) -> list[np.ndarray]:
    """The arrays `names` of an .npz file; InputError naming `what` it should be where it is not, or is damaged."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return [file[name] for name in names]
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{what} {path} are damaged or something else: {error}; remove it to make it anew") from error


def path_inside(root: str | Path, relative: str) -> Path:
    """`root / relative`, resolved; InputError where that leaves `root` (by `..`, an absolute path or a link)."""
    resolved_root = Path(root).resolve()
    try:
        resolved = (resolved_root / relative).resolve()
        inside = resolved.is_relative_to(resolved_root) and not Path(relative).is_absolute()
    except (ValueError, OSError, RuntimeError) as error:  # a null byte, a name too long, a loop of links
        raise InputError(f"path {relative!r} is not usable below {root}: {error}") from error
    if not inside:
        raise InputError(f"path {relative!r} leaves the data folder {root}; expected a path inside it")
    return resolved


def plain_name(name: str, what: str) -> str:
    """`name`, where it is fit to be one folder's or file's; InputError where it would lead elsewhere."""
    if not isinstance(name, str) or not name or name.startswith(".") or any(c in "/\\:\0" for c in name):
        raise InputError(f"{what} name is {name!r}, expected a plain folder name")
    return name

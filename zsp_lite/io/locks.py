"""One writer per folder, or per file."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from zsp_lite.errors import InputError


@contextmanager
def writing(folder: str | Path, name: str = ".writing.lock", timeout: float = 0) -> Iterator[None]:
    """Be the only writer of a folder; InputError if another process writes to it.

    `name` is that of the lock's file, of which a folder may have several. Another process is waited
    for up to `timeout` seconds, without end if it is -1. The folder is made if it does not exist.
    If nothing was written into it, it is removed again.
    """
    folder = Path(folder)
    # The folders that are made here, the innermost first.
    missing = [place for place in (folder, *folder.parents) if not os.path.exists(place)]
    path = folder / name
    lock = FileLock(path, timeout=timeout)
    if folder.resolve() == folder.resolve().parent:
        raise InputError(f"{folder} is the root of the disk, expected a folder for what is written")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock.acquire()
    except OSError as error:  # the lock's Timeout is an OSError, too
        problem = f"cannot be written ({error})"
        if isinstance(error, Timeout):
            problem = "another process is writing to it"
        raise InputError(
            f"{folder}: {problem}, expected a folder for this process alone"
        ) from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows does not remove an open file
            path.unlink()
        lock.release()
        with suppress(OSError):  # a folder that is not empty stays
            for place in missing:
                place.rmdir()

"""One writer per folder."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from zsp_lite.errors import InputError
from zsp_lite.io.files import make_folder

LOCK = ".writing.lock"


@contextmanager
def writing(folder: str | Path) -> Iterator[None]:
    """Be the only writer of a folder, which is made if it does not exist.

    The lock is one of the operating system, which is released when the process ends, however it ends.

    Raises:
        InputError: Another process writes to the folder, or the folder cannot be written.
    """
    path = make_folder(folder, "folder") / LOCK
    lock = FileLock(path, timeout=0)
    try:
        lock.acquire()
    except Timeout as error:
        raise InputError(f"{folder}: another process is writing to it") from error
    except OSError as error:
        raise InputError(f"{path} cannot be opened for writing ({error}); choose another folder") from error
    try:
        yield
    finally:
        with suppress(OSError):  # Windows keeps an open file
            path.unlink()
        lock.release()

"""One writer per folder."""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from zsp_lite.errors import InputError
from zsp_lite.io.files import make_folder

LOCK = ".writing.lock"


@contextmanager
def writing(folder: str | Path) -> Iterator[None]:
    """Be the only writer of a folder, which is made if it does not exist.

    The lock is one of the operating system, which is released when the process ends, however it ends. Its file is
    removed while it is locked. A lock on a file that another writer removed just before counts for nothing; the folder
    is then taken as one that is written to.

    The folders that were made and are still empty at the end are removed.

    Raises:
        InputError: Another process writes to the folder, or the folder cannot be written.
    """
    new = [one for one in (Path(folder), *Path(folder).parents) if not os.path.exists(one)]
    folder = make_folder(folder, "folder")
    with ExitStack() as opened:
        for one in reversed(new):
            opened.callback(_remove_if_empty, one)  # after an error, before which nothing was written
        try:
            opened.enter_context(FileLock(folder / LOCK, timeout=0))
        except Timeout as error:
            raise InputError(f"{folder}: another process is writing to it") from error
        except OSError as error:
            raise InputError(
                f"{folder / LOCK} cannot be opened for writing ({error}); choose another folder"
            ) from error
        try:
            yield
        finally:
            with suppress(OSError):  # Windows keeps an open file
                (folder / LOCK).unlink()


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # not empty
        folder.rmdir()

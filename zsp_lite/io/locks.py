"""One writer per folder."""

import sqlite3
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from pathlib import Path

from zsp_lite.errors import InputError
from zsp_lite.io.files import make_folder

LOCK = ".writing.lock"


@contextmanager
def writing(folder: str | Path) -> Iterator[None]:
    """Be the only writer of a folder, which is made if it does not exist.

    The lock is SQLite's, which works on every operating system and is released when the process ends, however it ends.

    Raises:
        InputError: Another process writes to the folder, or the folder cannot be written.
    """
    new = not Path(folder).exists()
    folder = make_folder(folder, "folder")
    try:
        lock = sqlite3.connect(folder / LOCK, timeout=0)
    except sqlite3.Error as error:
        raise InputError(f"{folder / LOCK} cannot be opened for writing ({error}); choose another folder") from error
    with ExitStack() as opened:
        if new:
            opened.callback(_remove_if_empty, folder)  # after an error, before which nothing was written
        opened.enter_context(closing(lock))
        try:
            lock.execute("BEGIN EXCLUSIVE")
        except sqlite3.Error as error:
            raise InputError(f"{folder}: another process is writing to it, or it is not writable ({error})") from error
        try:
            yield
        finally:
            with suppress(OSError):  # Windows keeps an open file
                (folder / LOCK).unlink()


def _remove_if_empty(folder: Path) -> None:
    with suppress(OSError):  # not empty
        folder.rmdir()

"""One thread for OpenCV, BLAS and OpenMP."""

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache

import cv2
from threadpoolctl import OpenBLASController, ThreadpoolController

_lock = threading.Lock()
_blocks = 0  # number of blocks of `one_thread` that are open, in all threads
_of_process = ExitStack()  # restores the process's numbers of threads
# From threadpoolctl 3.8 on, only the thread that set the number for OpenBLAS first may set it,
# unless this is called.
_let_this_thread_set = getattr(OpenBLASController, "clear_controlling_thread", lambda force: None)


@lru_cache(1)
def _libraries(modules: int) -> ThreadpoolController:
    """Find the loaded libraries, which takes ten milliseconds: again only after an import, which
    changes the number of modules."""
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict all libraries to one thread within a block.

    On small matrices more threads are slower, and they take processors from other workers.
    """
    global _blocks
    libraries = _libraries(len(sys.modules))
    with _lock:
        _blocks += 1
        # OpenCV and BLAS have one number for all threads of the process: the last of several blocks
        # restores it.
        if _blocks == 1:
            _of_process.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(1)
            _let_this_thread_set(force=True)
            _of_process.callback(libraries.limit(limits=1, user_api="blas").restore_original_limits)
    try:
        with libraries.limit(limits=1, user_api="openmp"):  # of this thread; torch counts by it
            yield
    finally:
        with _lock:
            _blocks -= 1
            if not _blocks:
                _let_this_thread_set(force=True)
                _of_process.close()

"""One thread for OpenCV, BLAS and OpenMP."""

import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import lru_cache

import cv2
from threadpoolctl import ThreadpoolController

_lock, _blocks, _of_process = threading.Lock(), 0, ExitStack()


@lru_cache(1)
def _libraries(modules: int) -> ThreadpoolController:
    """Find the loaded libraries, which takes ten milliseconds; anew only after imports, by the number of modules."""
    return ThreadpoolController()


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict all libraries to one thread within a block: more are slower on small matrices, and disturb workers."""
    global _blocks
    libraries = _libraries(len(sys.modules))
    with _lock:
        _blocks += 1
        # OpenCV and BLAS have one number for all threads of the process: the last of several blocks restores it.
        if _blocks == 1:
            _of_process.callback(cv2.setNumThreads, cv2.getNumThreads())
            cv2.setNumThreads(1)
            _of_process.enter_context(libraries.limit(limits=1, user_api="blas"))
    try:
        with libraries.limit(limits=1, user_api="openmp"):  # of this thread; torch counts by it
            yield
    finally:
        with _lock:
            _blocks -= 1
            if not _blocks:
                _of_process.close()

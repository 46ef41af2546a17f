"""Evaluate chunks of pairs in this process, a pool of processes, or any
`concurrent.futures.Executor`.

A chunk is a few pairs of one category that share frames. A killed run loses the chunks that were
being evaluated.
"""

import logging
import os
import pkgutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from functools import partial
from itertools import chain
from multiprocessing import active_children, get_context, parent_process
from pathlib import Path
from typing import Any
from uuid import uuid4

import cloudpickle
from torch import get_num_threads
from tqdm import tqdm

from zsp_lite.benchmark.runs import ResultLine, add_lines, read_lines
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError, check_integer, ends_the_run
from zsp_lite.io.files import digest, read_bytes, write_atomic
from zsp_lite.threads import one_thread

Chunk = list[tuple[Pair, list[str]]]  # pairs of one category, and the rows to evaluate on each
Evaluate = Callable[[Pair, list[str]], dict[str, Any]]  # finds the line of a run for a pair
CHUNK_SIZE = 16  # pairs
logger = logging.getLogger(__name__)
_UNKNOWN_WORKERS = 256  # of an executor that does not tell


class _Processes(ProcessPoolExecutor):
    """Processes that `open_workers` ends; the pool's thread would print a traceback if their
    futures were cancelled."""


def make_chunks(work: Mapping[Pair, list[str]], size: int = CHUNK_SIZE) -> list[Chunk]:
    """Divide pairs into chunks of one category and at most `size` pairs, which share frames."""
    chunks: list[Chunk] = []
    for pair in sorted(work, key=lambda pair: (pair.category, pair.target_sequence, pair.key)):
        if not chunks or len(chunks[-1]) == size or chunks[-1][0][0].category != pair.category:
            chunks.append([])
        chunks[-1].append((pair, work[pair]))
    return chunks


def evaluate_pairs(
    out: str | Path,
    make: Callable[[int], Evaluate],
    work: Mapping[Pair, list[str]],
    executor: Executor | None,
    workers: int,
    kind: type = ResultLine,
) -> None:
    """Evaluate the rows and pairs that a run lacks, and add the lines found to it at once.

    Args:
        out: Folder of the run.
        make: Makes what finds the line of a pair, from the number of threads that it may use.
        work: The rows of each pair.
        executor: Where to evaluate, with its number of workers; None for this process.
        kind: Type of the lines.
    """
    known = set()
    for line in read_lines(out, kind):
        known |= {(row, line.pair, line.repeat) for row in line.results}
    todo = {}
    for pair, names in work.items():
        new = [name for name in names if (name, pair.key, pair.repeat) not in known]
        if new:
            todo[pair] = new
    if not todo:
        return
    make = partial(make, max(1, get_num_threads() // workers))
    # At least four chunks for each worker, so that all end at about the same time.
    chunks = make_chunks(todo, max(1, min(CHUNK_SIZE, len(todo) // (4 * workers))))
    hidden = None if logger.isEnabledFor(logging.INFO) else True  # None: outside a terminal
    done = len(work) - len(todo)
    with tqdm(total=len(work), initial=done, unit="pair", delay=1, disable=hidden) as bar:

        def store(lines: list[dict[str, Any]]) -> None:
            add_lines(out, lines)
            bar.update(len(lines))

        if executor is None:
            evaluate = make()
            with one_thread():
                for pair, rows in chain.from_iterable(chunks):
                    store([evaluate(pair, rows)])
            return
        with _rows_for_workers(make, executor, out) as (path, checksum):
            futures = [executor.submit(_evaluate_chunk, path, checksum, chunk) for chunk in chunks]
            try:
                for future in as_completed(futures):
                    store(future.result())
            finally:
                if not isinstance(executor, _Processes):
                    for future in futures:
                        future.cancel()


@contextmanager
def _rows_for_workers(
    make: Callable[[], Evaluate], executor: Executor, out: str | Path
) -> Iterator[tuple[str, str]]:
    """Write what evaluates pairs to a file in the run's folder, which all workers see.

    A backbone has megabytes, and each worker reads it once. Yields the path, absolute because a
    worker may have another current folder, and the digest of the file. Errors of workers that are
    no row's become one line.
    """
    path = Path(out).resolve() / f".rows-{uuid4()}"
    pickled = _pickle(make, executor)
    try:
        write_atomic(path, pickled)
        yield str(path), digest(pickled)
    except ImportError as error:
        raise InputError(
            f"a worker cannot import the rows: {error}, expected the module there, too"
        ) from error
    except Exception as error:
        # Dask's KilledWorker is known by its name only: Dask may not be installed.
        if not isinstance(error, BrokenExecutor) and type(error).__name__ != "KilledWorker":
            raise
        raise InputError(
            "a worker ended abruptly, perhaps out of memory; finished pairs are stored: run again "
            "to continue, with fewer workers"
        ) from error
    finally:
        path.unlink(missing_ok=True)


def _pickle(make: Callable[[], Any], executor: Executor) -> bytes:
    """Pickle by value what a notebook, or a module in the current folder, defines: workers need not
    see it."""
    # Processes of this machine import what this one can import.
    if not isinstance(executor, ProcessPoolExecutor):
        found = {module.name for module in pkgutil.iter_modules([os.getcwd()])} - {"zsp_lite"}
        for name in found & sys.modules.keys():
            cloudpickle.register_pickle_by_value(sys.modules[name])
    with ends_the_run("sending the rows to workers"):
        return cloudpickle.dumps(make)


_worker = threading.local()  # an executor's workers may be threads


def _evaluate_chunk(path: str, checksum: str, chunk: Chunk) -> list[dict[str, Any]]:
    """Evaluate a chunk in a worker, which keeps what evaluates it for the next one of the call."""
    if getattr(_worker, "path", None) != path:
        pickled = read_bytes(path, "rows of the run")
        if digest(pickled) != checksum:  # never unpickle what somebody else has written
            raise InputError(
                f"rows of the run {path} have changed, expected the file that this run wrote"
            )
        _worker.evaluate = cloudpickle.loads(pickled)()
        _worker.path = path
    with one_thread():
        return [_worker.evaluate(pair, rows) for pair, rows in chunk]


@contextmanager
def open_workers(executor: Executor | int = 1) -> Iterator[tuple[Executor | None, int]]:
    """Open an executor (None: this process) with its number of workers, and close it after the
    block.

    It is a number of processes, 1 for this one, or an Executor, which stays open.
    """
    if isinstance(executor, Executor):
        known = getattr(executor, "_max_workers", None)
        yield executor, known or getattr(executor, "num_workers", _UNKNOWN_WORKERS)
        return
    check_integer("workers", executor, 1, 4096)
    if executor == 1:
        yield None, 1
        return
    before = set(active_children())
    # Spawned, not forked: a fork of a process whose threads have already computed may hang.
    with _Processes(executor, get_context("spawn"), _start_worker) as pool:
        try:
            yield pool, executor
        finally:  # ends at once, without waiting for what is being evaluated or a thread of a row
            for child in set(active_children()) - before:
                child.terminate()


def _start_worker() -> None:
    """Ignore interrupts, which the parent process handles, and end when the parent ends, even if it
    was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

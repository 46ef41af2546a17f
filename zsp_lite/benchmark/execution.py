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
from contextlib import closing, contextmanager
from itertools import chain, groupby
from multiprocessing import active_children, get_context, parent_process
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple
from uuid import uuid4

import cloudpickle
from torch import get_num_threads
from tqdm import tqdm

from zsp_lite.benchmark.runs import ResultLine, add_lines, read_lines
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError, check_integer, ends_the_run
from zsp_lite.io.files import digest, read_bytes, write_atomic
from zsp_lite.threads import one_thread

# Evaluates the named rows on a pair, and returns the line of the run.
Evaluator = Callable[[Pair, list[str]], dict[str, Any]]
# Loads an evaluator, which computes features with this number of threads. It travels to a worker
# and is called there.
Opener = Callable[[int], Evaluator]
Chunk = list[tuple[Pair, list[str]]]  # pairs of one category, each with the names of its rows
CHUNK_SIZE = 16  # pairs
# Assumed of an executor that does not tell its number of workers: many, so that chunks are small
# and each worker computes with one thread.
_UNKNOWN_WORKERS = 256
_MOST_WORKERS = 4096  # largest number of processes that is accepted
logger = logging.getLogger(__name__)


class Workers(NamedTuple):
    """Where pairs are evaluated (see `open_workers`)."""

    executor: Executor | None  # None for this process
    count: int
    own: bool = False  # processes that `open_workers` has started, and will end


def make_chunks(work: Mapping[Pair, list[str]], size: int = CHUNK_SIZE) -> list[Chunk]:
    """Divide pairs into chunks of one category and at most `size` pairs, which share frames."""
    ordered = sorted(work, key=attrgetter("category", "target_sequence", "key"))
    chunks: list[Chunk] = []
    for _, members in groupby(ordered, key=attrgetter("category")):
        pairs = [(pair, work[pair]) for pair in members]
        chunks += [pairs[start : start + size] for start in range(0, len(pairs), size)]
    return chunks


def evaluate_pairs(
    out: str | Path,
    opener: Opener,
    work: Mapping[Pair, list[str]],
    workers: Workers,
    kind: type = ResultLine,
) -> None:
    """Evaluate the rows and pairs that a run lacks, and add each line to the run when it is found.

    Args:
        out: Folder of the run.
        opener: Loads what evaluates a pair.
        work: The names of the rows of each pair.
        workers: Where to evaluate.
        kind: Type of the lines.
    """
    # What the run lacks.
    stored = set()
    for line in read_lines(out, kind):
        stored.update((name, line.pair, line.repeat) for name in line.results)
    todo = {}
    for pair, names in work.items():
        missing = [name for name in names if (name, pair.key, pair.repeat) not in stored]
        if missing:
            todo[pair] = missing
    if not todo:
        return

    # At least four chunks for each worker, so that all end at about the same time.
    chunks = make_chunks(todo, max(1, min(CHUNK_SIZE, len(todo) // (4 * workers.count))))
    threads = max(1, get_num_threads() // workers.count)
    # None shows the bar in a terminal only.
    hidden = None if logger.isEnabledFor(logging.INFO) else True
    found = _lines(opener, threads, workers, chunks, out)
    # Closed, so that workers get no more to do where a line cannot be stored.
    with (
        tqdm(
            total=len(work), initial=len(work) - len(todo), unit="pair", delay=1, disable=hidden
        ) as bar,
        closing(found),
    ):
        for lines in found:
            add_lines(out, lines)
            bar.update(len(lines))


def _lines(
    opener: Opener, threads: int, workers: Workers, chunks: list[Chunk], out: str | Path
) -> Iterator[list[dict[str, Any]]]:
    """Yield the lines of pairs when they are found: one by one in this process, else by chunk."""
    if workers.executor is None:
        evaluate = opener(threads)
        with one_thread():
            for pair, names in chain.from_iterable(chunks):
                yield [evaluate(pair, names)]
        return

    # A backbone has megabytes: each worker reads the opener once, from a file in the run's
    # folder, which all workers see.
    pickled = _pickle(opener, workers)
    checksum = digest(pickled)
    # Absolute, because a worker may have another current folder.
    path = Path(out).resolve() / f".rows-{uuid4()}"
    futures = []
    try:
        write_atomic(path, pickled)
        for chunk in chunks:
            task = (_evaluate_chunk, str(path), checksum, threads, chunk)
            futures.append(workers.executor.submit(*task))
        for future in as_completed(futures):
            yield future.result()
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
        # A pool that is about to end would print a traceback for each cancelled future.
        if not workers.own:
            for future in futures:
                future.cancel()
        path.unlink(missing_ok=True)


def _pickle(opener: Opener, workers: Workers) -> bytes:
    """Pickle an opener; what a notebook or a module in the current folder defines goes with it,
    since workers need not see it."""
    # Processes of this machine import what this one can import.
    if not isinstance(workers.executor, ProcessPoolExecutor):
        local = {module.name for module in pkgutil.iter_modules([os.getcwd()])} - {"zsp_lite"}
        for name in local & sys.modules.keys():
            cloudpickle.register_pickle_by_value(sys.modules[name])
    with ends_the_run("sending the rows to workers"):
        return cloudpickle.dumps(opener)


_worker = threading.local()  # an executor's workers may be threads


def _evaluate_chunk(path: str, checksum: str, threads: int, chunk: Chunk) -> list[dict[str, Any]]:
    """Evaluate a chunk in a worker, which keeps the evaluator for the next chunk of the run."""
    if getattr(_worker, "path", None) != path:
        pickled = read_bytes(path, "rows of the run")
        if digest(pickled) != checksum:  # never unpickle what somebody else has written
            raise InputError(
                f"rows of the run {path} have changed, expected the file that this run wrote"
            )
        _worker.evaluate = cloudpickle.loads(pickled)(threads)
        _worker.path = path
    with one_thread():
        return [_worker.evaluate(pair, names) for pair, names in chunk]


@contextmanager
def open_workers(executor: Executor | int = 1) -> Iterator[Workers]:
    """Open a number of processes, 1 for this one, and end them after the block; an Executor stays
    open."""
    if isinstance(executor, Executor):
        # Executors of `concurrent.futures` have `_max_workers`, mpi4py's has `num_workers`.
        count = getattr(executor, "_max_workers", None)
        if not count:
            count = getattr(executor, "num_workers", _UNKNOWN_WORKERS)
        yield Workers(executor, count)
        return
    check_integer("workers", executor, 1, _MOST_WORKERS)
    if executor == 1:
        yield Workers(None, 1)
        return
    before = set(active_children())
    # Spawned, not forked: a fork of a process whose threads have already computed may hang.
    with ProcessPoolExecutor(executor, get_context("spawn"), _start_worker) as pool:
        try:
            yield Workers(pool, executor, own=True)
        finally:
            # Ends at once, without waiting for a pair in progress or a thread of a row.
            for child in set(active_children()) - before:
                child.terminate()


def _start_worker() -> None:
    """Leave interrupts to the parent process, and end when it ends, even if it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()

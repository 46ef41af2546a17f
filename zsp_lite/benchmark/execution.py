"""Evaluate pairs in this process, a pool of processes, or any `concurrent.futures.Executor`.

Workers get chunks of a few pairs that share frames. A killed run loses the chunks that were being
evaluated.
"""

import logging
import os
import pkgutil
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from itertools import chain
from multiprocessing import active_children, get_context, parent_process
from operator import attrgetter
from pathlib import Path
from typing import Any
from uuid import uuid4

import cloudpickle
from torch import get_num_threads
from tqdm import tqdm

from zsp_lite.benchmark.runs import add_lines
from zsp_lite.data.co3d import Pair
from zsp_lite.errors import InputError, check_integer, ends_the_run
from zsp_lite.io.files import digest, read_bytes, write_atomic
from zsp_lite.io.threads import one_thread

# Evaluates the named rows on a pair, and returns the line of the run.
Evaluator = Callable[[Pair, list[str]], Any]
# Loads an evaluator, which computes features with this number of threads. It travels to a worker
# and is called there.
Opener = Callable[[int], Evaluator]
Chunk = list[tuple[Pair, list[str]]]  # pairs, each with the names of its rows
# Pairs. Small, so that the progress bar moves; workers keep frames from chunk to chunk anyway.
_LARGEST_CHUNK = 4
_MOST_WORKERS = 4096  # processes; a larger number is taken for a mistake
logger = logging.getLogger(__name__)


def check_workers(executor: Executor | int) -> None:
    """Raise InputError for what is neither an Executor nor a number of processes."""
    if not isinstance(executor, Executor):
        check_integer("workers", executor, 1, _MOST_WORKERS)


def evaluate_pairs(
    out: str | Path,
    opener: Opener,
    work: Mapping[Pair, list[str]],
    executor: Executor | int,
    lines: list[Any],
) -> None:
    """Evaluate the rows and pairs that a run lacks, and add each line to the run when it is found.

    Args:
        out: Folder of the run.
        opener: Loads what evaluates a pair.
        work: The names of the rows of each pair.
        executor: Number of processes, 1 for this one, or an Executor, which stays open.
        lines: Those of the run (see `open_run`); the new ones are appended.
    """
    # What the run lacks.
    stored = {(name, line.pair, line.repeat) for line in lines for name in line.results}
    todo = []
    # Pairs that share frames are neighbours.
    for pair in sorted(work, key=attrgetter("category", "target_sequence", "key")):
        missing = [name for name in work[pair] if (name, pair.key, pair.repeat) not in stored]
        if missing:
            todo.append((pair, missing))
    if not todo:
        return

    # Fewer than 64 pairs are handed out one by one, so that every worker has some.
    size = min(_LARGEST_CHUNK, 1 + len(todo) // 64)
    chunks = [todo[start : start + size] for start in range(0, len(todo), size)]
    # None shows the bar in a terminal only.
    hidden = None if logger.isEnabledFor(logging.INFO) else True
    # Closed, so that workers get no more to do where a line cannot be stored.
    with (
        tqdm(
            total=len(work), initial=len(work) - len(todo), unit="pair", delay=1, disable=hidden
        ) as bar,
        closing(_lines(opener, executor, chunks, out)) as found,
    ):
        for some in found:
            add_lines(out, some)
            lines += some
            bar.update(len(some))


def _lines(
    opener: Opener, executor: Executor | int, chunks: list[Chunk], out: str | Path
) -> Iterator[list[Any]]:
    """Yield the lines of pairs when they are found: one by one in this process, else by chunk."""
    if executor == 1:
        evaluate = opener(get_num_threads())
        with one_thread():
            for pair, names in chain.from_iterable(chunks):
                yield [evaluate(pair, names)]
        return

    given = isinstance(executor, Executor)
    # An Executor has one worker per core (docs/scale.md).
    threads = 1 if given else max(1, get_num_threads() // executor)
    # A backbone has megabytes: each worker reads the opener once, from a file in the run's
    # folder, which all workers see. Absolute, because a worker may have another current folder.
    path = Path(out).resolve() / f".rows-{uuid4()}"
    futures = []
    with nullcontext(executor) if given else _processes(executor) as workers:
        try:
            pickled = _pickle(opener, workers)
            write_atomic(path, pickled)
            task = partial(_evaluate_chunk, str(path), digest(pickled), threads)
            futures += [workers.submit(task, chunk) for chunk in chunks]
            for future in as_completed(futures):
                yield future.result()
        except ImportError as error:
            raise InputError(
                f"a worker cannot import the rows: {error}, expected the module there, too"
            ) from error
        except BrokenExecutor as error:
            raise InputError(
                "a worker ended abruptly, perhaps out of memory; finished pairs are stored: run "
                "again to continue, with fewer workers"
            ) from error
        finally:
            # A pool that is about to end would print a traceback for each cancelled future.
            if given:
                for future in futures:
                    future.cancel()
            path.unlink(missing_ok=True)


def _pickle(opener: Opener, workers: Executor) -> bytes:
    """Pickle an opener; what a notebook or a module in the current folder defines goes with it,
    since workers need not see it."""
    # Processes of this machine import what this one can import; others have zsp_lite installed.
    if not isinstance(workers, ProcessPoolExecutor):
        local = {module.name for module in pkgutil.iter_modules([os.getcwd()])} - {"zsp_lite"}
        for name in local & sys.modules.keys():
            cloudpickle.register_pickle_by_value(sys.modules[name])
    with ends_the_run("sending the rows to workers"):
        return cloudpickle.dumps(opener)


_worker = threading.local()  # an executor's workers may be threads


def _evaluate_chunk(path: str, checksum: str, threads: int, chunk: Chunk) -> list[Any]:
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
def _processes(count: int) -> Iterator[Executor]:
    """Start a number of processes, and end them after the block."""
    before = set(active_children())
    # Spawned, not forked: a fork of a process whose threads have already computed may hang.
    with ProcessPoolExecutor(count, get_context("spawn"), _start_worker) as pool:
        try:
            yield pool
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

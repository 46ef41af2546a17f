"""Who does the jobs: this process, a pool of processes, a Dask cluster, or any `concurrent.futures.Executor`.

No scheduler of our own: an executor is given all jobs at once. Jobs travel as cloudpickle's bytes, so that methods
and backbones defined in a notebook travel with them.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, ProcessPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait as wait_for
from pathlib import Path
from typing import Any

import cloudpickle

from zsp_lite.benchmark.jobs import Job, one_thread_each, records_of, run_job
from zsp_lite.benchmark.methods import import_object
from zsp_lite.benchmark.storage import PartReader, RunFolder
from zsp_lite.errors import InputError

_POLL = 0.3  # seconds between looks at what workers have finished
_PATIENCE = 15  # seconds to wait for a scheduler


@dataclass(frozen=True)
class Crew:
    """An executor with the number of its workers, and what it raises when one of them dies. None: this process."""

    executor: Executor | None
    workers: int
    deaths: tuple[type[BaseException], ...] = (BrokenExecutor,)


@contextmanager
def open_crew(executor: Executor | str | None, workers: int = 1) -> Iterator[Crew]:
    """The crew that is asked for, sent home afterwards.

    executor: None for this process, or, with workers > 1, a pool of so many; "dask://HOST:PORT"; "module:Class" of an
    executor to be made with the number of workers; or an Executor, which stays open. Raises InputError for others.
    """
    if workers < 1:
        raise InputError(f"workers is {workers}, expected at least 1")
    if executor is None:
        if workers == 1:
            yield Crew(None, 1)
            return
        with _process_pool(workers) as pool:
            yield Crew(pool, workers)
    elif isinstance(executor, Executor):
        yield Crew(executor, getattr(executor, "_max_workers", workers))
    elif executor.startswith("dask://"):
        with _dask(executor.removeprefix("dask://")) as crew:
            yield crew
    else:
        try:
            made = import_object(executor)
        except InputError as error:
            raise InputError(
                f"executor {executor!r}: expected dask://HOST:PORT or module:Class of an executor ({error})"
            ) from error
        with made(workers) as opened:
            yield Crew(opened, workers)


def execute(jobs: Sequence[Job], crew: Crew, folder: RunFolder, extractors: Any, finished: Callable[[], None]) -> None:
    """Have the jobs done; every record goes to the folder at once, and `finished` is called after it.

    extractors: a function that gives this process's own, called only where it does the work itself.
    Raises what a method or a damaged file raised, and InputError where a worker died.
    """
    if crew.executor is None:
        with one_thread_each():
            for job in jobs:
                for record in records_of(job, extractors()):
                    folder.add(record)
                    finished()
        return
    jobs = [
        replace(job, part=str((folder.parts / f"{job.category}-{number:04d}.jsonl").resolve()))
        for number, job in enumerate(jobs)
    ]
    readers = {job.part: PartReader(Path(job.part)) for job in jobs}
    pending = {crew.executor.submit(_run_pickled, cloudpickle.dumps(job)): job for job in jobs}
    try:
        while pending:
            over, _ = wait(pending, timeout=_POLL, return_when=FIRST_COMPLETED)
            for job in list(pending.values()):
                _take(readers[job.part].read(), folder, finished)
            for future in over:
                job = pending.pop(future)
                _take(future.result(), folder, finished)
                Path(job.part).unlink(missing_ok=True)
    except crew.deaths as error:
        raise InputError(
            "a worker ended abruptly, perhaps for want of memory; finished pairs are kept: run again to continue, "
            f"with fewer workers than {crew.workers}"
        ) from error
    finally:
        for future in pending:
            future.cancel()


def default_threads(workers: int) -> int:
    """This machine's cores, shared out among so many workers."""
    # What a container or a batch system leaves us may be less than the machine has.
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, cores // workers)


def _take(records: Sequence[dict], folder: RunFolder, finished: Callable[[], None]) -> None:
    for record in records:
        if folder.add(record):
            finished()


def _run_pickled(job: bytes) -> list[dict]:
    return run_job(cloudpickle.loads(job))


@contextmanager
def _process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    before = set(active_children())
    # Spawned, not forked: a fork of a process whose threads have computed already may hang.
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _start_worker)
    try:
        yield pool
    except BaseException:
        for child in set(active_children()) - before:
            child.terminate()
        pool.shutdown(wait=False, cancel_futures=True)
        raise
    pool.shutdown()


def _start_worker() -> None:
    """A worker leaves interrupts to its parent, and does not outlive it (a killed parent cannot send it home)."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        wait_for([parent_process().sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(address: str) -> Iterator[Crew]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise InputError("executor dask://: needs Dask; pip install 'zsp-lite[cluster]'") from error
    try:
        client = Client(f"tcp://{address}" if "://" not in address else address, timeout=_PATIENCE)
    except (OSError, ValueError) as error:
        raise InputError(f"executor dask://{address}: no scheduler answers there ({error})") from error
    with client:
        workers = sum(client.nthreads().values())
        if workers == 0:
            raise InputError(f"executor dask://{address}: the scheduler has no workers, expected at least one")
        # A job depends on files, so it is no pure function of its bytes.
        yield Crew(client.get_executor(pure=False), workers, (BrokenExecutor, KilledWorker))

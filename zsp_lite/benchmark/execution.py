"""Evaluate chunks of pairs in this process, a pool of processes, a Dask cluster, or any `concurrent.futures.Executor`.

A chunk is a few pairs of one category that share frames. A killed run loses the chunks that were being evaluated.
"""

import os
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Executor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from itertools import groupby, islice
from multiprocessing import active_children, get_context, parent_process
from multiprocessing.connection import wait as wait_for
from typing import Any

import cloudpickle
import cv2
from threadpoolctl import threadpool_limits

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark.evaluation import evaluate_pair
from zsp_lite.benchmark.extractors import make_extractors
from zsp_lite.benchmark.identity import fingerprint
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.store import FrameStore, torch_threads
from zsp_lite.data.co3d import Co3D, Pair
from zsp_lite.data.labels import read_labels
from zsp_lite.errors import InputError, check_integer

Chunk = list[tuple[Pair, list[str]]]  # pairs of one category, and the rows to evaluate on each
CHUNK_SIZE = 16  # pairs
MOST_WORKERS = 4096  # also of threads
_DASK_TIMEOUT = 15  # seconds to wait for a scheduler


@dataclass(frozen=True)
class Setup:
    """What all chunks of a run have in common; picklable."""

    root: str  # of the data
    methods: Mapping[str, Method]
    backbone: Any  # what `load_backbone` takes, or an extractor
    fingerprint: str | None = None  # of the backbone that a worker must find under the name; None for any
    threads: int | None = None  # of torch during feature extraction

    def extractors(self) -> dict[str, Any]:
        """Make the extractors of the rows. Raises InputError if the backbone's name stands for another one here."""
        backbone = self.backbone
        if isinstance(backbone, str | BackboneConfig):
            backbone = load_backbone(backbone)
            if self.fingerprint not in (None, found := fingerprint(backbone)):
                raise InputError(f"backbone {self.backbone} is {found} on a worker, expected {self.fingerprint}")
        return make_extractors(backbone, [method.features for method in self.methods.values()])


class Evaluator:
    """Evaluates chunks in one process; frames and features are kept from chunk to chunk."""

    def __init__(self, setup: Setup, extractors: Mapping[str, Any] | None = None):
        self.setup, self.extractors = setup, setup.extractors() if extractors is None else extractors
        self._dataset = Co3D(setup.root)
        self._store: FrameStore | None = None

    def records(self, chunk: Chunk) -> Iterator[dict[str, Any]]:
        """Evaluate the pairs of a chunk (see `evaluate_pair`)."""
        category = chunk[0][0].category
        if self._store is None or self._store.category != category:
            self._store = FrameStore(self._dataset, category, self.extractors, self.setup.threads)
            self._labels = read_labels(self.setup.root, category)
        for pair, names in chunk:
            methods = {name: self.setup.methods[name] for name in names}
            yield evaluate_pair(pair, methods, self._store, self._labels)


def make_chunks(pairs: Mapping[Pair, list[str]], size: int = CHUNK_SIZE) -> list[Chunk]:
    """Divide pairs of one category into chunks of about `size` pairs that share frames.

    Pairs that differ only in the number of target views stay together. Where possible, so do those of a target
    sequence.
    """

    def question(pair: Pair) -> tuple:
        return pair.target_sequence, pair.reference_sequence, pair.reference_frame

    chunks: list[Chunk] = [[]]
    ordered = sorted(pairs, key=lambda pair: (*question(pair), len(pair.target_frames), pair.key))
    for _, members in groupby(ordered, lambda pair: pair.target_sequence):
        together = [list(found) for _, found in groupby(members, question)]
        if len(chunks[-1]) + sum(map(len, together)) > size:
            chunks.append([])
        for found in together:
            if len(chunks[-1]) >= size:
                chunks.append([])
            chunks[-1] += [(pair, pairs[pair]) for pair in found]
    return [chunk for chunk in chunks if chunk]


@dataclass(frozen=True)
class Workers:
    """An executor (None: this process), the number of its workers, and the exceptions raised if a worker dies."""

    executor: Executor | None
    number: int
    deaths: tuple[type[BaseException], ...] = (BrokenExecutor,)


@contextmanager
def open_workers(executor: Executor | str | int = 1) -> Iterator[Workers]:
    """Open an executor, and close it after the block; an Executor stays open.

    It is a number of processes, 1 for this one; "dask://HOST:PORT"; or an Executor.
    """
    if isinstance(executor, Executor):
        yield Workers(executor, getattr(executor, "_max_workers", 1))
    elif isinstance(executor, str):
        if not executor.startswith("dask://"):
            raise InputError(
                f"executor is {executor!r}, expected a number of processes, dask://HOST:PORT or an Executor"
            )
        with _dask(executor.removeprefix("dask://")) as workers:
            yield workers
    else:
        check_integer("workers", executor, 1, MOST_WORKERS)
        with _process_pool(executor) if executor > 1 else nullcontext() as pool:
            yield Workers(pool, executor)


def evaluate_chunks(
    setup: Setup,
    chunks: Sequence[Chunk],
    workers: Workers,
    save: Callable[[list[dict[str, Any]]], None],
    extractors: Mapping[str, Any],
) -> None:
    """Evaluate chunks; `save` gets the records of each, or of each pair where this process evaluates them."""
    if workers.executor is None:
        evaluator = Evaluator(setup, extractors)
        with one_thread():
            for chunk in chunks:
                for record in evaluator.records(chunk):
                    save([record])
        return
    # cloudpickle: methods and backbones that are defined in a notebook travel by value.
    pickled, waiting, running = cloudpickle.dumps(setup), iter(chunks), set[Future]()
    try:
        while True:
            # Two chunks per worker keep it busy; more would fill queues with copies of the backbone.
            for chunk in islice(waiting, 2 * workers.number - len(running)):
                running.add(workers.executor.submit(_evaluate_chunk, pickled, chunk))
            if not running:
                return
            finished, running = wait(running, timeout=1, return_when=FIRST_COMPLETED)
            # Failures last: all that has been evaluated is saved before an error ends the run.
            for future in sorted(finished, key=lambda one: one.cancelled() or one.exception() is not None):
                save(future.result())
    except workers.deaths as error:
        fewer = f"run again to continue, with fewer workers than {workers.number}"
        raise InputError(
            f"a worker ended abruptly, perhaps out of memory; finished pairs are stored: {fewer}"
        ) from error
    finally:
        for future in running:
            future.cancel()


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    # A container or a batch system may grant fewer than the machine has.
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def one_thread() -> Iterator[None]:
    """Restrict all libraries to one thread within a block: more are slower on small matrices, and disturb workers."""
    cv2_threads = cv2.getNumThreads()
    with threadpool_limits(1), torch_threads(1):
        cv2.setNumThreads(1)
        try:
            yield
        finally:
            cv2.setNumThreads(cv2_threads)


_worker = threading.local()  # an executor's workers may be threads


def _evaluate_chunk(setup: bytes, chunk: Chunk) -> list[dict[str, Any]]:
    """Evaluate a chunk in a worker, which keeps its evaluator for the next one."""
    if getattr(_worker, "setup", None) != setup:
        _worker.evaluator = Evaluator(cloudpickle.loads(setup))
        _worker.setup = setup
    with one_thread():
        return list(_worker.evaluator.records(chunk))


@contextmanager
def _process_pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    before = set(active_children())
    # Spawned, not forked: a fork of a process whose threads have already computed may hang.
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
    """Ignore interrupts, which the parent process handles, and end when the parent ends, even if it was killed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)

    def watch() -> None:
        wait_for([parent_process().sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextmanager
def _dask(address: str) -> Iterator[Workers]:
    try:
        from distributed import Client
        from distributed.scheduler import KilledWorker
    except ImportError as error:
        raise InputError("executor dask://: needs Dask: pip install dask distributed") from error
    try:
        client = Client(f"tcp://{address}" if "://" not in address else address, timeout=_DASK_TIMEOUT)
        client.wait_for_workers(1, timeout=_DASK_TIMEOUT)
    except (OSError, ValueError) as error:
        raise InputError(f"executor dask://{address}: no scheduler with workers answers there ({error})") from error
    with client:
        # A chunk depends on files: equal arguments need not give equal results.
        executor = client.get_executor(pure=False)
        yield Workers(executor, sum(client.nthreads().values()), (BrokenExecutor, KilledWorker))

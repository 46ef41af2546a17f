"""The unit of work: a chunk of a category's pairs, small enough to hand out and large enough to share features in."""

import threading
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import torch
from threadpoolctl import threadpool_limits

from zsp_lite.backbones.load import BackboneConfig, load_backbone
from zsp_lite.benchmark.cache import FeatureCache
from zsp_lite.benchmark.evaluation import evaluate_pair
from zsp_lite.benchmark.extractors import fingerprint, make_extractors
from zsp_lite.benchmark.methods import Method
from zsp_lite.benchmark.storage import PartReader, part_writer
from zsp_lite.benchmark.store import FrameKey, FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import Pair
from zsp_lite.errors import InputError

Work = Sequence[tuple[Pair, Sequence[str]]]  # pairs and the rows that each of them still lacks


@dataclass(frozen=True)
class Job:
    """What a worker has to know to do `work`, pairs of one category.

    backbone: what `load_backbone` takes, or an object that is called on images.  cache: folder of feature maps, None
    for none.  threads: of torch while it describes a frame.  part: the file to append records to, None for no file.
    fingerprint: of the backbone that a worker is to find under the name, None for any.
    """

    root: str
    category: str
    work: Work
    methods: Mapping[str, Method]
    backbone: Any
    cache: str | None = None
    threads: int | None = None
    part: str | None = None
    fingerprint: str | None = None


def split(work: Work, pieces: int) -> list[list[tuple[Pair, Sequence[str]]]]:
    """A category's work in at most so many chunks of about one size, each in the order in which it is best done.

    Pairs go by target sequence, and a sequence's pairs stay together: they share their target frames. Within it, pairs
    that differ in the number of target views alone follow each other.
    """
    order = sorted(work, key=lambda item: _place(item[0]))
    chunks: dict[int, list] = {}
    before = 0
    for _, group in groupby(order, key=lambda item: item[0].target_sequence):
        items = list(group)
        # By where its middle lies: sequences of uneven numbers of pairs still give chunks of about one size.
        chunks.setdefault(int(pieces * (before + len(items) / 2) / len(order)), []).extend(items)
        before += len(items)
    return list(chunks.values())


def records_of(job: Job, extractors: Mapping[str, Any]) -> Iterator[dict]:
    """Do a job; each pair's record as soon as it is done."""
    dataset, labels = Co3D(job.root), read_labels(job.root, job.category)
    cache = None
    if job.cache is not None:
        kept = [name for name in extractors if name != "rootsift"]  # faster made than read
        cache = FeatureCache(job.cache, {name: fingerprint(extractors[name]) for name in kept})
    uses = Counter(key for pair, _ in job.work for key in frame_keys(pair))
    store = FrameStore(dataset, job.category, extractors, cache, job.threads, uses)
    for _, siblings in groupby(job.work, key=lambda item: _place(item[0])[:3]):
        for pair, names in siblings:
            yield evaluate_pair(pair, {name: job.methods[name] for name in names}, store, labels)
            store.release(frame_keys(pair))
        store.forget_similarities()


def run_job(job: Job) -> list[dict]:
    """Do a job in a worker; its records, which were appended to the job's own file one by one.

    A worker that takes over from one that died goes on behind what that one has finished, where it sees the file.
    """
    records: list[dict] = []
    finished: set[tuple[str, str]] = set()
    path = Path(job.part) if job.part else None
    if path is not None:
        records = PartReader(path).read()
        finished = {(record["key"], name) for record in records for name in record["methods"]}
    left = [(pair, [name for name in names if (pair.key, name) not in finished]) for pair, names in job.work]
    job = Job(**vars(job) | {"work": [item for item in left if item[1]]})
    with one_thread_each(), _writer(path) as write:
        for record in records_of(job, worker_extractors(job)):
            write(record)
            records.append(record)
    return records


def worker_extractors(job: Job) -> dict[str, Any]:
    """The extractors of a job's rows; loaded once in a process where the backbone goes by its name.

    Raises InputError where the name stands for another backbone here than where the run was started.
    """
    names = tuple(dict.fromkeys(method.features for method in job.methods.values()))
    if not isinstance(job.backbone, str | BackboneConfig):
        return make_extractors(job.backbone, names)
    with _loading:
        wanted = job.backbone, job.fingerprint, names
        if wanted not in _loaded:
            _loaded.clear()
            backbone = load_backbone(job.backbone)
            if job.fingerprint not in (None, found := fingerprint(backbone)):
                raise InputError(f"backbone {job.backbone} is {found} to a worker, expected {job.fingerprint}")
            _loaded[wanted] = make_extractors(backbone, names)
        return _loaded[wanted]


_loaded: dict[tuple, dict[str, Any]] = {}
_loading = threading.Lock()  # a Dask worker may run several jobs in threads


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Keep libraries from using all cores for small matrices, which is slower than one and starves other workers."""
    torch_threads, cv2_threads = torch.get_num_threads(), cv2.getNumThreads()
    with threadpool_limits(1):
        torch.set_num_threads(1)
        cv2.setNumThreads(1)
        try:
            yield
        finally:
            torch.set_num_threads(torch_threads)
            cv2.setNumThreads(cv2_threads)


def frame_keys(pair: Pair) -> list[FrameKey]:
    """The frames of a pair, the reference's first."""
    return [
        (pair.reference_sequence, pair.reference_frame),
        *((pair.target_sequence, number) for number in pair.target_frames),
    ]


def _place(pair: Pair) -> tuple:
    return pair.target_sequence, pair.reference_sequence, pair.reference_frame, len(pair.target_frames), pair.key


@contextmanager
def _writer(path: Path | None) -> Iterator[Any]:
    if path is None:
        yield lambda record: None
    else:
        with part_writer(path) as write:
            yield write

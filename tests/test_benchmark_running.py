"""A run's results: the same whoever computes them, in whatever order, however often it is killed."""

import enum
import functools
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmark_folder import SlowBackbone, own_method, small_folder
from synthetic_views import CoordinateBackbone

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark import run as run_module
from zsp_lite.benchmark.cache import FeatureCache
from zsp_lite.benchmark.execution import open_crew
from zsp_lite.benchmark.extractors import fingerprint as extractor_fingerprint
from zsp_lite.benchmark.identity import digest_of
from zsp_lite.benchmark.jobs import Job, frame_keys, records_of, run_job, split, worker_extractors
from zsp_lite.benchmark.methods import GROUPS, METHODS, Method, fingerprint, resolve
from zsp_lite.benchmark.plan import Plan, duration, frames_at_once, size
from zsp_lite.benchmark.problem import Answer, as_answer
from zsp_lite.benchmark.results import read_results
from zsp_lite.benchmark.run import evaluate, pairs_of_rows, plan_run, read_records, work_of_categories
from zsp_lite.benchmark.storage import PartReader, RunFolder, _append, part_writer
from zsp_lite.benchmark.store import FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels, write_label
from zsp_lite.data.pairs import sample_pairs
from zsp_lite.errors import InputError
from zsp_lite.pipeline import ZeroShotPose

BACKBONE = CoordinateBackbone()
ROWS = ("ours", "ours-bv")
TESTS = Path(__file__).parent


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run of `benchmark_folder`'s main, in this process."""
    out = tmp_path_factory.mktemp("undisturbed")
    return out, evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, 6, 3, out=out)


def start(out: Path) -> subprocess.Popen:
    command = [sys.executable, str(TESTS / "benchmark_folder.py"), str(small_folder()), str(out)]
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    return subprocess.Popen(command, env=os.environ | {"PYTHONPATH": paths}, stderr=subprocess.PIPE)


def wait_for_lines(path: Path, n: int, process: subprocess.Popen) -> None:
    while not path.is_file() or path.read_bytes().count(b"\n") < n:
        assert process.poll() is None, process.stderr.read().decode()
        time.sleep(0.005)


def test_a_run_killed_again_and_again_ends_with_the_same_tables(undisturbed, tmp_path):
    lines = 0
    for more in (1, 3):
        process = start(tmp_path)
        wait_for_lines(tmp_path / "pairs.jsonl", lines + more, process)
        process.kill()
        process.wait()
        lines = (tmp_path / "pairs.jsonl").read_bytes().count(b"\n")
    assert 4 <= lines < 12
    summary = evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, 6, 3, out=tmp_path)
    assert summary["methods"] == undisturbed[1]["methods"]
    # Nothing was done twice.
    assert (tmp_path / "pairs.jsonl").read_bytes().count(b"\n") == 12


def test_two_processes_find_what_one_finds_and_one_dying_costs_nothing_but_time(undisturbed, tmp_path):
    seen = []

    def kill_a_worker(done: int, total: int) -> None:
        if not seen:
            children = {int(pid) for pid in _children(os.getpid())} - before
            os.kill(max(children), signal.SIGKILL)
        seen.append((done, total))

    before = {int(pid) for pid in _children(os.getpid())}
    arguments = (small_folder(), SlowBackbone(), ROWS, 6, 3)
    with pytest.raises(InputError, match="run again"):
        evaluate(*arguments, out=tmp_path, workers=2, progress=kill_a_worker)
    again = evaluate(*arguments, out=tmp_path, workers=2, progress=lambda *step: seen.append(step))
    assert again["methods"] == undisturbed[1]["methods"]
    assert [total for _, total in seen] == [12] * len(seen) and seen[-1] == (12, 12)
    assert not list((tmp_path / "parts").iterdir())


def _children(pid: int) -> list[str]:
    return subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout.split()


def test_a_dask_cluster_that_loses_a_worker_finds_the_same(undisturbed, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        victim = cluster.workers[0].pid
        killed = []

        def kill(done: int, total: int) -> None:
            if not killed:
                os.kill(victim, signal.SIGKILL)
                killed.append(done)

        address = "dask://" + cluster.scheduler_address.removeprefix("tcp://")
        summary = evaluate(small_folder(), SlowBackbone(), ROWS, 6, 3, out=tmp_path, executor=address, progress=kill)
    assert killed and killed[0] < 12
    assert summary["methods"] == undisturbed[1]["methods"]


def test_any_executor_will_do(undisturbed, tmp_path):
    with ThreadPoolExecutor(1) as executor:
        summary = evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, 6, 3, out=tmp_path, executor=executor)
    assert summary["methods"] == undisturbed[1]["methods"]


def test_executors_that_are_none_are_refused(monkeypatch):
    monkeypatch.setattr("zsp_lite.benchmark.execution._PATIENCE", 1)
    for executor, told in (("dask://127.0.0.1:1", "no scheduler"), ("nowhere:Pool", "module:Class"), ("x", "dask://")):
        with pytest.raises(InputError, match=told), open_crew(executor):
            pass
    with pytest.raises(InputError, match="workers"), open_crew(None, 0):
        pass


@dataclass(frozen=True)
class Sociable(CoordinateBackbone):
    """Its features depend on how many images come together, as those of a real network do in their last bits."""

    name: str = "sociable"

    def __call__(self, images):
        found = super().__call__(images)
        return [replace(one, keys=one.keys * (1 + 0.3 * len(images))) for one in found]


def test_a_frame_is_described_by_itself_so_that_no_order_matters():
    root, rows = small_folder(), resolve(ROWS)
    work = work_of_categories(pairs_of_rows(root, rows, 6, 3, categories=["lump"]))["lump"]
    job = Job(str(root), "lump", [(pair, ROWS) for pair in work], rows, Sociable())
    extractors = {"backbone": Sociable()}

    def errors(job):
        return {record["key"]: record["methods"]["ours"]["error"] for record in records_of(job, extractors)}

    assert errors(job) == errors(replace(job, work=job.work[::-1]))


def test_a_vision_transformers_features_do_not_depend_on_threads():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        backbone = Backbone(VisionTransformer(32, 8, 24, 2, 3), "small", layer=1, device="cpu")
    root, rows = small_folder(), resolve(["ours"])
    work = work_of_categories(pairs_of_rows(root, rows, 2, 2, categories=["lump"]))["lump"]
    found = []
    for threads in (1, 2):
        job = Job(str(root), "lump", [(pair, ["ours"]) for pair in work], rows, backbone, threads=threads)
        records = list(records_of(job, {"backbone": backbone}))
        found.append([record["methods"]["ours"]["error"] for record in records])
    assert found[0] == found[1]


def test_work_is_split_between_target_sequences_and_nothing_is_lost():
    dataset = Co3D(small_folder())
    pairs = [*sample_pairs(dataset, "lump", 12, 3), *sample_pairs(dataset, "lump", 12, 5)]
    work = [(pair, ["ours"]) for pair in dict.fromkeys(pairs)]
    for pieces in (1, 2, 3, 7):
        chunks = split(work, pieces)
        assert len(chunks) <= pieces and sorted(map(str, work)) == sorted(str(one) for c in chunks for one in c)
        sequences = [{pair.target_sequence for pair, _ in chunk} for chunk in chunks]
        assert sum(map(len, sequences)) == len(set().union(*sequences))
    assert len(split(work, 3)) >= 2


def test_pairs_of_one_question_with_other_numbers_of_views_follow_each_other():
    dataset = Co3D(small_folder())
    (chunk,) = split([(pair, []) for n in (2, 4) for pair in sample_pairs(dataset, "lump", 6, n)], 1)
    questions = [(pair.target_sequence, pair.reference_sequence, pair.reference_frame) for pair, _ in chunk]
    assert len(list(groupby(questions))) == len(set(questions)) <= 6
    # Sampled with one seed, the frames of fewer views are among those of twice as many.
    several = [pair for pair, _ in chunk if len(pair.target_frames) == 4]
    for pair, _ in chunk:
        assert any(set(pair.target_frames) <= set(other.target_frames) for other in several)


def test_a_job_goes_on_behind_a_dead_worker_of_the_same_job(tmp_path):
    root, rows = small_folder(), resolve(["ours"])
    work = work_of_categories(pairs_of_rows(root, rows, 3, 2, categories=["lump"]))["lump"]
    part = tmp_path / "lump.jsonl"
    job = Job(str(root), "lump", [(pair, ["ours"]) for pair in work], rows, BACKBONE, part=str(part))
    whole = run_job(job)
    lines = part.read_bytes().splitlines(keepends=True)
    part.write_bytes(lines[0] + lines[1][:50])
    again = run_job(job)
    assert {r["key"]: r["methods"]["ours"]["error"] for r in again} == {
        r["key"]: r["methods"]["ours"]["error"] for r in whole
    }
    assert again[0] == json.loads(lines[0])
    assert len(PartReader(part).read()) == 3


def test_a_worker_that_cannot_see_the_folder_brings_its_records_back(tmp_path):
    with part_writer(tmp_path / "not" / "there" / "part.jsonl") as write:
        write({"key": "a"})
    assert not (tmp_path / "not").exists()


def test_parts_that_a_killed_run_left_are_taken_up(undisturbed, tmp_path):
    out, summary = undisturbed
    lines = (out / "pairs.jsonl").read_bytes().splitlines(keepends=True)
    (tmp_path / "run.json").write_bytes((out / "run.json").read_bytes())
    (tmp_path / "pairs.jsonl").write_bytes(b"".join(lines[:2]))
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "lump-0000.jsonl").write_bytes(lines[1] + lines[2] + b"{torn\n" + lines[3] + lines[4][:20])
    with RunFolder(tmp_path, _settings(out)) as folder:
        assert len(folder.records) == 4
    assert (tmp_path / "pairs.jsonl").read_bytes() == b"".join(lines[:4])
    assert not list((tmp_path / "parts").iterdir())
    assert evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, 6, 3, out=tmp_path)["methods"] == summary["methods"]


def _settings(out: Path) -> dict:
    return json.loads((out / "run.json").read_text())


def test_a_folder_takes_one_run_at_a_time(undisturbed):
    out, _ = undisturbed
    with RunFolder(out, _settings(out)), pytest.raises(InputError, match="another run is writing"):
        RunFolder(out, _settings(out))
    with RunFolder(out, _settings(out)):
        pass


def test_a_runs_folder_says_how_it_came_about(undisturbed):
    out, _ = undisturbed
    begun, ended = (json.loads(line) for line in (out / "invocations.jsonl").read_text().splitlines())
    assert begun["versions"]["torch"] and begun["machine"]["cores"] and begun["rows"] == list(ROWS)
    assert begun["workers"] == 1 and begun["threads"] >= 1 and ended["seconds"] > 0
    assert _settings(out)["seed"] == 0 and set(_settings(out)["methods"]) == set(ROWS)
    for record in read_records(out / "pairs.jsonl").values():
        assert record["seed"] > 0 and record["seconds"] > 0


def test_frames_are_described_once_for_all_rows_and_the_run_says_what_that_saves(tmp_path):
    calls = []

    @dataclass(frozen=True)
    class Counting(CoordinateBackbone):
        def __call__(self, images):
            calls.append(len(images))
            return super().__call__(images)

    rows = {name: name for name in ("ours", "ours-k30", "ours-n1", "ours-globalsim")} | {"six": Method(targets=6)}
    summary = evaluate(small_folder(), Counting(), rows, 4, 3, out=tmp_path, categories=["lump"])
    pairs = pairs_of_rows(small_folder(), resolve(rows), 4, 3, categories=["lump"])
    assert sum(calls) == len({key for found in pairs.values() for pair in found for key in frame_keys(pair)})
    assert set(calls) == {1}
    cost = summary["cost"]
    assert cost["all_rows"] > cost["ours_alone"] > 0 and cost["ratio"] == pytest.approx(
        cost["all_rows"] / cost["ours_alone"], rel=0.01
    )


def test_the_points_behind_a_frames_patches_are_worked_out_once():
    keys = [("100_a", 0)]
    store = FrameStore(Co3D(small_folder()), "lump", {"backbone": BACKBONE, "other": BACKBONE})
    first = store.view("backbone", keys[0], "saliency", 0.05)
    points = first.patch_points
    for features, foreground in (("backbone", "mask"), ("other", "mask")):
        assert store.view(features, keys[0], foreground, 0.05).patch_points is points
    assert store.view("other", ("100_a", 1), "mask", 0.05).patch_points is not points


def test_frames_are_forgotten_after_their_last_pair(monkeypatch):
    root, rows = small_folder(), resolve(["ours"])
    work = list(work_of_categories(pairs_of_rows(root, rows, 6, 2, categories=["lump"]))["lump"])
    (chunk,) = split([(pair, ["ours"]) for pair in work], 1)
    job = Job(str(root), "lump", chunk, rows, BACKBONE)
    most, every = frames_at_once([pair for pair, _ in chunk]), {key for pair in work for key in frame_keys(pair)}
    assert 3 <= most < len(every)
    held, release = [], FrameStore.release

    def watched(store, keys):
        held.append(len(store._frames))
        release(store, keys)

    monkeypatch.setattr(FrameStore, "release", watched)
    assert len(list(records_of(job, worker_extractors(job)))) == 6
    assert 3 <= max(held) <= most
    assert frames_at_once(work[:1]) == 3


def test_a_cache_keeps_features_for_other_runs_and_changes_nothing(undisturbed, tmp_path, monkeypatch):
    def never(self, images):
        raise AssertionError("all is in the cache")

    arguments = {"pairs": 6, "targets": 3, "cache": tmp_path / "cache"}
    first = evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, out=tmp_path / "a", **arguments)
    monkeypatch.setattr(SlowBackbone, "__call__", never)
    second = evaluate(small_folder(), SlowBackbone(_seconds=0), ROWS, out=tmp_path / "b", **arguments)
    assert first["methods"] == second["methods"] == undisturbed[1]["methods"]


def test_a_damaged_cache_file_is_made_again(tmp_path):
    dataset = Co3D(small_folder())
    frame = dataset.load(dataset.frames("lump", "100_a")[0])
    cache = FeatureCache(tmp_path, {"backbone": "one"})
    (found,) = BACKBONE([np.zeros((224, 224, 3), np.uint8)])
    assert cache.read("backbone", frame) is None
    cache.write("backbone", frame, found)
    assert torch.equal(cache.read("backbone", frame).keys, found.keys)
    assert FeatureCache(tmp_path, {"backbone": "another"}).read("backbone", frame) is None
    assert cache.read("sift", frame) is None
    path = cache.path("backbone", frame)
    path.write_bytes(path.read_bytes()[:100])
    assert cache.read("backbone", frame) is None


def test_a_plan_counts_what_the_run_then_does(tmp_path):
    rows = ("ours", "ours-n1")
    made = plan_run(small_folder(), BACKBONE, rows, 3, 2, out=tmp_path / "run", seed=1)
    assert not (tmp_path / "run").exists()
    pairs = pairs_of_rows(small_folder(), resolve(rows), 3, 2, seed=1)
    assert made.pairs == made.estimates == 12
    frames = {(pair.category, *key) for found in pairs.values() for pair in found for key in frame_keys(pair)}
    assert made.frames == len(frames)
    assert made.frame_seconds > 0 and made.pair_seconds > 0 and made.memory > 2**26
    evaluate(small_folder(), BACKBONE, rows, 3, 2, out=tmp_path / "run", seed=1)
    size_found = (tmp_path / "run" / "pairs.jsonl").stat().st_size
    assert made.results_bytes / 3 < size_found < made.results_bytes * 3
    left = plan_run(small_folder(), BACKBONE, rows, 3, 2, out=tmp_path / "run", seed=1)
    assert left.pairs == left.frames == 0 and left.described == "nothing is left to do"
    with pytest.raises(InputError, match="other settings .backbone"):
        plan_run(small_folder(), CoordinateBackbone(frequencies=8), rows, 3, 2, out=tmp_path / "run", seed=1)


def test_a_plan_shares_the_work_out():
    made = Plan(100, 10, 40, 2**30, 10_000, 2**40, 0.2, 0.3, 2, "4 pairs of lump")
    assert made.seconds(1) - made.seconds(2) == pytest.approx((100 * 0.2 + 10 * 0.3) / 2)
    larger = made.scaled(3000, 50)
    assert larger.seconds(1) - larger.seconds(2) == pytest.approx((3000 * 0.2 + 50 * 0.3) / 2)
    assert (larger.estimates, larger.results_bytes, larger.cache_bytes) == (200, 50_000, 30 * 2**40)
    text = "\n".join(made.lines(8))
    assert "1 worker," in text and "8 workers" in text and "1.0 TiB" in text and "1.0 GiB" in text
    assert [duration(s) for s in (5, 600, 7200, 200_000)] == ["5 s", "10 min", "2 h 0 min", "2 d 8 h"]
    assert [size(n) for n in (5, 2048, 5 * 2**30)] == ["5 B", "2.0 KiB", "5.0 GiB"]


def test_your_own_method_is_a_row_like_any_other(tmp_path):
    settings = {"pairs": 3, "targets": 2, "categories": ["lump"]}

    def last_patch(sim, on1, on2):
        return torch.zeros(len(on1), dtype=torch.long), torch.where(on1, 1.0, -torch.inf).double()

    mine = {
        "function": lambda problem: problem.estimate().sim3,
        "object": ZeroShotPose(BACKBONE),
        "matcher": Method(settings={"matcher": last_patch}),
        "imported": "benchmark_folder:own_method",
        "ours": "ours",
    }
    rows = evaluate(small_folder(), BACKBONE, mine, out=tmp_path, **settings)["methods"]
    assert list(rows) == list(mine) and all(row["n"] == 3 for row in rows.values())
    records = read_records(tmp_path / "pairs.jsonl").values()
    assert all(record["methods"]["imported"]["view"] == 0 for record in records)
    again = evaluate(small_folder(), BACKBONE, ["benchmark_folder:own_method"], out=tmp_path / "b", **settings)
    named = again["methods"]["benchmark_folder:own_method"]
    assert named == {key: rows["imported"][key] for key in named}


def test_a_method_that_has_changed_does_not_mix_with_its_former_self(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    evaluate(small_folder(), BACKBONE, {"mine": own_method}, **settings)
    evaluate(small_folder(), BACKBONE, {"mine": own_method, "ours": "ours"}, **settings)
    with pytest.raises(InputError, match="mine.*changed"):
        evaluate(small_folder(), BACKBONE, {"mine": lambda problem: np.eye(3)}, **settings)


def one_way(similarity, on_reference, on_target):
    score, partner = similarity.max(dim=1)
    return partner, score.double()


def turned_by(angle):
    return lambda problem: angle * np.eye(3)


class OwnEstimator:
    def __init__(self, k, weights=None):
        self.k, self.weights, self._cache = k, weights, object()

    def estimate(self, reference, targets):
        raise NotImplementedError


@pytest.mark.parametrize(
    "make",
    [
        lambda k: Method(settings={"matcher": one_way, "k": k}),
        lambda k: Method(solve=functools.partial(own_method, k=k)),
        lambda k: turned_by(k),
        lambda k: OwnEstimator(k),
        lambda k: OwnEstimator(1, np.arange(k)),
        lambda k: ZeroShotPose(BACKBONE, k=k),
        lambda k: ZeroShotPose(CoordinateBackbone(frequencies=k)),
    ],
)
def test_a_row_of_ones_own_is_known_by_all_of_its_settings(make):
    first, again, other = (fingerprint(resolve({"mine": make(k)})["mine"]) for k in (30, 30, 70))
    assert first == again != other


class Mode(enum.Enum):
    A, B = 1, 2


@functools.lru_cache
def first_remembered(problem):
    return problem, 1


@functools.lru_cache
def second_remembered(problem):
    return problem, 2


class Slotted:
    __slots__ = ("k",)

    def __init__(self, k):
        self.k = k


@pytest.mark.parametrize(
    "first, second",
    [
        (Mode.A, Mode.B),
        (first_remembered, second_remembered),
        (Slotted(1), Slotted(2)),
        (torch.zeros(3, dtype=torch.bfloat16), torch.ones(3, dtype=torch.bfloat16)),
        (torch.nn.Linear(2, 2), torch.nn.Linear(2, 2)),
        (np.zeros(4), np.zeros((2, 2))),
        ({"a": {1, 2}}, {"a": {1, 3}}),
    ],
)
def test_what_differs_is_told_apart(first, second):
    assert digest_of(first) == digest_of(first) != digest_of(second)


def test_a_class_that_was_typed_in_is_known_by_its_members():
    made = []
    for k in (30, 30, 70):
        space = {}
        exec(f"class Typed:\n    k = {k}\n    @staticmethod\n    def solve(problem):\n        return problem", space)
        made.append(digest_of(space["Typed"]()))
    assert made[0] == made[1] != made[2]


def test_another_process_finds_the_same_identity():
    code = """
import logging
import cv2
from benchmark_folder import own_method
from zsp_lite.benchmark.identity import digest_of
class Own:
    def __init__(self):
        self.sift, self.log, self.also = cv2.SIFT_create(), logging.getLogger("x"), lambda: (own_method, cv2)
print(digest_of(Own()))
"""
    paths = os.pathsep.join([str(TESTS), str(TESTS.parent)])
    runs = [
        subprocess.run([sys.executable, "-c", code], env=os.environ | {"PYTHONPATH": paths, "PYTHONHASHSEED": seed},
                       capture_output=True, text=True, check=True).stdout
        for seed in ("1", "2")
    ]  # fmt: skip
    assert runs[0] == runs[1] and len(runs[0]) == 17


def test_a_backbone_of_ones_own_is_known_by_more_than_its_name():
    def grey(images):
        return BACKBONE([image // 2 for image in images])

    first, again, other = (extractor_fingerprint(one) for one in (BACKBONE, CoordinateBackbone(), grey))
    assert first == again != other
    assert len({extractor_fingerprint(CoordinateBackbone(frequencies=n)) for n in (8, 32)}) == 2


def test_pose_labels_that_have_changed_do_not_mix(tmp_path):
    root = shutil.copytree(small_folder(), tmp_path / "data")
    settings = {"methods": ["ours-bv"], "pairs": 2, "targets": 2, "categories": ["lump"], "out": tmp_path / "run"}
    evaluate(root, BACKBONE, **settings)
    labels = read_labels(root, "lump")
    name = next(name for name, label in labels.items() if name != label.reference_seq)
    turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    write_label(root, "lump", replace(labels[name], trans=labels[name].trans @ turn))
    with pytest.raises(InputError, match=f"lump/{name}: the pose label has changed"):
        evaluate(root, BACKBONE, **settings)
    evaluate(root, BACKBONE, **settings | {"out": tmp_path / "other"})


def test_a_worker_that_finds_another_backbone_under_the_name_says_so():
    root, rows = small_folder(), resolve(["ours"])
    pairs = pairs_of_rows(root, rows, 1, 2, categories=["lump"])["ours"]
    job = Job(str(root), "lump", [(pair, ["ours"]) for pair in pairs], rows, "zsp-tiny", fingerprint="zsp-tiny 0123")
    with pytest.raises(InputError, match="zsp-tiny is zsp-tiny .* to a worker, expected zsp-tiny 0123"):
        run_job(job)


def test_without_being_told_a_run_is_of_the_categories_that_have_labels(tmp_path):
    root = shutil.copytree(small_folder(), tmp_path / "data")
    shutil.rmtree(root / "class_labels" / "lump")
    assert {pair.category for pair in pairs_of_rows(root, resolve(["ours"]), 1, 2)["ours"]} == {"pebble"}
    (twice,) = pairs_of_rows(root, resolve(["ours"]), 3, 2, categories=["pebble", "pebble"]).values()
    assert len(twice) == 3
    with pytest.raises(InputError, match="lump has 0 labelled sequences"):
        pairs_of_rows(root, resolve(["ours"]), 1, 2, categories=["lump"])
    shutil.rmtree(root / "class_labels")
    with pytest.raises(InputError, match="none of 2 categories has pose labels"):
        pairs_of_rows(root, resolve(["ours"]), 1, 2)


def test_results_are_of_the_rows_and_categories_that_the_summary_is_of(tmp_path):
    arguments = {"pairs": 2, "targets": 2, "out": tmp_path}
    evaluate(small_folder(), BACKBONE, ["ours", "ours-bv"], **arguments)
    evaluate(small_folder(), BACKBONE, ["ours-bv"], categories=["lump"], **arguments)
    results = read_results(tmp_path)
    assert list(results.rows) == ["ours-bv"] and len(results.errors("ours-bv")) == 2


def test_a_torn_line_of_the_invocations_does_no_harm(tmp_path):
    arguments = {"pairs": 1, "targets": 2, "out": tmp_path, "categories": ["lump"]}
    evaluate(small_folder(), BACKBONE, ["ours-bv"], **arguments)
    path = tmp_path / "invocations.jsonl"
    path.write_bytes(path.read_bytes()[:-30])
    evaluate(small_folder(), BACKBONE, ["ours-bv", "oracle-view"], **arguments)
    invocations = read_results(tmp_path).invocations
    assert [one.get("rows") for one in invocations if "rows" in one] == [["ours-bv"], ["ours-bv", "oracle-view"]]


def test_a_module_in_the_current_folder_is_found(tmp_path, monkeypatch):
    (tmp_path / "rows_of_my_own.py").write_text("def still(problem):\n    return None\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])  # as a console script has it
    assert resolve(["rows_of_my_own:still"])["rows_of_my_own:still"].solve.__name__ == "still"


@pytest.mark.parametrize(
    "answer, told",
    [
        (Answer(2 * np.eye(3)), "not a rotation"),
        (Answer(np.eye(3), details={"error": 1.0}), "details name error"),
        (Answer(np.eye(3), details={"matches": np.arange(3)}), "matches is a ndarray"),
    ],
)
def test_an_answer_that_says_too_much_is_refused(answer, told):
    with pytest.raises(InputError, match=told):
        as_answer(answer)


def test_numbers_of_numpy_are_kept_as_numbers():
    assert json.dumps(dict(as_answer(Answer(np.eye(3), details={"inliers": np.int64(3)})).details)) == '{"inliers": 3}'


def test_answers_that_are_none_are_refused_or_fail(tmp_path):
    settings = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    rows = {
        "large": lambda problem: Answer(2 * np.eye(3)),
        "words": lambda problem: "north",
        "mirror": lambda problem: np.diag([1.0, 1.0, -1.0]),
        "far view": lambda problem: (np.eye(3), 2),
    }
    summary = evaluate(small_folder(), BACKBONE, rows, **settings)
    assert all(row["failed"] == 1 and row["median"] == 180 for row in summary["methods"].values())
    for methods in ([], {"a": 3}, ["nowhere:nothing"], ["./here.py:nothing"], "nonesuch"):
        with pytest.raises(InputError):
            resolve(methods)


def test_groups_are_made_of_rows_and_rows_of_known_features():
    from zsp_lite.benchmark.extractors import EXTRACTORS

    assert all(name in METHODS for names in GROUPS.values() for name in names)
    assert all(method.features in EXTRACTORS for method in METHODS.values())
    assert list(resolve(["table3", "ours"])) == list(GROUPS["table3"])
    assert not GROUPS.keys() & METHODS.keys()  # a name is a row or a group, never both
    assert set(GROUPS["paper"]) | set(GROUPS["verified-views"]) <= set(GROUPS["all"])
    assert {METHODS[name].targets for name in GROUPS["verified-views"]} == {None, 1, 3, 10}
    assert run_module.GROUPS["default"] == ("ours", "ours-bv", "rootsift")


def test_a_record_that_found_no_room_is_an_error_and_not_a_torn_line_for_the_next(tmp_path):
    class Full(io.FileIO):
        def write(self, data):
            return super().write(data[: len(data) // 2])

    with Full(tmp_path / "pairs.jsonl", "w") as file, pytest.raises(OSError, match="No space left"):
        _append(file, {"key": "a"})

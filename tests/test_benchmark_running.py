"""A run's results: the same whoever computes them, in whatever order, however often it is killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from benchmark_folder import SlowBackbone, small_folder
from synthetic_views import CoordinateBackbone

from zsp_lite.backbones.backbone import Backbone
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark import run as run_module
from zsp_lite.benchmark import store
from zsp_lite.benchmark.cache import FeatureCache
from zsp_lite.benchmark.execution import Evaluator, Setup, make_chunks, open_workers
from zsp_lite.benchmark.identity import library_version
from zsp_lite.benchmark.methods import Method, resolve
from zsp_lite.benchmark.problem import Problem
from zsp_lite.benchmark.records import RECORDS, SETTINGS, add_lines, read_records, read_settings
from zsp_lite.benchmark.results import read_results
from zsp_lite.benchmark.run import evaluate, pairs_of_rows, rows_of_pairs
from zsp_lite.benchmark.store import FrameStore
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import read_labels, write_label
from zsp_lite.data.pairs import sample_pairs
from zsp_lite.errors import InputError

pytestmark = pytest.mark.slow

BACKBONE = CoordinateBackbone(grid=8)
QUICK = SlowBackbone(grid=8, _seconds=0)
ROWS = ("ours", "ours-bv")
TESTS = Path(__file__).parent


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The run of `benchmark_folder`'s main, in this process."""
    out = tmp_path_factory.mktemp("undisturbed")
    return out, evaluate(small_folder(), QUICK, ROWS, 6, 3, out=out)


PATHS = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)])}


def test_a_run_killed_again_and_again_loses_no_stored_pair_and_evaluates_none_twice(undisturbed, tmp_path):
    stored = 0
    for workers, more in ((2, 1), (1, 3)):
        command = [sys.executable, str(TESTS / "benchmark_folder.py"), str(small_folder()), str(tmp_path), str(workers)]
        with subprocess.Popen(command, env=PATHS, stdout=subprocess.PIPE, text=True) as process:
            reached = next(int(line) for line in process.stdout if int(line) >= stored + more)
            process.send_signal(signal.SIGSTOP)  # it must not finish before it is killed
            children = _children(process.pid)
            process.kill()
        stored = len(read_records(tmp_path).evaluations)
        assert stored >= reached
        wait_for_end(children)  # a killed run's workers end by themselves
    assert 4 <= stored < 12
    # An interrupted run has tables of what is finished.
    assert read_results(tmp_path).summary["methods"]["ours"]["n"] == stored
    assert evaluate(small_folder(), QUICK, ROWS, 6, 3, out=tmp_path)["methods"] == undisturbed[1]["methods"]
    assert [len(found) for found in read_records(tmp_path).evaluations.values()] == 12 * [1]


def wait_for_end(pids: set[int]) -> None:
    deadline = time.monotonic() + 20
    for pid in pids:
        status = Path(f"/proc/{pid}/stat")
        while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < deadline, f"worker {pid} outlives its run"
            time.sleep(0.05)


def test_a_line_cut_off_by_a_kill_is_neither_read_nor_continued(undisturbed, tmp_path):
    run = shutil.copytree(undisturbed[0], tmp_path / "run")
    before, path = read_records(run), run / RECORDS
    whole = path.read_bytes()
    path.write_bytes(whole + whole[: len(whole) // 2].rpartition(b"\n")[2])
    assert read_records(run) == before
    evaluate(small_folder(), QUICK, ROWS, 6, 3, out=run)
    after = read_records(run)
    assert after.rows == before.rows and len(after.invocations) == 2
    path.write_bytes(whole.replace(b'"pair":', b'"pair:', 1))
    for read in (read_results, lambda run: evaluate(small_folder(), QUICK, ROWS, 6, 3, out=run)):
        with pytest.raises(InputError, match="run.jsonl, line 2"):
            read(run)


def test_a_worker_that_dies_ends_the_run_which_can_be_continued_to_the_same_tables(undisturbed, tmp_path):
    seen, before = [], _children(os.getpid())

    def kill_a_worker(done: int, total: int) -> None:
        if not seen:
            os.kill(max(_children(os.getpid()) - before), signal.SIGKILL)
        seen.append((done, total))

    arguments = (small_folder(), SlowBackbone(grid=8), ROWS, 6, 3)
    with pytest.raises(InputError, match="run again"):
        evaluate(*arguments, out=tmp_path, workers=2, progress=kill_a_worker)
    assert len(read_records(tmp_path).evaluations) >= seen[0][0]
    again = evaluate(*arguments, out=tmp_path, progress=lambda *step: seen.append(step))
    assert again["methods"] == undisturbed[1]["methods"]
    assert [total for _, total in seen] == [12] * len(seen) and seen[-1] == (12, 12)


def _children(pid: int) -> set[int]:
    listed = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True, text=True).stdout
    return {int(child) for child in listed.split()}


def test_a_dask_cluster_that_loses_a_worker_finds_the_same(undisturbed, tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50) as cluster:
        victim, killed = cluster.workers[0].pid, []

        def kill_once(done: int, total: int) -> None:
            if not killed:
                os.kill(victim, signal.SIGKILL)
                killed.append(done)

        address = "dask://" + cluster.scheduler_address.removeprefix("tcp://")
        summary = evaluate(
            small_folder(), SlowBackbone(grid=8), ROWS, 6, 3, out=tmp_path, executor=address, progress=kill_once
        )
    assert killed and killed[0] < 12
    assert summary["methods"] == undisturbed[1]["methods"]


def test_a_run_that_goes_on_can_be_read_but_has_one_writer(tmp_path):
    seen = []

    def look(done: int, total: int) -> None:
        if done == 3:
            code = "import sys; from zsp_lite.cli.main import main; sys.exit(main(sys.argv[1:]))"
            command = [sys.executable, "-c", code, "tables", str(tmp_path), "--out", str(tmp_path / "tables")]
            assert subprocess.run(command, env=PATHS, stdout=subprocess.DEVNULL).returncode == 0
            with pytest.raises(InputError, match="another process is writing"):
                evaluate(*arguments, out=tmp_path)
        seen.append(read_results(tmp_path).summary["methods"]["ours-bv"]["n"])

    arguments = (small_folder(), QUICK, ["ours-bv"], 2, 3)
    evaluate(*arguments, out=tmp_path, progress=look)
    assert seen == [1, 2, 3, 4]
    assert evaluate(*arguments, out=tmp_path)["methods"]["ours-bv"]["n"] == 4


def test_any_executor_will_do(undisturbed, tmp_path):
    with ThreadPoolExecutor(2) as executor:
        summary = evaluate(small_folder(), QUICK, ROWS, 6, 3, out=tmp_path, executor=executor)
    assert summary["methods"] == undisturbed[1]["methods"]


class FirstFails(Executor):
    """Evaluates chunks at once; the first one fails."""

    _max_workers, submitted = 2, 0

    def submit(self, function, *arguments):
        future = Future()
        if self.submitted:
            future.set_result(function(*arguments))
        else:
            future.set_exception(InputError("the first chunk fails"))
        self.submitted += 1
        return future


def test_what_was_evaluated_together_with_a_failure_is_saved(tmp_path):
    executor = FirstFails()
    with pytest.raises(InputError, match="the first chunk fails"):
        evaluate(small_folder(), QUICK, ["ours-bv"], 6, 3, out=tmp_path, executor=executor)
    assert executor.submitted == 4 and len(read_records(tmp_path).evaluations) >= 3


def test_threads_and_a_cache_that_cannot_be_are_refused_before_anything_is_written(tmp_path):
    (tmp_path / "file").touch()
    for options, message in (
        ({"threads": 10**11}, "threads is"),
        ({"cache": tmp_path / "file/x"}, "cache folder .*/x"),
    ):
        with pytest.raises(InputError, match=message):
            evaluate(small_folder(), QUICK, ["ours-bv"], 1, 2, out=tmp_path / "out", **options)
    assert not (tmp_path / "out").exists()


def test_unusable_executors_are_refused(monkeypatch):
    monkeypatch.setattr("zsp_lite.benchmark.execution._DASK_TIMEOUT", 1)
    for executor, message in (
        ("dask://127.0.0.1:1", "no scheduler"), ("nowhere:Pool", "cannot be imported"), ("x", "dask:"),
        ("os:_exit", "module:Class"), ("concurrent.futures:Executor", "cannot be made for 1 workers: .*TypeError"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message), open_workers(executor):
            pass
    for number in (0, 10**11, 1.5):
        with pytest.raises(InputError, match="workers"), open_workers(None, number):
            pass


def work_of(rows, pairs: int, targets: int, category: str = "lump") -> dict:
    found = pairs_of_rows(small_folder(), resolve(rows), pairs, targets, categories=[category])
    return rows_of_pairs(found)[category]


@dataclass(frozen=True)
class Sociable(CoordinateBackbone):
    """Its features depend on how many images come together, as those of a real network do in their last bits."""

    name: str = "sociable"

    def __call__(self, images):
        found = super().__call__(images)
        return [replace(one, keys=one.keys * (1 + 0.3 * len(images))) for one in found]


def test_a_frame_is_described_by_itself_so_that_no_order_matters():
    (chunk,) = make_chunks(work_of(ROWS, 6, 3))
    evaluator = Evaluator(Setup(str(small_folder()), resolve(ROWS), Sociable(grid=8)))

    def errors(chunk):
        return {record["pair"]: record["results"]["ours"]["error"] for record in evaluator.records(chunk)}

    assert errors(chunk) == errors(chunk[::-1])


def test_a_vision_transformers_features_do_not_depend_on_threads():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        backbone = Backbone(VisionTransformer(32, 8, 24, 2, 3), "small", layer=1, device="cpu")
    (chunk,) = make_chunks(work_of(["ours"], 2, 2))
    found = []
    for threads in (1, 2):
        setup = Setup(str(small_folder()), resolve(["ours"]), backbone, threads=threads)
        found.append([record["results"]["ours"]["error"] for record in Evaluator(setup).records(chunk)])
    assert found[0] == found[1]


def test_chunks_hold_every_pair_once_and_keep_a_target_sequence_together_where_it_fits():
    dataset = Co3D(small_folder())
    pairs = [*sample_pairs(dataset, "lump", 12, 3), *sample_pairs(dataset, "lump", 12, 5)]
    work = {pair: ["ours"] for pair in pairs}

    def problem(pair):
        return pair.target_sequence, pair.reference_sequence, pair.reference_frame

    largest = Counter(pair.target_sequence for pair in work).most_common(1)[0][1]
    together = Counter(map(problem, work)).most_common(1)[0][1]
    for size in (1, 4, largest, 100):
        chunks = make_chunks(work, size)
        assert sorted(map(str, work.items())) == sorted(str(one) for chunk in chunks for one in chunk)
        assert all(len(chunk) < size + together for chunk in chunks)
        problems = [{problem(pair) for pair, _ in chunk} for chunk in chunks]
        assert sum(map(len, problems)) == len(set().union(*problems))
        if size >= largest:
            sequences = [{pair.target_sequence for pair, _ in chunk} for chunk in chunks]
            assert sum(map(len, sequences)) == len(set().union(*sequences))
    assert len(make_chunks(work, 100)) == 1


def test_a_run_is_not_continued_by_another_version_of_the_library_unless_it_is_allowed(tmp_path, monkeypatch):
    arguments = {"pairs": 1, "targets": 2, "categories": ["lump"], "out": tmp_path}
    evaluate(small_folder(), BACKBONE, ["ours-bv"], **arguments)
    first = library_version()
    other = {"version": first["version"], "source": "0123abc"}
    monkeypatch.setattr(run_module, "library_version", lambda: other)
    with pytest.raises(InputError, match="this is .*0123abc.*; choose another folder, or .*--allow-other-version"):
        evaluate(small_folder(), BACKBONE, ["ours"], **arguments)
    evaluate(small_folder(), BACKBONE, ["ours"], allow_other_version=True, **arguments)
    assert read_settings(tmp_path)["library"] == [first, other]
    assert all(call["git"] and call["rows"] and call["seconds"] > 0 for call in read_records(tmp_path).invocations)
    evaluate(small_folder(), BACKBONE, ["ours"], **arguments)  # both are now known


def test_a_folder_that_holds_no_run_is_neither_read_nor_continued(undisturbed, tmp_path):
    run = shutil.copytree(undisturbed[0], tmp_path / "run")
    settings = read_settings(run)
    incomplete = json.dumps({name: one for name, one in settings.items() if name != "data"})
    for text, told in (("{", "run.json: "), (incomplete, "run.json: .*missing required field `data`")):
        (run / SETTINGS).write_text(text)
        for read in (read_results, lambda run: evaluate(small_folder(), QUICK, ROWS, 6, 3, out=run)):
            with pytest.raises(InputError, match=told):
                read(run)
    (run / SETTINGS).unlink()
    with pytest.raises(InputError, match="holds results in run.jsonl without run.json"):
        evaluate(small_folder(), QUICK, ROWS, 6, 3, out=run)
    with pytest.raises(InputError, match="nowhere/run.jsonl cannot be read"):
        read_records(tmp_path / "nowhere")
    (tmp_path / RECORDS).symlink_to("/dev/full")
    with pytest.raises(InputError, match="run.jsonl cannot be written: .*No space left"):
        add_lines(tmp_path, [{"seconds": 1.0}])


def test_features_are_computed_once_for_all_rows(tmp_path):
    calls = []

    @dataclass(frozen=True)
    class Counting(CoordinateBackbone):
        def __call__(self, images):
            calls.append(len(images))
            return super().__call__(images)

    rows = {name: name for name in ("ours", "ours-k30", "ours-n1", "ours-globalsim")} | {"six": Method(targets=6)}
    evaluate(small_folder(), Counting(grid=8), rows, 4, 3, out=tmp_path, categories=["lump"])
    frame_store = FrameStore(Co3D(small_folder()), "lump", {})
    frames = {key for pair in work_of(rows, 4, 3) for key in Problem(pair, frame_store).keys}
    assert sum(calls) == len(frames) and set(calls) == {1}


def test_frames_are_cropped_at_the_size_that_the_backbone_takes():
    class Large(CoordinateBackbone):
        image_size = 448

    for backbone, size in ((BACKBONE, 224), (Large(), 448)):
        frame = FrameStore(Co3D(small_folder()), "lump", {"backbone": backbone}).frame(("100_a", 0))
        assert frame.rgb.shape == (size, size, 3) and frame.camera.size == (size, size)


def test_the_points_behind_a_frames_patches_are_computed_once():
    frames = FrameStore(Co3D(small_folder()), "lump", {"backbone": BACKBONE, "other": BACKBONE})
    first = frames.view("backbone", ("100_a", 0), "saliency")
    points, measured = first.patch_points, first.measured_points
    for features, foreground in (("backbone", "mask"), ("other", "mask")):
        view = frames.view(features, ("100_a", 0), foreground)
        assert view.patch_points is points and view.measured_points is measured
    assert frames.view("other", ("100_a", 1), "mask").patch_points is not points


def test_only_the_last_used_frames_stay_in_memory(monkeypatch):
    monkeypatch.setattr(store, "CAPACITY", 3)
    frames = FrameStore(Co3D(small_folder()), "lump", {"backbone": BACKBONE})
    for number in (0, 1, 2, 0, 3):
        frames.describe("backbone", ("100_a", number))
    assert len(frames.timings["reading"]) == 4
    assert [frames.description("backbone", ("100_a", number)) is not None for number in (2, 0, 3)] == [True] * 3
    assert len(frames.timings["reading"]) == 4  # frame 1 was dropped, as it had not been used for longest


def test_a_cache_keeps_features_for_other_runs_and_changes_nothing(undisturbed, tmp_path, monkeypatch):
    def never(self, images):
        raise AssertionError("all is in the cache")

    arguments = {"pairs": 6, "targets": 3, "cache": tmp_path / "cache"}
    first = evaluate(small_folder(), QUICK, ROWS, out=tmp_path / "a", **arguments)
    monkeypatch.setattr(CoordinateBackbone, "__call__", never)  # which SlowBackbone calls
    second = evaluate(small_folder(), QUICK, ROWS, out=tmp_path / "b", **arguments)
    assert first["methods"] == second["methods"] == undisturbed[1]["methods"]


def test_a_cached_feature_is_of_the_same_extractor_and_the_same_pixels(tmp_path):
    class WholeFrame(CoordinateBackbone):
        def describe(self, frames):
            return self([frame.rgb for frame in frames])

    frame = FrameStore(Co3D(small_folder()), "lump", {"backbone": BACKBONE}).frame(("100_a", 0))
    cache = FeatureCache(tmp_path, {"backbone": BACKBONE, "whole": WholeFrame()})
    (found,) = BACKBONE([frame.rgb])
    for features in ("backbone", "whole"):
        assert cache.read(features, frame) is None
        cache.write(features, frame, found)
    assert torch.equal(cache.read("backbone", frame).keys, found.keys) and cache.read("whole", frame) is None
    assert cache.read("backbone", replace(frame, rgb=255 - frame.rgb)) is None
    assert FeatureCache(tmp_path, {"backbone": CoordinateBackbone(frequencies=8)}).read("backbone", frame) is None
    path = cache.path("backbone", frame)
    path.write_bytes(path.read_bytes()[:100])
    assert cache.read("backbone", frame) is None


def test_hypotheses_are_kept_on_demand_and_the_second_poses_error_always(tmp_path):
    arguments = {"pairs": 2, "targets": 2, "categories": ["lump"]}
    both = {"methods": ["verified", "ours"], "out": tmp_path / "a", "keep_hypotheses": True}
    summary = evaluate(small_folder(), BACKBONE, **both, **arguments)
    evaluate(small_folder(), BACKBONE, ["verified"], out=tmp_path / "b", **arguments)
    rows, either = read_records(tmp_path / "a").rows, []
    for key, plain in read_records(tmp_path / "b").rows["verified"].items():
        found = rows["verified"][key]
        errors, scores = ([one[name] for one in found["hypotheses"]] for name in ("error", "score"))
        assert scores == sorted(scores, reverse=True)
        # The errors of those within 30 degrees of the best are not the second pose's.
        assert errors[0] == found["error"] == plain["error"] and found["second_error"] in errors[1:]
        assert plain["second_error"] == found["second_error"] and isinstance(found["one_of_two"], bool)
        best = found["hypotheses"][0]
        assert {"forward_similarity", "viewpoint"} <= best["terms"].keys() and 0 < best["confidence"] < 1
        assert "hypotheses" not in plain and not {"hypotheses", "one_of_two"} & rows["ours"][key].keys()
        either.append(min(found["error"], found["second_error"]))
    best_two = summary["methods"]["verified"]["best_two"]
    assert best_two["acc30"] == 100 * np.mean(np.array(either) < 30) and "best_two" not in summary["methods"]["ours"]


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
    with pytest.raises(InputError, match="zsp-tiny is zsp-tiny .* on a worker, expected zsp-tiny 0123"):
        Evaluator(Setup(str(small_folder()), resolve(["ours"]), "zsp-tiny", "zsp-tiny 0123"))


def test_by_default_a_run_is_of_the_categories_that_have_labels(tmp_path):
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


def test_results_are_of_the_rows_and_categories_of_the_last_call(tmp_path):
    arguments = {"pairs": 2, "targets": 2, "out": tmp_path}
    evaluate(small_folder(), BACKBONE, ["ours", "ours-bv"], **arguments)
    last = evaluate(small_folder(), BACKBONE, ["ours-bv"], categories=["lump"], **arguments)
    results = read_results(tmp_path)
    assert results.summary == last
    assert list(results.rows) == ["ours-bv"] and len(results.errors("ours-bv")) == 2

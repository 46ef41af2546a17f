"""A run's results: the same whoever computes them, in whatever order, however often it is
killed."""

import functools
import gzip
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import cloudpickle
import cv2
import numpy as np
import pytest
import torch
from benchmark_folder import (
    BACKBONE,
    QUICK,
    SlowBackbone,
    after_each_save,
    run_rows,
    small_folder,
)
from distributed import Client, LocalCluster
from refusals import refused
from synthetic_views import CoordinateBackbone
from threadpoolctl import threadpool_info, threadpool_limits

from zsp_lite import Backbone, Co3D, InputError
from zsp_lite.backbones.vit import VisionTransformer
from zsp_lite.benchmark.execution import check_workers
from zsp_lite.benchmark.methods import resolve
from zsp_lite.benchmark.run import evaluate, open_evaluator, pairs_of_rows, write_reports
from zsp_lite.benchmark.runs import (
    LINES,
    SETTINGS,
    add_lines,
    library_version,
    read_lines,
    read_run,
)
from zsp_lite.cli.main import main
from zsp_lite.data.labels import read_labels
from zsp_lite.data.writing import write_label
from zsp_lite.errors import FatalError
from zsp_lite.io.threads import one_thread

pytestmark = pytest.mark.slow
needs_signals = pytest.mark.skipif(
    sys.platform == "win32", reason="Windows has no SIGSTOP, SIGKILL and pgrep"
)

ROWS = ("ours", "ours-bv")
PAIRS = 12  # six of each of two categories
TESTS = Path(__file__).parent
PATHS = os.environ | {"PYTHONPATH": os.pathsep.join([str(TESTS), str(TESTS.parent)])}


def again(out: Path, executor=1) -> dict:
    """The run of `benchmark_folder`'s main, in this process."""
    return evaluate(small_folder(), QUICK, ROWS, 6, 3, out, executor)  # 3 target views


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    """The folder of a run that nothing interrupts, and what it returned."""
    out = tmp_path_factory.mktemp("undisturbed")
    return out, again(out)


def pairs_in(out: Path) -> list[str]:
    """The evaluations of pairs in a run's folder."""
    return [line.pair for line in read_lines(out)]


def _children(pid: int) -> set[int]:
    """The processes that a process has started."""
    found = subprocess.run(["pgrep", "-P", str(pid)], capture_output=True).stdout
    return set(map(int, found.split()))


def kill_after(saves: int, out: Path, workers: int) -> set[int]:
    """Start a run and kill it after it has saved pairs so often; returns its workers."""
    words = [TESTS / "benchmark_folder.py", small_folder(), out, workers]
    command = [sys.executable, *map(str, words)]
    with subprocess.Popen(command, env=PATHS, stdout=subprocess.PIPE, text=True) as process:
        for _ in range(saves):
            assert process.stdout.readline()  # a line for each time that pairs are saved
        process.send_signal(signal.SIGSTOP)  # it must not finish before it is killed
        children = _children(process.pid)
        process.kill()
    return children


@pytest.fixture(scope="module")
def killed(tmp_path_factory) -> Path:
    """The folder of a run that was killed twice, first with two workers, then with one."""
    out = tmp_path_factory.mktemp("killed")
    children = kill_after(1, out, 2)
    stored = len(pairs_in(out))
    assert stored >= 1
    children |= kill_after(3, out, 1)
    assert len(pairs_in(out)) >= stored + 3
    deadline = time.monotonic() + 20
    for pid in children:  # a killed run's workers end by themselves
        status = Path(f"/proc/{pid}/stat")
        # The state stands behind the name in brackets; Z is a process that has ended.
        while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
            assert time.monotonic() < deadline, f"{status}: a worker outlives its run"
            time.sleep(0.05)
    return out


@needs_signals
def test_a_run_killed_again_and_again_loses_no_stored_pair_and_evaluates_none_twice(
    undisturbed, killed, tmp_path
):
    out, summary = undisturbed
    run = shutil.copytree(killed, tmp_path / "run")
    assert again(run)["methods"] == summary["methods"]
    assert len(set(pairs_in(run))) == PAIRS
    assert sorted(pairs_in(run)) == sorted(pairs_in(out))


def test_a_line_cut_off_by_a_kill_is_neither_read_nor_continued(undisturbed, tmp_path):
    run = shutil.copytree(undisturbed[0], tmp_path / "run")
    before = read_run(run)
    path = run / LINES
    whole = path.read_bytes()
    cut_off = whole[: len(whole) // 2].rpartition(b"\n")[2]
    path.write_bytes(whole + cut_off)
    assert read_run(run).table.equals(before.table)
    again(run)
    assert read_run(run).table.equals(before.table)
    assert path.read_bytes() == whole


def test_a_run_packed_as_gzip_is_read_and_continued(undisturbed, tmp_path, monkeypatch):
    out, summary = undisturbed
    shutil.copy(out / SETTINGS, tmp_path)  # of a run that was killed before its first result
    refused("no pair that all its rows have finished", read_run, tmp_path)
    packed = tmp_path / f"{LINES}.gz"
    packed.write_bytes(gzip.compress((out / LINES).read_bytes()))
    assert read_run(tmp_path).table.equals(read_run(out).table)
    with monkeypatch.context() as context:
        context.setattr("zsp_lite.benchmark.run.evaluate_pair", None)  # nothing is left to compute
        assert again(tmp_path) == summary
    assert not packed.exists()
    assert (tmp_path / LINES).read_bytes() == (out / LINES).read_bytes()


@needs_signals
def test_a_worker_that_dies_ends_the_run_which_can_be_continued_to_the_same_tables(
    undisturbed, tmp_path, monkeypatch
):
    stored = []  # the number of pairs after each save
    before = _children(os.getpid())

    def kill_a_worker() -> None:
        if not stored:
            os.kill(max(_children(os.getpid()) - before), signal.SIGKILL)
        stored.append(len(pairs_in(tmp_path)))

    monkeypatch.setattr("zsp_lite.benchmark.execution.add_lines", after_each_save(kill_a_worker))
    arguments = (small_folder(), SlowBackbone(grid=8), ROWS, 6, 3, tmp_path)
    message = "finished pairs are stored: run again to continue, with fewer workers"
    refused(message, evaluate, *arguments, executor=2)
    assert stored[-1] == len(pairs_in(tmp_path)) < PAIRS
    assert evaluate(*arguments)["methods"] == undisturbed[1]["methods"]
    assert stored[-1] == PAIRS
    assert sorted(pairs_in(tmp_path)) == sorted(pairs_in(undisturbed[0]))


# Each of two workers finishes three of 24 pairs, which are handed out one by one.
WAITS = """
import time
from pathlib import Path
import numpy as np
calls = []

def row(problem):
    calls.append(problem)
    while len(calls) > 3 and not Path("go").exists():
        time.sleep(0.02)
    return np.eye(3)
"""


@needs_signals
def test_an_interrupt_ends_a_run_and_its_workers_with_one_line(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "waiting_rows.py").write_text(WAITS)
    options = "--pairs 4 --out run --methods waits=waiting_rows:row"
    words = f"benchmark --data {small_folder()} {options}".split()
    command = [sys.executable, "-m", "zsp_lite", *words, "--workers", "2"]
    with subprocess.Popen(
        command,
        env=PATHS,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # as in a terminal, also where the tests themselves ignore interrupts
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    ) as process:
        while not (tmp_path / "run" / LINES).exists() or not pairs_in(tmp_path / "run"):
            time.sleep(0.05)
        os.killpg(process.pid, signal.SIGINT)
        assert process.communicate()[1] == "zsp-lite: interrupted\n"
    assert process.returncode == 130
    stored = pairs_in(tmp_path / "run")
    assert 0 < len(stored) < 8
    (tmp_path / "go").touch()
    assert main(words) == 0  # an interrupted run can be continued
    assert pairs_in(tmp_path / "run")[: len(stored)] == stored


MODULES = {
    "turns_of_mine": "import numpy as np\nHALF = np.diag([1.0, -1.0, -1.0])",
    "rows_of_mine": "import turns_of_mine\ndef half(problem):\n    return turns_of_mine.HALF",
    "installed/package_of_mine": "def half(problem):\n    return None",
    "lock_of_mine": "import threading\nlock = threading.Lock()\ndef half(_):\n    return lock",
}


def test_modules_of_the_current_folder_travel_to_workers(tmp_path, monkeypatch):
    for name, text in MODULES.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.py").write_text(text)
    options = {"n_workers": 1, "threads_per_worker": 1, "dashboard_address": None}
    with LocalCluster(**options, silence_logs=50) as cluster, Client(cluster) as client:
        monkeypatch.chdir(tmp_path)  # after the worker has its path
        monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path / "installed")])

        def failures(module: str) -> int:
            executor = client.get_executor(pure=False)
            rows = [f"mine={module}:half"]
            summary = evaluate(small_folder(), QUICK, rows, {"lump": 2}, 2, module, executor)
            return summary["methods"]["mine"]["failed"]

        assert failures("rows_of_mine") == 0
        lacks = "a worker cannot import the rows: No module named 'package_of_mine', expected"
        refused(lacks, failures, "package_of_mine")
        unsent = "sending the rows to workers failed: .*cannot pickle"
        refused(unsent, failures, "lock_of_mine", error=FatalError)


def test_a_run_that_goes_on_can_be_read_but_has_one_writer(tmp_path, monkeypatch):
    seen = []

    def look() -> None:
        seen.append(read_run(tmp_path).summary["methods"]["ours-bv"]["n"])
        if len(seen) == 3:
            assert main(f"tables {tmp_path} --out {tmp_path}/reports".split()) == 0
            refused("another process is writing", evaluate, *arguments)

    arguments = (small_folder(), QUICK, ["ours-bv"], 2, 3, tmp_path)
    monkeypatch.setattr("zsp_lite.benchmark.execution.add_lines", after_each_save(look))
    evaluate(*arguments)
    assert seen == [1, 2, 3, 4]  # two pairs of each category
    assert evaluate(*arguments)["methods"]["ours-bv"]["n"] == 4


def test_any_executor_will_do_and_gets_the_backbone_once(undisturbed, tmp_path):
    sizes = []

    class Counting(ThreadPoolExecutor):
        def submit(self, function, *arguments):
            sizes.append(len(cloudpickle.dumps(arguments)))
            return super().submit(function, *arguments)

    heavy = replace(QUICK, weights=np.zeros(1_000_000))
    with Counting(2) as executor:
        found = evaluate(small_folder(), heavy, ROWS, 6, 3, tmp_path, executor)
    assert found["methods"] == undisturbed[1]["methods"]
    assert len(sizes) > 2
    assert max(sizes) < 10_000  # bytes: far less than the weights
    assert list(tmp_path.glob(".rows*")) == []


def thread_counts() -> list[int]:
    """The numbers of threads of OpenCV and of the linear algebra."""
    return [cv2.getNumThreads(), *(one["num_threads"] for one in threadpool_info())]


def test_numbers_of_threads_are_restored_after_blocks_that_overlap():
    started = threading.Barrier(2)
    go = threading.Event()
    ended = threading.Event()

    def block(waits_for: threading.Event, then: threading.Event) -> set[int]:
        with one_thread():
            started.wait()
            waits_for.wait()
            inside = set(thread_counts())
        then.set()
        return inside

    go.set()
    with threadpool_limits(2, "blas"):
        before = thread_counts()
        assert 2 in before[1:]
        # The first block to start may be the first or the last to end.
        with ThreadPoolExecutor(2) as executor:
            blocks = executor.submit(block, go, ended), executor.submit(block, ended, go)
        assert [one.result() for one in blocks] == [{1}, {1}]
        assert thread_counts() == before


@pytest.mark.parametrize("executor", ["nowhere:Pool", 0, 10**11, True])
def test_unusable_executors_are_refused(executor):
    refused("workers", check_workers, executor)


def pairs_to_evaluate(rows: list[str], pairs: int, targets: int) -> dict:
    """The pairs of a run on one category, with the rows that evaluate each."""
    return pairs_of_rows(Co3D(small_folder()), resolve(rows), {"lump": pairs}, targets)


def test_a_vision_transformers_features_do_not_depend_on_threads():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        backbone = Backbone(VisionTransformer(32, 8, 24, 2, 3), "small", layer=1, device="cpu")
    pairs = pairs_to_evaluate(["ours"], 2, 2)

    def errors(threads: int) -> list[float]:
        # A row has 60 seconds.
        evaluator = open_evaluator(str(small_folder()), resolve(["ours"]), backbone, 60, threads)
        lines = [evaluator(pair, names) for pair, names in pairs.items()]
        return [line.results["ours"].error for line in lines]

    assert errors(1) == errors(2)


def test_the_note_of_a_run_says_that_several_versions_of_the_library_evaluated_it(
    tmp_path, monkeypatch
):
    run = functools.partial(
        evaluate, small_folder(), BACKBONE, pairs={"lump": 1}, targets=2, out=tmp_path
    )
    run(["ours-bv"])
    first = library_version()
    other = {"version": "1", "commit": "0123abc"}
    monkeypatch.setattr("zsp_lite.benchmark.runs.library_version", lambda: other)
    assert "note" not in read_run(tmp_path).summary
    run(["ours"])
    assert json.loads((tmp_path / SETTINGS).read_text())["library"] == [first, other]
    assert "several versions of zsp-lite" in read_run(tmp_path).summary["note"]


def test_a_folder_that_holds_no_run_is_neither_read_nor_continued(undisturbed, tmp_path):
    run = shutil.copytree(undisturbed[0], tmp_path / "run")
    (run / SETTINGS).unlink()
    with pytest.raises(InputError, match="settings of a run .*run.json cannot be read"):
        again(run)  # it has results
    for folder in (tmp_path, tmp_path / "nowhere"):
        told = f"settings of a run {re.escape(str(folder / SETTINGS))} cannot be read: no such file"
        refused(told, read_run, folder)


@pytest.mark.skipif(
    not Path("/dev/full").exists(), reason="this system has no device that is always full"
)
def test_a_full_disk_is_one_error(tmp_path):
    (tmp_path / LINES).symlink_to("/dev/full")
    with pytest.raises(InputError, match="run.jsonl cannot be written: .*No space left"):
        add_lines(tmp_path, [{"pair": "lump/a:0/b:1", "results": {}}])


def test_features_are_computed_once_for_all_rows(tmp_path):
    batches = []

    class Counting(CoordinateBackbone):
        def __call__(self, images):
            batches.append(len(images))
            return super().__call__(images)

    rows = "ours ours-k30 ours-n1 ours-globalsim ours-n6".split()
    run_rows(rows, tmp_path, 4, 3, backbone=Counting(grid=8))
    frames = set()
    for pair in pairs_to_evaluate(rows, 4, 3):
        frames |= {(pair.target_sequence, number) for number in pair.target_frames}
        frames.add((pair.reference_sequence, pair.reference_frame))
    # One by one: a frame's features do not depend, in their last bits, on the rest of a batch.
    assert batches == [1] * len(frames)


def test_the_same_data_by_another_path_continue_a_run_and_other_data_do_not(
    tmp_path, monkeypatch, links
):
    for name in ("data", "elsewhere/data"):
        shutil.copytree(small_folder(), tmp_path / name)
    (tmp_path / "link").symlink_to(tmp_path / "data")

    def run(data, row: str) -> str:
        return evaluate(data, BACKBONE, [row], {"lump": 1}, 2, tmp_path / "run")["data"]["root"]

    monkeypatch.chdir(tmp_path)
    assert run("data", "icp") == "data"
    assert run(tmp_path / "data", "ours-bv") == str(tmp_path / "data")
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert run("../link", "ours") == "../link"
    assert run("data", "sift") == "data"
    # Other images, and the same labels, also at the path of the last call.
    for path in tmp_path.glob("*/**/images/frame000001.jpg"):
        path.write_bytes(b"")
    for data in ("../data", "data"):
        refused("a run with images or labels of lump/.*; choose another folder", run, data, "ours")
    assert list(read_run(tmp_path / "run").settings.methods) == ["icp", "ours-bv", "ours", "sift"]


def test_pose_labels_that_have_changed_do_not_mix_but_may_be_of_another_processor(tmp_path):
    """There labels differ as those of a backpack did on two processors: the unit of length by 3e-5,
    and the last digit of a rotation."""
    root = shutil.copytree(small_folder(), tmp_path / "data")

    def run(row: str) -> None:
        evaluate(root, BACKBONE, [row], {"lump": 2}, 2, tmp_path / "run")

    run("ours-bv")
    label = next(one for one in read_labels(root, "lump").values() if one.seq != one.reference_seq)
    trans = label.trans + 1e-9 * np.eye(4, k=1)
    trans[:3, 3] *= 1 + 3e-5
    write_label(root, "lump", replace(label, trans=trans))
    run("icp")
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    write_label(root, "lump", replace(label, trans=label.trans @ half_turn))
    refused("a run with images or labels of lump", run, "icp")


def stop() -> None:
    """Interrupt a run."""
    raise KeyboardInterrupt


@pytest.fixture
def unfinished(tmp_path, monkeypatch) -> Path:
    """The folder of a run that was interrupted after one of three pairs, with its tables."""
    with monkeypatch.context() as context, pytest.raises(KeyboardInterrupt):
        context.setattr("zsp_lite.benchmark.execution.add_lines", after_each_save(stop))
        run_rows(["ours", "ours-bv"], tmp_path, 3)
    write_reports(tmp_path)
    return tmp_path


def test_the_tables_of_an_unfinished_run_say_so(unfinished):
    for name in ("all_rows", "table_a_depth", "categories_acc30"):
        table = (unfinished / "tables" / f"{name}.md").read_text()
        assert "Not finished: 1 of 3 pairs." in table


def test_tables_that_the_last_call_has_no_rows_for_are_removed_and_nothing_else(unfinished):
    tables = unfinished / "tables"
    run_rows(["ours"], unfinished, 3)
    (tables / "mine.csv").touch()
    write_reports(unfinished)
    assert not list(tables.glob("table_a_depth*"))
    assert (tables / "mine.csv").exists()
    assert "Not finished" not in (tables / "all_rows.md").read_text()
    run_rows(["category"], unfinished, 4)
    write_reports(unfinished)
    assert not list(tables.glob("all_rows*"))
    assert (tables / "with_others.md").exists()

"""Options beyond all measure, damaged results, and folders that another process writes to."""

import gzip
import json
import math
import signal
import subprocess
import sys

from tests.hostile.harness import Wrong, case, command, gzip_bomb, strange_files
from zsp_lite.benchmark.results import read_results
from zsp_lite.benchmark.summary import summarise_rows
from zsp_lite.data.co3d import write_co3d
from zsp_lite.io.files import write_atomic

BENCHMARK = ("benchmark", "--data", "ROOT/data", "--out", "ROOT/out", "--targets", "2", "--methods", "icp")
for name, value in {
    "pairs": "100000000", "targets": "1000000000", "workers": "100000000000", "threads": "100000000000",
    "seed": "-1", "backbone": "\0", "layer": "block999999999", "image-size": "1000000", "executor": "json:loads",
    "categories": "../..", "cache": "/dev/null/x",
}.items():  # fmt: skip
    command("options", f"benchmark --{name} {value!r}", *BENCHMARK, f"--{name}", value)
for value in (
    "json:loads",
    "os:system",
    "nosuch:name",
    "nosuch",
    ":",
    "dask://\0",
    "dask://localhost:99999",
    "raises:now",
):
    command("options", f"benchmark --executor {value!r}", *BENCHMARK, "--executor", value,
            change=lambda folder: (folder / "raises.py").write_text("raise SystemExit(3)"))  # fmt: skip
for value in ("json:loads", "os:_exit", "nosuch:name", ":", ",", "icp,icp2", "raises:now", "[/1]", "a\0b"):
    command("options", f"benchmark --methods {value!r}", *BENCHMARK[:-1], value,
            change=lambda folder: (sys.path.insert(0, str(folder)), (folder / "raises.py").write_text("raise KeyError(3)")))  # fmt: skip
command(
    "options",
    "benchmark into a file",
    *BENCHMARK,
    "--pairs",
    "2",
    change=lambda folder: (folder / "out").write_text(""),
)
command("options", "benchmark into /dev/null", *BENCHMARK[:3], "--out", "/dev/null/x", *BENCHMARK[5:])
command("options", "benchmark of a null byte", "benchmark", "--data", "a\0b")
command("options", "benchmark into a null byte", *BENCHMARK[:3], "--out", "a\0b", *BENCHMARK[5:])
for name, value in {"sequences": "1000000000", "frames": "1000000000", "seed": "1e9"}.items():
    command(
        "options", f"synth --{name} {value}", "synth", "--category", "chair", f"--{name}", value, "--out", "ROOT/out"
    )
for argv in (
    ("synth", "--category", "[/1]", "--out", "ROOT/out"), ("synth", "--preset", "\0", "--out", "ROOT/out"),
    ("synth", "--models", "ROOT/nothing", "--out", "ROOT/out", "--image-size", "1000000"),
    ("demo", "--data", "ROOT/data", "--out", "a\0b"), ("demo", "--data", "\udcff"),
    ("demo", "--data", "ROOT/data", "--image-size", "1000000", "--out", "ROOT/out"),
    ("tables", "\0"), ("tables", "ROOT"), ("tables", "ROOT/nothing", "ROOT/nothing"), ("compare", "ROOT", "\udcff"),
    ("data", "check", "\0"), ("data", "check", "ROOT/data", "--show", "-1"), ("data", "labels", "file:///etc", "--root", "ROOT/data"),
    ("data", "labels", "http://localhost:1/x", "--root", "ROOT/data", "--sha256", "0" * 64),
    ("data", "transfer", "ROOT/data", "ROOT/data", "../cup"), ("label", "ROOT/data", "../cup", "--list"),
    ("label", "ROOT/data", "cup", "--reference", "[/1]", "--list"), ("weights", "fetch", "../../x"),
    ("weights", "verify", "\0"), ("weights", "fetch", "hf:../../x"), ("models", "turn", "ROOT", "[/1]", "--degrees", "nan"),
    ("models", "turn", "ROOT", "a/b", "--degrees", "1e400"), ("models", "sheet", "ROOT/nothing"), ("profile", "--repeats", "0"),
    ("nosuch",), ("--nosuch",), ("benchmark", "--pairs"), ("benchmark", "--pairs", "1.5"), ("benchmark", "--pairs", "٣x"),
    ("train-baseline", "[/1]"), ("train", "--shorten", "nan", "--out", "ROOT/out"), ("train", "--shorten", "1e400"),
    ("train", "--start-from", "\0", "--out", "ROOT/out"), ("train", "--objects", "0"),
):  # fmt: skip
    command("options", " ".join(argv)[:60], *argv)
BOX = ("data", "import", "tum", "ROOT/nothing", "--root", "ROOT/data", "--category", "c", "--sequence", "s")
for value in ("1,2,3", "a,b,c,d", "nan,1,2,3", "1e400,1,2,3", "1.5,1,2,3", "1,2,3,4,5"):
    command("options", f"import --box {value}", *BOX, "--box", value)


# results
def _results(change=lambda content: None):
    keys = [f"cup/a:{i}/b:0,1" for i in range(4)]
    errors = [1.0, 2.0, 3.0, 4.0]
    data = {"root": "d", "categories": ["cup"], "pairs": 4, "targets": 2, "seed": 0}
    summary = summarise_rows({"ours": {key: {"error": error} for key, error in zip(keys, errors)}})
    content = {
        "summary": {"data": data, "backbone": "n", **summary}, "invocations": [], "pairs": keys,
        "settings": {"data": "d", "backbone": "n 0", "targets": 2, "seed": 0, "methods": {}},
        "rows": {"ours": {"pair": [0, 1, 2, 3], "error": errors, "view": [0, 0, 0, 0]}},
    }  # fmt: skip
    return change(content) or content


def _write(content):
    data = content if isinstance(content, bytes) else json.dumps(content).encode()
    return lambda folder: (folder / "r.json.gz").write_bytes(gzip.compress(data))


def _error(value, part="error"):
    return lambda content: content["rows"]["ours"].__setitem__(part, [value, 1.0, 2.0, 3.0])


RESULTS = {
    "error of -5": _error(-5), "error of 1e6": _error(1e6), "error not a number": _error(math.nan),
    "error infinite": _error(math.inf), "error a text": _error("5"), "error a list": _error([5]),
    "error a truth value": _error(True), "error missing": _error(None), "error of 180.1": _error(180.1),
    "confidence of 7": _error(7.0, "confidence"), "confidence not a number": _error(math.nan, "confidence"),
    "too few errors": lambda content: content["rows"]["ours"].__setitem__("error", [1.0]),
    "pair twice": lambda content: content["rows"]["ours"].__setitem__("pair", [0, 0, 1, 2]),
    "pair 99": lambda content: content["rows"]["ours"].__setitem__("pair", [99, 1, 2, 3]),
    "pair -1": lambda content: content["rows"]["ours"].__setitem__("pair", [-1, 0, 1, 2]),
    "pairs that are numbers": lambda content: content.__setitem__("pairs", [1, 2, 3, 4]),
    "pairs without a category": lambda content: content.__setitem__("pairs", list("abcd")),
    "no rows": lambda content: content.__setitem__("rows", {}),
    "rows a list": lambda content: content.__setitem__("rows", []),
    "row a number": lambda content: content.__setitem__("rows", {"ours": 5}),
    "no summary": lambda content: content.pop("summary") and None,
    "empty": lambda content: {"": 0},
    "summary of other errors": lambda content: content["summary"]["methods"]["ours"].update(median=50.0),
    "summary of more pairs": lambda content: content["summary"]["methods"]["ours"].update(n=400),
    "summary of another row": lambda content: content["summary"]["methods"].update(x=content["summary"]["methods"]["ours"]),
    "accuracy of 400 percent": lambda content: content["summary"]["methods"]["ours"].update(acc30=400.0),
    "accuracy a text": lambda content: content["summary"]["methods"]["ours"].update(acc30="all"),
    "targets missing": lambda content: content["summary"]["data"].pop("targets") and None,
}  # fmt: skip
case("results", "nothing wrong", lambda folder: (_write(_results())(folder), read_results(folder / "r.json.gz"))[1],
     answers=True)  # fmt: skip
command("results", "tables of nothing wrong", "tables", "ROOT/r.json.gz", change=_write(_results()), codes=(0,))
for name, change in RESULTS.items():
    case("results", name, lambda folder, change=change: (
        _write(_results(change))(folder), read_results(folder / "r.json.gz"))[1])  # fmt: skip
    command("results", f"tables of {name}", "tables", "ROOT/r.json.gz", change=_write(_results(change)))
for name, data in {"100,000 levels": b"[" * 100_000, "not UTF-8": b"\xff", "number of 10,000 digits": b"9" * 10_000,
                   "null": b"null"}.items():  # fmt: skip
    case("results", name, lambda folder, data=data: (_write(data)(folder), read_results(folder / "r.json.gz"))[1])
command("results", "gzip bomb", "tables", "ROOT/r.json.gz", change=lambda f: (f / "r.json.gz").write_bytes(gzip_bomb()))
for name, write in strange_files().items():
    command(
        "file", f"results: {name}", "tables", "ROOT/r.json.gz", change=lambda f, write=write: write(f / "r.json.gz")
    )
for file in ("run.json", "run.sqlite"):
    for name, write in strange_files().items():
        if name != "missing":
            command("file", f"continued run, {file}: {name}", *BENCHMARK, "--pairs", "2",
                    change=lambda f, write=write, file=file: ((f / "out").mkdir(), write(f / "out" / file)))  # fmt: skip


# locks and leftovers
def _other_process(code: str, folder) -> subprocess.Popen:
    """Start a Python process and wait for its first line."""
    process = subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline()
    return process


_HOLD = "import sys, time; from zsp_lite.io.locks import writing\nwith writing(sys.argv[1]): print(1, flush=True); time.sleep(30)"


def _locked(folder, kill):
    from co3d_folders import sequence_data

    holder = _other_process(_HOLD, folder / "data/cup")
    if kill:
        holder.send_signal(signal.SIGKILL)
        holder.wait()
    try:
        write_co3d(folder / "data", "cup", [sequence_data("new", 2)])
    finally:
        holder.kill()
    return "written"


case("lock", "write_co3d beside another writer", lambda folder: _locked(folder, False))
case("lock", "write_co3d after a killed writer", lambda folder: _locked(folder, True), answers=True)


def _left_over(folder, alive):
    """A temporary file of a process that was killed, or of one that goes on."""
    code = ("import os, sys, time; os.replace = lambda *_: (print(1, flush=True), time.sleep(30))\n"
            "from zsp_lite.io.files import write_atomic; write_atomic(sys.argv[1], b'old')")  # fmt: skip
    target = folder / "target.txt"
    process = _other_process(code, target)
    if not alive:
        process.send_signal(signal.SIGKILL)
        process.wait()
    left = len(list(folder.glob(".target.txt.*")))
    write_atomic(target, b"new")
    now = [path.name for path in folder.glob(".target.txt.*")]
    process.kill()
    if left != 1 or len(now) != alive or target.read_bytes() != b"new":
        raise Wrong(f"{left} temporary files before, {now} after, expected 1 and {int(alive)}")
    return now


case("lock", "temporary file of a killed process", lambda folder: _left_over(folder, False), answers=True)
case("lock", "temporary file of a process that goes on", lambda folder: _left_over(folder, True), answers=True)

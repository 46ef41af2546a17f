"""The command line: help with examples for every command, one line for bad input, no tracebacks."""

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from synthetic_views import CoordinateBackbone

from zsp_lite import __version__, errors
from zsp_lite.backbones.load import BackboneConfig
from zsp_lite.benchmark.methods import GROUPS, METHODS
from zsp_lite.benchmark.run import evaluate, write_reports
from zsp_lite.choices import METRICS_SHOWN
from zsp_lite.cli import demo, doctor
from zsp_lite.cli.estimate import estimate
from zsp_lite.cli.main import cli, main
from zsp_lite.data.co3d import Co3D
from zsp_lite.importers import FORMATS
from zsp_lite.importers.convert import ImportResult

DOWNLOAD = "data download --yes"
IMPORT = "data import --root=x --category=c --sequence=s"


def commands(group: click.Group = cli, path: str = "zsp-lite") -> Iterator[str]:
    """Every command, nested ones included, as it is called."""
    for name, command in group.commands.items():
        yield f"{path} {name}"
        if isinstance(command, click.Group):
            yield from commands(command, f"{path} {name}")


@pytest.mark.parametrize("command", [*commands()])
def test_every_command_has_an_example_and_says_of_an_unknown_option_where_help_is(command, run):
    words = command.removeprefix("zsp-lite ")
    text = run(f"{words} --help")
    assert text.startswith(f"Usage: {command}")
    assert f"    {command}" in text.partition("Examples:")[2]
    (line,) = run(f"{words} --unknown", 2).splitlines()
    assert "--unknown" in line
    assert line.endswith(f"(see: {command} --help)")


def test_the_help_lists_every_command(run):
    names = "demo estimate align benchmark tables compare synth challenge weights data doctor"
    assert set(cli.commands) == set(names.split())
    text = run("--help")
    assert [name for name in names.split() if f"\n  {name} " not in text] == []


def test_the_version_is_told(run):
    assert run("--version") == f"zsp-lite, version {__version__}\n"


def test_helpers_are_the_paths_up_to_the_next_option():
    for line in ("a b --helpers c d --json", "--helpers c d -- a b", "--helpers c d --json a b"):
        given = estimate.make_context("estimate", line.split()).params
        assert (given["reference"], given["target"]) == (Path("a"), Path("b"))
        assert given["helpers"] == (Path("c"), Path("d"))


def output_of(program: str) -> str:
    """What a program in Python prints."""
    return subprocess.check_output([sys.executable, "-c", program], text=True)


HELP = """
import sys
from zsp_lite.cli.main import main
main(['benchmark', '--help'])
large = {'torch', 'numpy', 'pandas', 'scipy', 'matplotlib', 'cv2', 'rich'}
print(large & set(sys.modules))
"""


def test_help_imports_no_large_library():
    assert output_of(HELP).endswith("set()\n")


THREADS = """
import os
from zsp_lite.cli.main import main
main("align x --category y --mark z:0:1,1".split())  # a module that imports torch reads the mark
import torch
print(os.environ["OMP_NUM_THREADS"], torch.get_num_threads())
"""


def test_a_command_computes_with_one_thread_or_as_many_as_the_environment_says(monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    assert output_of(THREADS) == "1 1\n"
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    # How many torch takes depends on the cores as well.
    assert output_of(THREADS).startswith("2 ")


WRONG = [
    ("demo --out a\0b", "'--out': got 'a\\x00b', expected a path"),
    ("benchmark --methods ,", "expected names separated by commas"),
    ("benchmark --metrics acc30,speed", "got 'acc30,speed'"),
    ("synth --preset a --category b --out x", "expected either --preset or --category"),
    ("synth --preset demo --frames 3 --out x", "--frames does not go with --preset"),
    ("synth --category mouse --up +z --out x", "--up does not go with --category"),
    ("estimate a b --depth-unit 0", "got '0', expected a positive number"),
    ("estimate a b --box 1,2,3,4.5", "got '1,2,3,4.5', expected four integers"),
    ("estimate a b --out x --out y", "--out is given twice, expected once"),
    ("estimate a b --up 0,1", "got '0,1', expected three numbers, or none"),
    ("estimate a b --intrinsics inf,1,2,3", "got 'inf,1,2,3', expected four numbers"),
    ("estimate --helpers c d a b", "Missing argument 'REFERENCE'"),
    ("estimate a --helpers c --helpers d b", "Missing argument 'TARGET'"),
    ("estimate a b --helpers c --solver paper", "--helpers"),
    ("demo --data no/such/folder", str(Path("no/such/folder"))),
    ("benchmark --categories ellipsoid,cube", "'cube'"),
    (f"{DOWNLOAD} co3d --category spaceship", "co3d (full) is 'spaceship', expected one of "),
    (
        f"{DOWNLOAD} co3d-v1 --category toaster --single-sequence",
        "--single-sequence does not go with co3d-v",
    ),
    (
        f"{DOWNLOAD} co3d-v1 --category toaster --labelled-only",
        "--labelled-only goes with --labels",
    ),
    (
        f"{DOWNLOAD} co3d --category toaster --labels x",
        "--labels does not go with co3d: labels are of v1",
    ),
    ("data import uco3d x --category c --out o --sequences a --best 2", "--sequences (see: zsp"),
    ("tables a --size 3,2,1", "got '3,2,1', expected two numbers from 1 to 100"),
    ("challenge make --categories car --out x", "no terminal to ask"),
    ("challenge make --secret short --categories car --out x", "expected at least 8"),
    ("challenge make --secret long_enough --categories cow --out x", "category"),
    ("challenge rank nowhere --keep nowhere --out x", "nowhere has no labels"),
    (f"{IMPORT} x --box=1,1,9,9 --masks=m", "--masks does not go with --box"),
]


@pytest.mark.parametrize("line, message", WRONG)
def test_bad_input_is_one_line_exit_code_2_and_no_file(
    line, message, run, ellipsoids, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    if line.startswith(("demo", "benchmark")) and "--data" not in line:
        line += f" --data {ellipsoids.root}"
    (printed,) = run(line, 2).splitlines()
    assert printed.startswith("zsp-lite: ")
    assert message in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "error, code",
    [
        (errors.InputError("two\nlines"), 2),
        (PermissionError(13, "Permission denied", "/there"), 2),
        (KeyboardInterrupt(), 130),
    ],
)
def test_an_error_inside_a_command_is_one_line(error, code, monkeypatch, run):
    def fail():
        raise error

    monkeypatch.setattr(doctor, "run_checks", fail)
    assert run("doctor", code).count("\n") == 1


@pytest.mark.slow
def test_the_demo_prints_a_table_and_writes_its_report(ellipsoids, tmp_path, loaded, run):
    text = run(f"demo --data {ellipsoids.root} --out {tmp_path}")
    parts = ("ellipsoid", "paper", "verified", " of 5", "°", demo.USER_NOTE)
    assert [part for part in parts if part not in text] == []
    assert (tmp_path / "report.html").stat().st_size > 1_000_000  # plotly's script and the pictures


@pytest.mark.parametrize(
    "words, inside", [("demo --data .", ""), ("estimate ellipsoid/a ellipsoid/b", "deeper")]
)
def test_an_output_folder_that_is_a_file_is_refused_before_any_computation(
    words, inside, ellipsoids, tmp_path, monkeypatch, loaded, run
):
    monkeypatch.chdir(ellipsoids.root)
    (tmp_path / "file").write_text("mine")
    assert "expected a folder" in run(f"{words} --out {tmp_path}/file/{inside}", 2)
    assert (tmp_path / "file").read_text() == "mine"
    assert not loaded


def test_synth_writes_a_co3d_folder(tmp_path, run):
    run(f"synth --category mouse --sequences 1 --frames 2 --seed 3 --out {tmp_path}")
    assert [key.frame_number for key in Co3D(tmp_path).frame_list("mouse")] == [0, 1]


def test_weights_list_has_every_backbone(run):
    text = run("weights list")
    names = "zsp-tiny dino_vits8 dino_vits16 dino_vitb8 dino_vitb16".split()
    assert [name for name in names if name not in text] == []


def test_benchmark_list_has_every_method_and_group_in_100_columns(run):
    lines = run("benchmark --list").splitlines()
    first_words = {line.split()[0] for line in lines if line.strip()}
    assert {*METHODS, *(f"{name}:" for name in GROUPS)} <= first_words
    assert max(map(len, lines)) <= 100


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no bash, and no SIGPIPE")
def test_a_reader_that_ends_early_ends_the_output_without_an_error():
    for command, reader in (("benchmark --list", "head -1"), ("--help", "true")):
        pipe = f"{sys.executable} -u -m zsp_lite {command} | {reader}; exit ${{PIPESTATUS[0]}}"
        done = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, ""), command


@pytest.fixture(scope="module")
def table3(ellipsoids, tmp_path_factory) -> Path:
    """The folder of a run of the rows of table 3."""
    out = tmp_path_factory.mktemp("table3")
    evaluate(ellipsoids.root, CoordinateBackbone(), ["table3"], {"ellipsoid": 2}, 3, out)
    write_reports(out)
    return out


@pytest.mark.slow
def test_a_benchmark_prints_its_rows_unless_it_is_quiet(
    ellipsoids, tmp_path, monkeypatch, loaded, run
):
    monkeypatch.setenv("COLUMNS", "200")
    options = f"--categories ellipsoid --pairs 2 --targets 3 --methods table3 --out {tmp_path}"
    line = f"benchmark --data {ellipsoids.root} {options}"
    assert "ours-globalsim" in run(line)
    table = tmp_path / "tables/table_3.md"
    before = table.read_text()
    assert run(f"{line} --quiet") == ""
    assert table.read_text() == before
    methods = json.loads((tmp_path / "summary.json").read_text())["methods"]
    assert methods["ours"]["n"] == methods["ours-globalsim"]["n"] == 2


@pytest.mark.slow
def test_tables_are_made_again_from_a_run(table3, tmp_path, monkeypatch, run):
    monkeypatch.setenv("COLUMNS", "200")
    assert "GlobalSim" in run(f"tables {table3} --out {tmp_path}")
    for made in ("tables/table_3.md", "summary.json"):
        assert (tmp_path / made).read_bytes() == (table3 / made).read_bytes()
    # Bytes: more than the axes alone.
    assert (tmp_path / "figures/error_distribution.png").stat().st_size > 5000


@pytest.mark.slow
def test_tables_have_the_chosen_rows_in_their_order_and_metrics(table3, tmp_path, monkeypatch, run):
    monkeypatch.setenv("COLUMNS", "200")
    options = "--rows ours-globalsim,ours --latex time,intervals --size 3,2 --metrics scale"
    assert "ms per pair" in run(f"tables {table3} {options} --out {tmp_path}")
    text = (tmp_path / "tables/all_rows.tex").read_text()
    assert re.search(r"ms per pair.*ours-globalsim.* \[.*ours +&", text, re.DOTALL)
    assert "scale ratio" in text
    assert "Acc15" not in text


@pytest.mark.slow
def test_a_pair_of_a_run_is_drawn(table3, run):
    key = json.loads((table3 / "run.jsonl").read_text().splitlines()[0])["pair"]
    line = f"tables {table3} --pair {key}"
    drawn = Path(run(f"{line} --rows ours").removeprefix("Written: ").strip())
    assert drawn.name == f"pair_{re.sub('[/:]', '_', key)}.png"
    assert drawn.with_suffix(".pdf").is_file()
    assert "nowhere" in run(f"{line} --data nowhere", 2)


@pytest.mark.slow
def test_runs_are_compared(table3, monkeypatch, run):
    monkeypatch.setenv("COLUMNS", "200")
    rows = "ours,ours:ours-globalsim"
    assert "ours:ours-globalsim" in run(f"compare {table3} {table3} --rows {rows}")


def test_every_option_of_the_benchmark_reaches_the_library(monkeypatch, tmp_path):
    given = []

    def record(*arguments, **options):
        given.append((*arguments, options))
        raise errors.InputError("reached")

    monkeypatch.setattr("zsp_lite.benchmark.run.evaluate", record)
    line = f"benchmark --data {tmp_path} " + (
        "--backbone small --layer 3 --facet value --image-size 64 --categories lump,chair "
        "--pairs 7 --targets 3 --methods ours,x=a:b --out there --quiet"
    )
    config = BackboneConfig("small", "3", "value", 64)
    numbers = {"lump": 7, "chair": 7}
    common = {
        "backbone": config,
        "methods": ["ours", "x=a:b"],
        "pairs": numbers,
        "targets": 3,
        "out": Path("there"),
        "executor": 1,
        "row_seconds": 60,
        "seeds": 1,
        "sweep": (),
        "metrics": list(METRICS_SHOWN),
    }
    for more, changed in (
        ("--workers 5", {"executor": 5}),
        ("--row-seconds 9 --metrics scale", {"row_seconds": 9, "metrics": ["scale"]}),
        ("--seeds 3 --sweep threshold=0.1,0.2", {"seeds": 3, "sweep": [0.1, 0.2]}),
    ):
        assert main(f"{line} {more}".split()) == 2
        assert given == [(tmp_path, common | changed)]
        given.clear()


OPTIONS = "--root mine --category cup --sequence one --frames 7"


@pytest.mark.parametrize(
    "words, options",
    [
        (
            "scan --box 1,2,3,4",
            {"mask": "box", "box": (1, 2, 3, 4)},
        ),
        (
            "scan --masks there --depth-unit 0.5 --object 0 --label 3 --orientation stored",
            {
                "mask": "given",
                "masks": Path("there"),
                "depth_unit": 0.5,
                "object": 0,
                "label": 3,
                "orientation": "stored",
            },
        ),
    ],
)
def test_options_of_the_import_reach_the_library(words, options, monkeypatch, run):
    given = []

    def open_source(path, **options):
        given.append((path, {name: value for name, value in options.items() if value is not None}))
        return "source"

    def import_source(*arguments):
        given.append(arguments)
        return ImportResult(1, 1, 1.0, ("the masks may be wrong: why",))

    monkeypatch.setattr("zsp_lite.importers.sources.open_source", open_source)
    monkeypatch.setattr("zsp_lite.importers.convert.import_source", import_source)
    assert "flag: the masks may be wrong: why\n" in run(f"data import {words} {OPTIONS}")
    source = (Path("scan"), {"count": 7} | options)
    assert given == [source, ("source", Path("mine"), "cup", "one")]


def test_the_import_names_its_formats(run):
    text = run("data import --help")
    assert [name for name in FORMATS if name not in text] == []

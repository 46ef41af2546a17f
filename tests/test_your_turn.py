"""`check` keeps right parts of the method, and says which mistake a wrong one has."""

import inspect

import pytest

from zsp_lite.course import your_turn
from zsp_lite.course.your_turn import _PARTS, _TESTS, HEADER, check, my_method

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
    names = dict(vars(inspect.getmodule(_PARTS[name])), __name__="__main__")
    path = f"{name}.py"
    with open(path, "w") as file:
        file.write(source)
    exec(compile(source, path, "exec"), names)
    return names[name]


@pytest.mark.parametrize("name, mistake", MISTAKES)
def test_each_known_mistake_has_its_own_sentence(name, mistake, capsys, monkeypatch):
    # The library's source with the mistake in it takes other things of the library.
    names = "COLLINEAR, SCALES, InputError, draw_samples"
    monkeypatch.setattr(your_turn, "HEADER", f"{HEADER}from zsp_lite.minimal import {names}\n")
    source = inspect.getsource(_PARTS[name])
    for right, wrong in mistake["change"]:
        assert right in source
        source = source.replace(right, wrong)
    print(your_turn._defect(name, source))
    out = capsys.readouterr().out
    assert out.splitlines()[-1] == mistake["says"], out

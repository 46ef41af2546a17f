"""The questions of the self-checks, and how a notebook shows them: in the file itself, without a
network."""

import json
import re
import sys

import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output
from refusals import refused

from zsp_lite.course.widgets import self_check
from zsp_lite.course.widgets.quiz import QUESTIONS, read_questions

FILES = sorted(QUESTIONS.glob("*.json"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_question_has_right_and_wrong_answers_with_feedback_to_each(path):
    checks = json.loads(path.read_text("utf-8"))
    assert re.fullmatch(r"\d\d", path.stem)
    assert [2 <= len(questions) <= 4 for questions in checks] == [True, True]
    for question in sum(checks, []):
        kind, answers = question["type"], question["answers"]
        right = sum(answer.get("correct", False) for answer in answers)
        assert 0 < right < len(answers)
        assert kind != "multiple_choice" or right == 1
        # for what no value and no range covers
        assert (kind == "numeric") == (answers[-1].get("type") == "default")
        assert all(
            low < high for low, high in (answer["range"] for answer in answers if "range" in answer)
        )
        assert len({answer["feedback"] for answer in answers}) == len(answers)


@pytest.mark.parametrize("number", [1, 2])
def test_the_questions_are_in_the_output_itself(number):
    InteractiveShell.instance()  # shows outputs as a notebook does
    with capture_output() as captured:
        self_check("00", number)
    InteractiveShell.clear_instance()
    form, script = (output.data for output in captured.outputs)
    embedded = re.search(r"var questions\w+=(.*);\n", script["application/javascript"])[1]
    assert json.loads(embedded) == read_questions("00")[number - 1]
    assert "fetch(" not in script["application/javascript"]
    assert "http" not in form["text/html"]


def test_an_unknown_self_check_is_named():
    refused("notebook is '99', expected one of 00", self_check, "99", 1)
    refused("number is 3, expected an integer from 1 to 2", self_check, "00", 3)


def test_without_jupyterquiz_the_error_has_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "jupyterquiz", None)
    refused(
        r"needs jupyterquiz, which is not installed; pip install jupyterquiz", self_check, "00", 1
    )

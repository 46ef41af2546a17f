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
    for question in sum(json.loads(path.read_text("utf-8")), []):
        answers = question["answers"]
        right = sum(answer.get("correct", False) for answer in answers)
        assert 0 < right < len(answers)
        if question["type"] == "multiple_choice":
            assert right == 1
        assert len({answer["feedback"] for answer in answers}) == len(answers)
        # Numbers outside of all ranges get the default answer.
        has_default = answers[-1].get("type") == "default"
        assert has_default == (question["type"] == "numeric")
        for low, high in [answer["range"] for answer in answers if "range" in answer]:
            assert low < high


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

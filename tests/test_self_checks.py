"""The questions of the self-checks, and how a notebook shows them: in the file itself, without a network."""

import json
import re
import sys

import pytest
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output

from zsp_lite.errors import InputError
from zsp_lite.widgets import self_check
from zsp_lite.widgets.quiz import QUESTIONS, read_questions

FILES = sorted(QUESTIONS.glob("*.json"))
TAGS = r"</?(?:i|b|sub|sup|code|br)>"


def check_text(text: str) -> None:
    """Texts are HTML, without formulas in LaTeX and without addresses."""
    assert text.strip() == text and len(text) > 0
    assert "$" not in text and "://" not in text and "](" not in text, text
    assert "<" not in re.sub(TAGS, "", text), text
    assert not re.search(r"&(?!\w+;|#\d+;)", text), text


def check_choice(question: dict) -> None:
    answers = question["answers"]
    right = sum(answer["correct"] for answer in answers)
    assert len(answers) > 1 and 0 < right < len(answers)
    assert right == 1 if question["type"] == "multiple_choice" else right > 1
    assert len({answer["answer"] for answer in answers}) == len(answers)
    for answer in answers:
        assert answer.keys() == {"answer", "correct", "feedback"} and isinstance(answer["correct"], bool)
        check_text(answer["answer"])


def check_numeric(question: dict) -> None:
    """One default for whatever no value and no range covers; at least one right number."""
    *numbers, default = question["answers"]
    assert default.keys() == {"type", "feedback"} and default["type"] == "default"
    assert any(answer["correct"] for answer in numbers)
    for answer in numbers:
        assert answer.keys() == {"type", answer["type"], "correct", "feedback"} and isinstance(answer["correct"], bool)
        if answer["type"] == "value":
            assert isinstance(answer["value"], int | float)
        else:
            low, high = answer["range"]
            assert low < high  # the upper end is not included


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_question_has_right_and_wrong_answers_with_feedback_to_each(path):
    checks = json.loads(path.read_text(encoding="utf-8"))
    assert re.fullmatch(r"\d\d", path.stem) and len(checks) == 2
    for questions in checks:
        assert 2 <= len(questions) <= 4
        for question in questions:
            kind = question["type"]
            assert question.keys() - {"precision"} == {"question", "type", "answers"}
            assert kind == "numeric" or "precision" not in question
            {"multiple_choice": check_choice, "many_choice": check_choice, "numeric": check_numeric}[kind](question)
            check_text(question["question"])
            feedback = [answer["feedback"] for answer in question["answers"]]
            assert len(set(feedback)) == len(feedback)
            for text in feedback:
                check_text(text)


@pytest.mark.parametrize("number", [1, 2])
def test_the_questions_are_in_the_output_itself(number):
    InteractiveShell.instance()  # shows outputs as a notebook does
    with capture_output() as captured:
        self_check("00", number)
    InteractiveShell.clear_instance()
    form, script = (output.data for output in captured.outputs)
    embedded = re.search(r"var questions\w+=(.*);\n", script["application/javascript"])[1]
    assert json.loads(embedded) == read_questions("00")[number - 1]
    assert "fetch(" not in script["application/javascript"] and "http" not in form["text/html"]


def test_an_unknown_self_check_is_named():
    with pytest.raises(InputError, match="notebook is '99', expected one of 00"):
        self_check("99", 1)
    with pytest.raises(InputError, match="number is 3, expected an integer from 1 to 2"):
        self_check("00", 3)


def test_without_jupyterquiz_the_error_has_the_command_that_installs_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "jupyterquiz", None)
    with pytest.raises(InputError, match=r"needs jupyterquiz, which is not installed; pip install jupyterquiz"):
        self_check("00", 1)

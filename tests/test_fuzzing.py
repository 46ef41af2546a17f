"""Damaged and invented files of every kind: read, or refused by InputError. The inputs are the same in each run."""

import pytest
from fuzzing import TARGETS, check, run

pytestmark = pytest.mark.slow

EXAMPLES = 150  # of each target


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_accepts_its_format_and_refuses_damage_by_an_input_error(name):
    assert check(name, TARGETS[name].seed)
    run(name, EXAMPLES)

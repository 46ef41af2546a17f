"""Damaged and invented files of every kind: read, or refused by InputError. The inputs are the same in each run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from fuzzing import TARGETS, check, run

pytestmark = pytest.mark.slow

EXAMPLES = 300  # of each target; `python -m tests.fuzzing` tries more


@pytest.mark.parametrize("name", TARGETS)
def test_a_reader_accepts_its_format_and_refuses_damage_by_an_input_error(name):
    assert check(name, TARGETS[name].seed)
    run(name, EXAMPLES, derandomize=True)


def test_the_files_of_fuzzing_are_removed_at_the_end(tmp_path):
    code = "import fuzzing; fuzzing.check('tum', b''); print(fuzzing.ROOT)"
    environment = {**os.environ, "TMPDIR": str(tmp_path), "TEMP": str(tmp_path)}
    run = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parent, env=environment, stdout=subprocess.PIPE, check=True
    )
    assert Path(run.stdout.decode().strip()).parent == tmp_path
    assert not list(tmp_path.glob("fuzzing-*"))

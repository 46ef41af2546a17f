"""Open3D's windows on a virtual screen, with mouse and keyboard by xdotool."""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).parents[1]
pytestmark = pytest.mark.skipif(
    not (shutil.which("Xvfb") and shutil.which("xdotool")),
    reason="no virtual screen here: `apt install xvfb xdotool` brings one",
)

WINDOWS = """
import json
import numpy as np
from zsp_lite.labelling.desktop import pick_in_window, show_in_window

grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 300)] * 2), -1).reshape(-1, 2)
wall = np.column_stack([grid, np.zeros(len(grid))])
picked = pick_in_window((wall, np.full(wall.shape, 128, np.uint8)), "keypoints of a wall")
show_in_window(wall, wall + (0, 0, 0.1), "two walls")
print(json.dumps(wall[picked].tolist()))
"""


@pytest.fixture
def screen(tmp_path):
    """Environment variables of a program on a virtual screen."""
    listen, tell = os.pipe()
    command = ["Xvfb", "-displayfd", str(tell), "-screen", "0", "1400x1000x24", "-noreset"]
    with open(tmp_path / "screen.log", "w") as log, os.fdopen(listen) as number:
        server = subprocess.Popen(command, pass_fds=[tell], stderr=log)
        os.close(tell)
        display = number.readline().strip()
    yield os.environ | {"DISPLAY": f":{display}", "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": str(REPOSITORY)}
    server.terminate()
    server.wait(timeout=60)


@pytest.mark.slow
def test_clicks_in_the_window_pick_points_and_remove_picks(screen):
    def act(*words):
        subprocess.run(["xdotool", *map(str, words)], env=screen, timeout=180, check=True, stdout=subprocess.DEVNULL)
        time.sleep(0.5)  # events in quick succession are lost

    def shift_click(button):
        act("keydown", "shift")
        act("click", button)
        act("keyup", "shift")

    program = subprocess.Popen([sys.executable, "-c", WINDOWS], env=screen, stdout=subprocess.PIPE, text=True)
    try:
        act("search", "--sync", "--onlyvisible", "--name", "keypoints of a wall")
        time.sleep(2)  # until the window is drawn
        for x, y in ((560, 400), (800, 400), (800, 600), (700, 500)):
            act("mousemove", x, y)
            shift_click(1)
        shift_click(3)
        act("key", "q")
        act("search", "--sync", "--onlyvisible", "--name", "two walls")
        time.sleep(2)
        act("key", "q")
        said, _ = program.communicate(timeout=120)
    finally:
        program.kill()
    left, right, below = json.loads(said.splitlines()[-1])  # the fourth pick was removed
    assert left[0] < right[0] - 0.2 and abs(left[1] - right[1]) < 0.1
    assert below[1] < right[1] - 0.2 and abs(below[0] - right[0]) < 0.1

"""tools/speed.py: the made-up category that it opens, and its medians."""

import itertools

from tools import speed
from zsp_lite.data.co3d import Co3D


def test_the_category_that_is_opened_has_sequences_of_a_hundred_frames(tmp_path):
    speed.write_category(tmp_path, 250)
    frames = Co3D(tmp_path).frame_list("category")
    assert len(frames) == 250 and len({frame.sequence_name for frame in frames}) == 3


def test_the_first_call_is_not_in_the_median(monkeypatch):
    ticks = iter(itertools.accumulate([0, 100, 0, 1, 0, 2, 0, 3]))
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(ticks))
    assert speed.seconds(lambda: None, 3) == 2

"""Depth that is not registered to the colours is told by the outlines of given masks."""

import re
from dataclasses import replace

import cv2
import pytest

from zsp_lite import Co3D, Frame
from zsp_lite.course.samples import sample_data
from zsp_lite.importers.registration import misregistration

pytestmark = pytest.mark.slow

SAMPLES = Co3D(sample_data())
# One sequence of each category.
SCANS = [(c, max(SAMPLES.frame_numbers(c))) for c in SAMPLES.categories()]


def moved(frame: Frame, shift: int, scale: float) -> Frame:
    """The frame with depth that is scaled, and shifted to the right."""
    matrix = cv2.getRotationMatrix2D(frame.camera.principal_point, 0, scale)
    matrix[0, 2] += shift
    depth = cv2.warpAffine(frame.depth, matrix, frame.depth.shape[::-1], flags=cv2.INTER_NEAREST)
    return replace(frame, depth=depth)


@pytest.mark.parametrize("scan", SCANS)
def test_the_shift_and_the_scale_of_depth_are_measured(scan):
    frames = [SAMPLES.load(one) for one in SAMPLES.frames(*scan)[::3]]
    assert misregistration(frames) == ""
    # The way back: 15 pixels to the left, measured in steps of 2, or a scale of 1 / 0.8.
    for shift, scale, found in ((15, 1.0, "-1[46], [02].* 1.00"), (0, 0.8, "0, [024].* 1.25")):
        line = misregistration([moved(frame, shift, scale) for frame in frames])
        assert re.search(f"moved by about {found}", line)
    # Depth of the object alone has no step at the outline.
    assert misregistration([replace(one, depth=one.depth * one.mask) for one in frames]) == ""

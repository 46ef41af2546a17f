"""Contact sheet of the candidate sequences for labelling, with their quality scores."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.data.annotations import SequenceAnnotation
from zsp_lite.data.co3d import Co3D
from zsp_lite.errors import InputError
from zsp_lite.views import object_crop

_VIEWS = 4  # of a sequence
_SIDE = 128  # pixels of a thumbnail


def contact_sheet(dataset: Co3D, category: str, sequences: Sequence[SequenceAnnotation]) -> Figure:
    """Draw one row of evenly spaced frames per sequence, with its quality scores; InputError if there is none."""
    if not sequences:
        raise InputError(f"no sequence of {category} is given, expected some; Co3D.select needs quality scores")
    size = 1.5 * _VIEWS + 2.4, 1.5 * len(sequences)
    figure, axes = plt.subplots(len(sequences), _VIEWS, figsize=size, squeeze=False, layout="constrained")
    for row, sequence in zip(axes, sequences, strict=True):
        frames = dataset.frames(category, sequence.sequence_name)
        chosen = np.linspace(0, len(frames), _VIEWS, endpoint=False).astype(int)
        for axis, index in zip(row, chosen, strict=True):
            axis.imshow(object_crop(dataset.load(frames[index]), _SIDE).rgb)
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(_scores(sequence), rotation=0, ha="right", va="center", fontsize=8)
    return figure


def _scores(sequence: SequenceAnnotation) -> str:
    cloud = None if sequence.point_cloud is None else sequence.point_cloud.quality_score
    numbers = ["–" if score is None else f"{score:.2f}" for score in (cloud, sequence.viewpoint_quality_score)]
    return f"{sequence.sequence_name}\ncloud {numbers[0]}\nviews {numbers[1]}"

"""Contact sheet of the candidate sequences for labelling, with their quality scores."""

from collections.abc import Sequence

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from zsp_lite.data.annotations import SequenceAnnotation
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import crop_to_object, resize_frame

_SIDE = 128  # pixels of a thumbnail


def contact_sheet(dataset: Co3D, category: str, sequences: Sequence[SequenceAnnotation], views: int = 4) -> Figure:
    """Draw one row of evenly spaced frames per sequence, with its quality scores."""
    figure, axes = plt.subplots(
        len(sequences), views, figsize=(1.5 * views + 2.4, 1.5 * len(sequences)), squeeze=False, layout="constrained"
    )
    for row, sequence in zip(axes, sequences):
        frames = dataset.frames(category, sequence.sequence_name)
        chosen = np.linspace(0, len(frames), views, endpoint=False).astype(int)
        for axis, index in zip(row, chosen):
            frame = dataset.load(frames[index])
            crop = crop_to_object(frame) if frame.mask is not None and frame.mask.any() else frame
            axis.imshow(resize_frame(crop, (_SIDE, _SIDE)).rgb)
            axis.set(xticks=[], yticks=[])
        row[0].set_ylabel(_scores(sequence), rotation=0, ha="right", va="center", fontsize=8)
    return figure


def _scores(sequence: SequenceAnnotation) -> str:
    cloud = None if sequence.point_cloud is None else sequence.point_cloud.quality_score
    numbers = ["–" if score is None else f"{score:.2f}" for score in (cloud, sequence.viewpoint_quality_score)]
    return f"{sequence.sequence_name}\ncloud {numbers[0]}\nviews {numbers[1]}"

"""Transfer of pose labels from CO3D v1 to v2, where the sequences have other world coordinates."""

from pathlib import Path

import numpy as np

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, check_one_reference, label_bytes, label_folder, read_labels, rigid_label
from zsp_lite.data.published import write_all
from zsp_lite.errors import InputError

_MAX_RESIDUAL = 0.05  # above it, the camera centres of v1 and v2 are not related by a similarity
_MIN_CAMERAS = 4


def transfer_labels(source: str | Path, target: str | Path, category: str, replace: bool = False) -> dict[str, float]:
    """Transfer the labels of a category from a folder of CO3D v1 to one of v2, and return each sequence's residual.

    For each sequence, the camera centres of the frames in both data sets are aligned by Umeyama's method with scale;
    the residual is their RMS distance over their RMS distance from their mean. Nothing is written if one is above 0.05.
    """
    labels, old, new = read_labels(source, category), Co3D(source), Co3D(target)
    if not labels:
        raise InputError(f"{source} has no labels of category {category}, expected class_labels/{category}/SEQ.json")
    reference = next(iter(labels.values())).reference_seq
    worlds, residuals = {}, {}
    for name in dict.fromkeys([reference, *labels]):
        worlds[name], residuals[name] = align_worlds(old, new, category, name)
        if residuals[name] > _MAX_RESIDUAL:
            raise InputError(
                f"sequence {category}/{name}: camera centres differ by {residuals[name]:.3f} of their spread after "
                f"alignment, expected at most {_MAX_RESIDUAL:g}"
            )
    centre = new.point_cloud(category, reference)[0].mean(axis=0)
    transferred = {}
    for name, label in labels.items():
        similarity = worlds[name] @ Sim3(1.0, label.trans[:3, :3], label.trans[:3, 3]) @ worlds[reference].inverse()
        moved = rigid_label(similarity, centre, name, reference)
        transferred[name] = PoseLabel(np.eye(4), name, reference) if name == reference else moved
    folder = label_folder(target, category)
    check_one_reference(read_labels(target, category) | transferred, folder)
    write_all({folder / f"{name}.json": label_bytes(label) for name, label in transferred.items()}, replace)
    return residuals


def align_worlds(old: Co3D, new: Co3D, category: str, sequence: str) -> tuple[Sim3, float]:
    """Compute the similarity from a sequence's world in `old` to that in `new`, and its residual."""
    centres = [
        {one.frame_number: data.camera(one).centre for one in data.frames(category, sequence) if one.viewpoint}
        for data in (old, new)
    ]
    common = sorted(centres[0].keys() & centres[1].keys())
    if len(common) < _MIN_CAMERAS:
        raise InputError(
            f"sequence {category}/{sequence}: {len(common)} frames have cameras in both data sets, "
            f"expected at least {_MIN_CAMERAS}"
        )
    first, second = (np.array([one[number] for number in common]) for one in centres)
    sim3 = umeyama(first, second)
    distance = np.square(sim3.apply(first) - second).sum(axis=1).mean()
    return sim3, float(np.sqrt(distance / np.square(second - second.mean(axis=0)).sum(axis=1).mean()))

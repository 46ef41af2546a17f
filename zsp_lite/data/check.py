"""Check of a data folder: missing and broken files, sequences that can be evaluated, size
on disk."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tqdm import tqdm

from zsp_lite.data.annotations import SEQUENCES_FILE, FrameAnnotation
from zsp_lite.data.cameras import NDC_ISOTROPIC
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import frame_defect
from zsp_lite.data.labels import read_labels
from zsp_lite.data.pairs import pair_files, read_published_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import path_inside

# A sequence can be evaluated with two usable frames: one as a reference, one as a target.
_LEAST_FRAMES = 2


@dataclass
class CategoryCheck:
    """Result of the check of a category."""

    category: str
    layout: str = "v1"  # or "v2"
    sequences: int = 0  # annotated ones
    frames: int = 0  # annotated ones
    complete: int = 0  # sequences without problems
    absent: int = 0  # sequences without any file; counted in a `partial` folder alone
    labelled: int = 0  # sequences with a label
    # Labelled sequences that can be evaluated: at least two frames have image, mask, depth and
    # camera, and no defect.
    usable: int = 0
    cloudless: int = 0  # sequences without a point cloud, in the annotations or on the disk
    # Frames with each `frames.frame_defect`, such as "black image"; counted by a deep check alone.
    defects: Counter[str] = field(default_factory=Counter)
    pairs: int = 0  # valid files of evaluation pairs
    size: int = 0  # of all annotated files, bytes
    problems: list[str] = field(default_factory=list)  # messages, one line each

    def attempt(self, function: Callable, *values: object) -> Any:
        """Call a function; return None, and list the message as a problem, for an InputError."""
        try:
            return function(*values)
        except InputError as error:
            self.problems.append(str(error))
            return None


def check_folder(
    root: str | Path,
    deep: bool = False,
    categories: Sequence[str] | None = None,
    partial: bool = False,
) -> list[CategoryCheck]:
    """Check some or all categories of a data folder, sorted by name.

    A `deep` check also decodes every image, mask, depth map and point cloud, which is slow on large
    folders; otherwise the files must exist and not be empty. If `partial`, a sequence without any
    file is counted, and is not a problem.
    """
    dataset = Co3D(root)
    chosen = sorted(set(dataset.categories() if categories is None else categories))
    if not chosen:
        raise InputError(
            f"data folder {root} holds no category, expected CATEGORY/frame_annotations.jgz"
        )
    return [
        _check_category(dataset, name, deep, partial)
        for name in tqdm(chosen, "checking", disable=None)
    ]


def _check_category(dataset: Co3D, category: str, deep: bool, partial: bool) -> CategoryCheck:
    """Check one category (see `check_folder`)."""
    check = CategoryCheck(category)
    keys = check.attempt(dataset.frame_list, category)
    sequences = check.attempt(dataset.sequences, category)
    if keys is None or sequences is None:
        return check
    listed = {sequence.sequence_name: sequence for sequence in sequences}
    names = list(dict.fromkeys(key.sequence_name for key in keys))
    check.sequences = len(names)
    check.frames = len(keys)
    for name in sorted(listed.keys() - names):
        check.problems.append(f"sequence {name} has no frames in the annotations")

    # The files of each sequence.
    usable = set()
    for name in names:
        if partial and not (dataset.root / category / name).exists():
            check.absent += 1
            continue
        problems_before = len(check.problems)
        usable_frames = 0
        for frame in check.attempt(dataset.frames, category, name) or []:
            usable_frames += _check_frame(dataset, frame, deep, check)
            if frame.viewpoint and frame.viewpoint.intrinsics_format == NDC_ISOTROPIC:
                check.layout = "v2"
        if usable_frames >= _LEAST_FRAMES:
            usable.add(name)
        if name in listed:
            cloud = listed[name].point_cloud
            if cloud is None or not _check_file(dataset, cloud.path, check):
                check.cloudless += 1
            elif deep:
                check.attempt(dataset.point_cloud, category, name)
        else:
            check.problems.append(f"sequence {name} is not in {SEQUENCES_FILE}")
        if len(check.problems) == problems_before:
            check.complete += 1

    # Labels and evaluation pairs.
    labels = check.attempt(read_labels, dataset.root, category) or {}
    check.labelled = len(labels)
    check.usable = len(set(labels) & usable)
    for name in sorted(labels.keys() - names):
        check.problems.append(f"label of {name} is of a sequence that is not in the annotations")
    for path in pair_files(dataset, category):
        if check.attempt(read_published_pairs, path, dataset) is not None:
            check.pairs += 1
    return check


def _check_frame(
    dataset: Co3D, annotation: FrameAnnotation, deep: bool, check: CategoryCheck
) -> bool:
    """Check the files and the camera of a frame; return whether its pose can be estimated."""
    depth = annotation.depth
    mask = annotation.mask
    paths = [file.path for file in (annotation.image, mask, depth) if file]
    if depth and depth.mask_path:
        paths.append(depth.mask_path)
    # A list, so that the files after a missing one are checked, too.
    has_files = all([_check_file(dataset, path, check) for path in paths])
    if annotation.viewpoint is None or not has_files:
        return False
    has_depth_and_mask = depth is not None and mask is not None
    if not deep:
        return check.attempt(dataset.camera, annotation) is not None and has_depth_and_mask
    frame = check.attempt(dataset.load, annotation)
    if frame is None:
        return False
    defect = frame_defect(frame)
    if defect:
        check.defects[defect] += 1
    return not defect and has_depth_and_mask


def _check_file(dataset: Co3D, relative: str, check: CategoryCheck) -> bool:
    """Return whether a file exists and is not empty; add its size or the problem to `check`."""
    path = check.attempt(path_inside, dataset.root, relative)
    if path is None:
        return False
    size = path.stat().st_size if path.is_file() else 0
    check.size += size
    if not size:
        check.problems.append(f"{relative} is {'empty' if path.exists() else 'missing'}")
    return size > 0

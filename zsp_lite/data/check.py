"""Check of a data folder: missing and broken files, sequences that can be evaluated, size on disk."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from zsp_lite.data.annotations import SEQUENCES_FILE, FrameAnnotation
from zsp_lite.data.cameras import NDC_ISOTROPIC
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.frames import frame_defect
from zsp_lite.data.labels import label_folder, read_label_files
from zsp_lite.data.pairs import read_upstream_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import path_inside

_MIN_FRAMES = 2  # complete frames of a sequence that can be evaluated


@dataclass
class CategoryCheck:
    """Result of the check of a category.

    Attributes:
        category: Name of the category.
        layout: "v1", "v2" or "mixed".
        sequences: Number of annotated sequences.
        frames: Number of annotated frames.
        complete: Number of sequences without problems.
        absent: Number of annotated sequences without any file, in a folder that was downloaded in part.
        labelled: Number of sequences with a label.
        usable: Number of labelled sequences that can be evaluated: at least two frames have image, mask, depth and
            camera, and in a deep check no defect.
        defects: Number of frames with each `frames.frame_defect`, such as a black image; counted by a deep check alone.
        pairs: Number of valid files of evaluation pairs.
        size: Total size of the annotated files, bytes.
        problems: Messages, one line each.
    """

    category: str
    layout: str = "v1"
    sequences: int = 0
    frames: int = 0
    complete: int = 0
    absent: int = 0
    labelled: int = 0
    usable: int = 0
    defects: Counter[str] = field(default_factory=Counter)
    pairs: int = 0
    size: int = 0
    problems: list[str] = field(default_factory=list)


def check_folder(
    root: str | Path,
    deep: bool = False,
    progress: Callable[[Iterable], Iterable] | None = None,
    categories: Sequence[str] | None = None,
    partial: bool = False,
) -> list[CategoryCheck]:
    """Check the categories of a data folder.

    Args:
        root: The data folder.
        deep: Also decode every image, mask, depth map and point cloud, which is slow on large folders. Otherwise only
            check that the files exist and are not empty.
        progress: Wraps the list of categories to show a progress bar, such as `tqdm`.
        categories: Names of the categories to check; all by default.
        partial: An annotated sequence without any file is counted, and is not a problem.

    Returns:
        One result per category, sorted by name.

    Raises:
        InputError: `root` is not a folder or has no such category. All other problems are in the results.
    """
    dataset = Co3D(root)
    found = dataset.categories()
    if not found:
        raise InputError(f"data folder {root} holds no category, expected CATEGORY/frame_annotations.jgz")
    if unknown := sorted(set(categories or ()) - set(found)):
        raise InputError(f"category {unknown[0]!r} is not in {root}, which has {', '.join(found)}")
    chosen = found if categories is None else sorted(set(categories))
    return [_check_category(dataset, category, deep, partial) for category in (progress or iter)(chosen)]


def _check_category(dataset: Co3D, category: str, deep: bool, partial: bool) -> CategoryCheck:
    check = CategoryCheck(category)
    try:
        sequences = {one.sequence_name: one for one in dataset.sequences(category)}
        keys = dataset.frame_list(category)
    except InputError as error:
        check.problems.append(str(error))
        return check
    names = list(dict.fromkeys(key.sequence_name for key in keys))
    check.sequences, check.frames = len(names), len(keys)
    for name in sorted(set(sequences) - set(names)):
        check.problems.append(f"sequence {name} has no frames in the annotations")
    layouts, usable = set(), set()
    for name in names:
        if partial and not (dataset.root / category / name).exists():
            check.absent += 1
            continue
        problems, complete_frames = [], 0
        try:
            annotations = dataset.frames(category, name)
        except InputError as error:
            check.problems.append(str(error))
            continue
        for annotation in annotations:
            found, defect = _check_frame(dataset, annotation, deep, check)
            whole = None not in (annotation.viewpoint, annotation.depth, annotation.mask)
            complete_frames += whole and not found and not defect
            problems += found
            if annotation.viewpoint is not None:
                layouts.add("v2" if annotation.viewpoint.intrinsics_format == NDC_ISOTROPIC else "v1")
        if name not in sequences:
            problems.append(f"sequence {name} is not in {SEQUENCES_FILE}")
        elif (cloud := sequences[name].point_cloud) is not None:
            found = _check_file(dataset, cloud.path, check)
            problems += found
            if not found and deep:
                try:
                    dataset.point_cloud(category, name)
                except InputError as error:
                    problems.append(str(error))
        check.complete += not problems
        check.problems += problems
        if complete_frames >= _MIN_FRAMES:
            usable.add(name)
    check.layout = "mixed" if len(layouts) > 1 else next(iter(layouts), "v1")
    _check_labels(dataset, check, set(names), usable)
    return check


def _check_labels(dataset: Co3D, check: CategoryCheck, annotated: set[str], usable: set[str]) -> None:
    try:
        labels = read_label_files(dataset.root, check.category)
    except InputError as error:
        check.problems.append(str(error))
        labels = {}
    check.labelled, check.usable = len(labels), len(set(labels) & usable)
    folder = label_folder(dataset.root, check.category)
    for name in sorted(set(labels) - annotated):
        check.problems.append(f"label {folder / name}.json is of a sequence that is not in the annotations")
    references = {label.reference_seq for label in labels.values()}
    if len(references) > 1:
        check.problems.append(f"labels in {folder} have references {', '.join(sorted(references))}, expected one")
    # No recursive pattern: the folder may hold millions of files.
    patterns = (f"{part}determ_eval/*/{check.category}.pt" for part in ("", "data/"))
    for path in (path for pattern in patterns for path in sorted(dataset.root.glob(pattern))):
        try:
            read_upstream_pairs(path, dataset)
            check.pairs += 1
        except InputError as error:
            check.problems.append(str(error))


def _check_frame(dataset: Co3D, annotation: FrameAnnotation, deep: bool, check: CategoryCheck) -> tuple[list[str], str]:
    """Return the problems of a frame's files and camera, and in a deep check its defect, which is counted."""
    paths = [annotation.image.path]
    paths += [annotation.mask.path] if annotation.mask else []
    if annotation.depth:
        paths += [path for path in (annotation.depth.path, annotation.depth.mask_path) if path]
    problems = [problem for path in paths for problem in _check_file(dataset, path, check)]
    if problems or annotation.viewpoint is None:
        return problems, ""
    try:
        defect = frame_defect(dataset.load(annotation)) if deep else ""
        dataset.camera(annotation)
    except InputError as error:
        return [str(error)], ""
    check.defects.update([defect] if defect else [])
    return [], defect


def _check_file(dataset: Co3D, relative: str, check: CategoryCheck) -> list[str]:
    """Return the problems of a file, and add its size to `check`."""
    try:
        path = path_inside(dataset.root, relative)
    except InputError as error:
        return [str(error)]
    if not path.is_file():
        return [f"{relative} is missing"]
    size = path.stat().st_size
    check.size += size
    return [] if size else [f"{relative} is empty"]

"""Labels from elsewhere: the published code's, and their transfer from CO3D v1 to v2's worlds."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import (
    PoseLabel,
    check_one_reference,
    label_folder,
    read_label,
    read_label_files,
    read_labels,
)
from zsp_lite.data.pairs import read_pair_file
from zsp_lite.data.writing import label_bytes, rigid_label
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

# With a larger residual, the camera centres of v1 and v2 are not related by a similarity.
_MAX_RESIDUAL = 0.05
# A similarity fits three centres well, whatever they are: a fourth one tests it.
_MIN_CAMERAS = 4


def import_labels(
    source: Path, root: Path, replace: bool = False, categories: Sequence[str] | None = None
) -> dict[str, int]:
    """Import labels and evaluation pairs from a clone of the published repository.

    Returns the numbers of files by kind. Without `replace`, existing files of other content are an
    InputError. Nothing is written if a file is damaged.
    """
    Co3D(root)  # raises InputError if there is no such folder
    sources = {}  # for each path where a file is written: the path where it is read
    for category, labels in _published_labels(source, categories).items():
        folder = label_folder(root, category)
        added = {label.seq: label for label in labels.values()}
        check_one_reference(folder, read_label_files(folder) | added)
        for path in labels:
            sources[folder / path.name] = path
    for path in sorted(source.glob("**/determ_eval/*/*.pt")):
        if categories is None or path.stem in categories:
            read_pair_file(path)
            sources[Path(root, "determ_eval", path.parent.name, path.name)] = path
    if not sources:
        raise _no_labels(source, "CATEGORY" if categories is None else " or ".join(categories))
    write_all({target: read_bytes(path, "file") for target, path in sources.items()}, replace)
    pairs = sum(path.suffix == ".pt" for path in sources)
    return {"class_labels": len(sources) - pairs, "determ_eval": pairs}


def published_sequences(source: Path, categories: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """List the labelled sequences of each category in a clone; InputError if one has none."""
    labels = _published_labels(source, categories)
    for category in categories:
        if category not in labels:
            raise _no_labels(source, category)
    sequences = {}
    for category, by_path in labels.items():
        pairs = [(label.seq, label.reference_seq) for label in by_path.values()]
        sequences[category] = tuple(sorted(set().union(*pairs)))
    return sequences


def write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, none if one exists with other content (InputError)."""
    for path, data in files.items():
        if path.exists() and read_bytes(path, "file") != data and not replace:
            raise InputError(
                f"{path} would be replaced by other content, expected --replace to do so"
            )
    for path, data in files.items():
        write_atomic(path, data)


def _published_labels(
    source: Path, categories: Sequence[str] | None
) -> dict[str, dict[Path, PoseLabel]]:
    """Read the labels of a clone by category and path."""
    labels: dict[str, dict[Path, PoseLabel]] = {}
    for path in sorted(source.glob("**/class_labels/*/*.json")):
        category = path.parent.name
        if categories is None or category in categories:
            labels.setdefault(category, {})[path] = read_label(path)
    return labels


def _no_labels(source: Path, category: str) -> InputError:
    """Make the error for a clone without labels."""
    return InputError(
        f"{source} holds no class_labels/{category}/SEQ.json, expected a clone of the "
        "published code"
    )


def transfer_labels(
    source: str | Path, target: str | Path, category: str, replace: bool = False
) -> dict[str, float]:
    """Transfer the labels of a category from CO3D v1 to v2; return each sequence's residual.

    A sequence has another world in v2 than in v1. The camera centres in both worlds are aligned by
    Umeyama's method with scale. The residual is the RMS distance of aligned centres, divided by the
    RMS distance of the centres from their mean. Nothing is written if a residual is above 0.05.
    """
    labels = read_labels(source, category)
    old = Co3D(source)
    new = Co3D(target)
    if not labels:
        raise InputError(
            f"{source} has no labels of category {category}, expected "
            f"class_labels/{category}/SEQ.json"
        )

    # For each sequence, the similarity from its world in v1 to its world in v2.
    reference = next(iter(labels.values())).reference_seq
    worlds = {}
    residuals = {}
    for name in dict.fromkeys([reference, *labels]):
        worlds[name], residuals[name] = align_worlds(old, new, category, name)
        if residuals[name] > _MAX_RESIDUAL:
            raise InputError(
                f"sequence {category}/{name}: camera centres differ by {residuals[name]:.3f} "
                f"of their spread after alignment, expected at most {_MAX_RESIDUAL:g}"
            )

    # A label in v2 leads from the reference's world in v2 to its world in v1, by the label of v1 to
    # the sequence's world in v1, and to the sequence's world in v2.
    points, _ = new.point_cloud(category, reference)
    centre = points.mean(axis=0)
    transferred = {}
    for name, label in labels.items():
        similarity = (
            worlds[name]
            @ Sim3(1.0, label.trans[:3, :3], label.trans[:3, 3])
            @ worlds[reference].inverse()
        )
        transferred[name] = rigid_label(similarity, centre, name, reference)
        if name == reference:  # the exact identity, without rounding errors
            transferred[name] = PoseLabel(np.eye(4), name, reference)

    folder = label_folder(target, category)
    check_one_reference(folder, read_label_files(folder) | transferred)
    write_all(
        {folder / f"{name}.json": label_bytes(label) for name, label in transferred.items()},
        replace,
    )
    return residuals


def align_worlds(old: Co3D, new: Co3D, category: str, sequence: str) -> tuple[Sim3, float]:
    """Compute the similarity between a sequence's worlds in `old` and `new`, and its residual."""
    old_centres = _camera_centres(old, category, sequence)
    new_centres = _camera_centres(new, category, sequence)
    common = sorted(old_centres.keys() & new_centres.keys())
    if len(common) < _MIN_CAMERAS:
        raise InputError(
            f"sequence {category}/{sequence}: {len(common)} frames have cameras in both data sets, "
            f"expected at least {_MIN_CAMERAS}"
        )
    old_points = np.array([old_centres[number] for number in common])
    new_points = np.array([new_centres[number] for number in common])
    sim3 = umeyama(old_points, new_points)
    distance = np.square(sim3.apply(old_points) - new_points).sum(axis=1).mean()
    spread = np.square(new_points - new_points.mean(axis=0)).sum(axis=1).mean()
    return sim3, float(np.sqrt(distance / spread))


def _camera_centres(
    dataset: Co3D, category: str, sequence: str
) -> dict[int, Float[np.ndarray, "3"]]:
    """Return the centres of a sequence's known cameras by frame number."""
    return {
        frame.frame_number: dataset.camera(frame).centre
        for frame in dataset.frames(category, sequence)
        if frame.viewpoint
    }

"""Labels from elsewhere: those of the published code, and their transfer from CO3D v1 to the worlds
of v2."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import (
    PoseLabel,
    label_bytes,
    label_folder,
    read_label,
    read_label_folder,
    rigid_label,
)
from zsp_lite.data.pairs import read_pair_file
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

_MAX_RESIDUAL = 0.05  # above it, the camera centres of v1 and v2 are not related by a similarity
_MIN_CAMERAS = 4


def import_labels(
    source: Path, root: Path, replace: bool = False, categories: Sequence[str] | None = None
) -> dict[str, int]:
    """Import labels and evaluation pairs from a clone of the published repository, and return their
    numbers by kind.

    Without `replace`, existing files of other content are an InputError. Nothing is written if a
    file is damaged.
    """
    Co3D(root)  # raises InputError if there is no such folder
    sources = {}
    for category, labels in _published_labels(source, categories).items():
        folder = label_folder(root, category)
        # This checks that they fit together.
        read_label_folder(folder, added={one.seq: one for one in labels.values()})
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
    """List the labelled sequences of each category in a clone; InputError if a category has
    none."""
    labels = _published_labels(source, categories)
    for category in categories:
        if category not in labels:
            raise _no_labels(source, category)
    return {
        category: tuple(
            sorted({name for label in found.values() for name in (label.seq, label.reference_seq)})
        )
        for category, found in labels.items()
    }


def write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, InputError and none is written if one exists with other
    content."""
    conflicts = [
        path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data
    ]
    if conflicts and not replace:
        raise InputError(
            f"{conflicts[0]} would be replaced by other content, expected --replace to do so"
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
    return InputError(
        f"{source} holds no class_labels/{category}/SEQ.json, expected a clone of the "
        "published code"
    )


def transfer_labels(
    source: str | Path, target: str | Path, category: str, replace: bool = False
) -> dict[str, float]:
    """Transfer the labels of a category from CO3D v1 to v2, whose worlds are others; return each
    sequence's residual.

    The camera centres in both are aligned by Umeyama's method with scale; the residual is their RMS
    distance over their RMS distance from their mean. Nothing is written if one is above 0.05.
    """
    labels, old, new = read_label_folder(label_folder(source, category)), Co3D(source), Co3D(target)
    if not labels:
        raise InputError(
            f"{source} has no labels of category {category}, expected "
            f"class_labels/{category}/SEQ.json"
        )
    reference = next(iter(labels.values())).reference_seq
    worlds, residuals = {}, {}
    for name in dict.fromkeys([reference, *labels]):
        worlds[name], residuals[name] = align_worlds(old, new, category, name)
        if residuals[name] > _MAX_RESIDUAL:
            raise InputError(
                f"sequence {category}/{name}: camera centres differ by {residuals[name]:.3f} "
                f"of their spread after alignment, expected at most {_MAX_RESIDUAL:g}"
            )
    centre = new.point_cloud(category, reference)[0].mean(axis=0)
    transferred = {}
    for name, label in labels.items():
        similarity = (
            worlds[name]
            @ Sim3(1.0, label.trans[:3, :3], label.trans[:3, 3])
            @ worlds[reference].inverse()
        )
        moved = rigid_label(similarity, centre, name, reference)
        transferred[name] = PoseLabel(np.eye(4), name, reference) if name == reference else moved
    folder = label_folder(target, category)
    read_label_folder(folder, added=transferred)  # checks that they fit together
    write_all(
        {folder / f"{name}.json": label_bytes(label) for name, label in transferred.items()},
        replace,
    )
    return residuals


def align_worlds(old: Co3D, new: Co3D, category: str, sequence: str) -> tuple[Sim3, float]:
    """Compute the similarity from a sequence's world in `old` to that in `new`, and its
    residual."""
    centres = [
        {
            one.frame_number: data.camera(one).centre
            for one in data.frames(category, sequence)
            if one.viewpoint
        }
        for data in (old, new)
    ]
    common = sorted(centres[0].keys() & centres[1].keys())
    if len(common) < _MIN_CAMERAS:
        raise InputError(
            f"sequence {category}/{sequence}: {len(common)} frames have cameras in both data sets, "
            f"expected at least {_MIN_CAMERAS}"
        )
    first, second = np.array([[one[number] for number in common] for one in centres])
    sim3 = umeyama(first, second)
    distance = np.square(sim3.apply(first) - second).sum(axis=1).mean()
    spread = np.square(second - second.mean(axis=0)).sum(axis=1).mean()
    return sim3, float(np.sqrt(distance / spread))

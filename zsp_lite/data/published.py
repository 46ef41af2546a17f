"""Import of the labels and evaluation pairs of the published code."""

from collections.abc import Sequence
from pathlib import Path

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, check_one_reference, label_folder, read_label, read_labels
from zsp_lite.data.pairs import read_pair_file
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic


def import_labels(
    source: Path, root: Path, replace: bool = False, categories: Sequence[str] | None = None
) -> dict[str, int]:
    """Import labels and evaluation pairs from a clone of the published repository, and return their numbers by kind.

    These are the files class_labels/CATEGORY/SEQ.json and determ_eval/SET/CATEGORY.pt at any depth of the clone. All
    files are checked before the first is written, and code in them is not executed. Without `replace`, existing files
    of other content are an InputError.
    """
    Co3D(root)  # raises InputError if there is no such folder
    sources = {}
    for category, labels in _published_labels(source, categories).items():
        folder = label_folder(root, category)
        check_one_reference(read_labels(root, category) | {one.seq: one for one in labels.values()}, folder)
        sources |= {folder / path.name: path for path in labels}
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
    """List the labelled sequences of each category in a clone; InputError if a category has none."""
    labels = _published_labels(source, categories)
    for category in categories:
        if category not in labels:
            raise _no_labels(source, category)
    return {
        category: tuple(sorted({name for label in found.values() for name in (label.seq, label.reference_seq)}))
        for category, found in labels.items()
    }


def write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, InputError and none is written if one exists with other content."""
    conflicts = [path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data]
    if conflicts and not replace:
        raise InputError(f"{conflicts[0]} would be replaced by other content, expected --replace to do so")
    for path, data in files.items():
        write_atomic(path, data)


def _published_labels(source: Path, categories: Sequence[str] | None) -> dict[str, dict[Path, PoseLabel]]:
    """Read the labels of a clone by category and path."""
    labels: dict[str, dict[Path, PoseLabel]] = {}
    for path in sorted(source.glob("**/class_labels/*/*.json")):
        category = path.parent.name
        if categories is None or category in categories:
            labels.setdefault(category, {})[path] = read_label(path)
    return labels


def _no_labels(source: Path, category: str) -> InputError:
    return InputError(f"{source} holds no class_labels/{category}/SEQ.json, expected a clone of the published code")

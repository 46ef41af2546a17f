"""Import of the labels and evaluation pairs of the published code."""

from collections.abc import Sequence
from pathlib import Path

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, check_one_reference, label_folder, parse_label, read_labels
from zsp_lite.data.pairs import parse_published_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, write_atomic

_EXTENSIONS = {"class_labels": ".json", "determ_eval": ".pt"}  # by folder


def import_labels(
    source: Path, root: Path, replace: bool = False, categories: Sequence[str] | None = None
) -> dict[str, int]:
    """Import labels and evaluation pairs from a clone of the published repository, and return their numbers by kind.

    These are the files class_labels/CATEGORY/SEQ.json and determ_eval/SET/CATEGORY.pt at any depth of the clone. All
    files are checked before the first is written, and code in them is not executed. Without `replace`, existing files
    of other content are an InputError.
    """
    Co3D(root)  # raises InputError if there is no such folder
    files, labels = _read_published(source, categories)
    for category, imported in labels.items():
        check_one_reference(read_labels(root, category) | imported, label_folder(root, category))
    targets = {
        (label_folder(root, group) if kind == "class_labels" else Path(root, kind, group)) / name: data
        for (kind, group, name), data in files.items()
    }
    write_all(targets, replace)
    kinds = [kind for kind, *_ in files]
    return {kind: kinds.count(kind) for kind in _EXTENSIONS}


def published_sequences(source: Path, categories: Sequence[str] | None = None) -> dict[str, list[str]]:
    """List the labelled sequences of each category in a clone of the published repository."""
    labels = _read_published(source, categories)[1]
    return {
        category: sorted({*found, *(label.reference_seq for label in found.values())})
        for category, found in labels.items()
    }


def write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, InputError and none is written if one exists with other content."""
    conflicts = [path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data]
    if conflicts and not replace:
        raise InputError(f"{conflicts[0]} would be replaced by other content, expected --replace to do so")
    for path, data in files.items():
        write_atomic(path, data)


def _read_published(
    source: Path, categories: Sequence[str] | None
) -> tuple[dict[tuple[str, str, str], bytes], dict[str, dict[str, PoseLabel]]]:
    """Return the checked files of a clone by kind, folder and name, and its labels by category and sequence."""
    files, labels = {}, {}
    for kind, extension in _EXTENSIONS.items():
        for path in sorted(source.glob(f"**/{kind}/*/*{extension}")):
            group = path.parent.name
            category = group if kind == "class_labels" else path.stem
            if categories is not None and category not in categories:
                continue
            data = read_bytes(path, "file")
            if kind == "class_labels":
                label = parse_label(data, path)
                labels.setdefault(category, {})[label.seq] = label
            else:
                parse_published_pairs(data, path)
            files[kind, group, path.name] = data
    if not files:
        wanted = "CATEGORY" if categories is None else " or ".join(categories)
        raise InputError(f"{source} holds no class_labels/{wanted}/SEQ.json, expected a clone of the published code")
    return files, labels

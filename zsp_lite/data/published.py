"""Import of the labels and evaluation pairs of the published code."""

import io
import tarfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, check_one_reference, label_folder, parse_label, read_labels
from zsp_lite.data.pairs import parse_published_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.files import decompress, growth_limit, plain_name, read_bytes, write_atomic

_EXTENSIONS = {"class_labels": ".json", "determ_eval": ".pt"}  # by folder


def import_labels(
    source: Path, root: Path, replace: bool = False, categories: Sequence[str] | None = None
) -> dict[str, int]:
    """Import pose labels and evaluation pairs of the published code into a data folder.

    Imports the files class_labels/CATEGORY/SEQ.json and determ_eval/SET/CATEGORY.pt at any depth of the source. All
    files are checked before the first is written, and code in them is not executed.

    Args:
        source: A clone of the published repository (a folder), or an archive of it (.zip, .tar, .tar.gz).
        root: The data folder.
        replace: Overwrite existing files of other content.
        categories: Names of the categories to import; all by default.

    Returns:
        Number of imported files by kind, "class_labels" and "determ_eval".
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
    """List the labelled sequences of each category in a source of `import_labels`."""
    labels = _read_published(source, categories)[1]
    return {
        category: sorted({*found, *(label.reference_seq for label in found.values())})
        for category, found in labels.items()
    }


def write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, InputError and none is written if one exists with other content."""
    conflicts = [path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data]
    if conflicts and not replace:
        more = f" and {len(conflicts) - 1} more" if len(conflicts) > 1 else ""
        raise InputError(f"{conflicts[0]}{more} would be replaced by other content, expected --replace to do so")
    for path, data in files.items():
        write_atomic(path, data)


def _read_published(
    source: Path, categories: Sequence[str] | None
) -> tuple[dict[tuple[str, str, str], bytes], dict[str, dict[str, PoseLabel]]]:
    """Return the checked files of a source by kind, folder and name, and its labels by category and sequence."""
    files, labels = {}, {}
    for path, data in _read_folder(source) if source.is_dir() else _read_archive(source):
        kind, group, name = path.parts[-3:]
        group, name = plain_name(group, "folder"), plain_name(name, "file")
        category = group if kind == "class_labels" else name.removesuffix(".pt")
        if categories is not None and category not in categories:
            continue
        if kind == "class_labels":
            label = parse_label(data, source / path)
            labels.setdefault(group, {})[label.seq] = label
        else:
            parse_published_pairs(data, source / path)
        files[kind, group, name] = data
    if not files:
        wanted = "CATEGORY" if categories is None else " or ".join(categories)
        raise InputError(f"{source} holds no class_labels/{wanted}/SEQ.json, expected a clone of the published code")
    return files, labels


def _read_folder(folder: Path) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Yield the relative paths and contents of labels and pairs in a folder."""
    for name, extension in _EXTENSIONS.items():
        for path in sorted(folder.glob(f"**/{name}/*/*{extension}")):
            yield PurePosixPath(path.relative_to(folder).as_posix()), read_bytes(path, "file")


def _read_archive(path: Path) -> Iterator[tuple[PurePosixPath, bytes]]:
    """Yield the paths and contents of labels and pairs in an archive; InputError if it is damaged."""
    what = f"archive of labels {path}"
    data = read_bytes(path, "archive of labels")
    limit = growth_limit(len(data))
    if data[:2] == b"\x1f\x8b":
        data = decompress(data, what)
    try:
        if data[:2] == b"PK":
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                members = [member for member in archive.infolist() if _is_wanted(member.filename)]
                if sum(member.file_size for member in members) > limit:
                    raise zipfile.BadZipFile(f"its labels are longer than {limit} bytes")
                for member in members:
                    yield PurePosixPath(member.filename), archive.read(member)
        else:
            with tarfile.open(fileobj=io.BytesIO(data), mode="r:") as archive:
                for member in archive:
                    if member.isfile() and _is_wanted(member.name):
                        yield PurePosixPath(member.name), archive.extractfile(member).read()
    except Exception as error:  # a damaged archive can raise almost any
        raise InputError(f"{what} is damaged or encrypted, expected .zip or .tar.gz ({error})") from error


def _is_wanted(path: str) -> bool:
    """Tell whether a path in an archive is that of a label or of evaluation pairs."""
    parts = PurePosixPath(path).parts
    return len(parts) >= 3 and parts[-3] in _EXTENSIONS and path.endswith(_EXTENSIONS[parts[-3]])

"""Import of published pose labels and evaluation pairs, and transfer of labels from CO3D v1 to v2."""

import hashlib
import io
import tarfile
import zipfile
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.cameras import NDC_ISOTROPIC
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, label_bytes, label_folder, parse_label, read_labels, rigid_label
from zsp_lite.data.pairs import check_upstream_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder, fetch
from zsp_lite.io.files import ARCHIVE_ERRORS, MAX_FILE, decompress, growth_limit, plain_name, read_bytes, write_atomic

# Residual above which the camera centres of v1 and v2 are not related by a similarity.
MAX_RESIDUAL = 0.05
_MIN_CAMERAS = 4
_EXTENSIONS = {"class_labels": ".json", "determ_eval": ".pt"}  # by folder


def import_labels(
    source: str | Path,
    root: str | Path,
    sha256: str | None = None,
    replace: bool = False,
    categories: Sequence[str] | None = None,
) -> dict[str, int]:
    """Import pose labels and evaluation pairs of the published code into a data folder.

    Imports the files class_labels/CATEGORY/SEQ.json and determ_eval/SET/CATEGORY.pt at any depth of the source. All
    files are checked before the first is written, and code in them is not executed.

    Args:
        source: A clone of the published repository (a folder), an archive of it (.zip, .tar, .tar.gz), or the URL of
            an archive.
        root: The data folder.
        sha256: SHA-256 digest of the archive; required for a URL.
        replace: Overwrite existing files of other content.
        categories: Names of the categories to import; all by default.

    Returns:
        Number of imported files by kind, "class_labels" and "determ_eval".

    Raises:
        InputError: The source has no such files or another digest, a file is invalid or would be overwritten, or a
            category would have two reference sequences.
    """
    if not Path(root).is_dir():
        raise InputError(
            f"data folder {root} does not exist, expected a folder with categories in CO3D's layout, as `zsp-lite data "
            "download` or `zsp-lite synth --preset demo --out FOLDER` makes it"
        )
    files, labels = _read_published(source, sha256, categories)
    for category, imported in labels.items():
        _check_one_reference(root, category, imported)
    targets = {
        (label_folder(root, group) if kind == "class_labels" else Path(root, kind, group)) / name: data
        for (kind, group, name), data in files.items()
    }
    _write_all(targets, replace)
    kinds = [kind for kind, *_ in files]
    return {kind: kinds.count(kind) for kind in _EXTENSIONS}


def published_sequences(
    source: str | Path, sha256: str | None = None, categories: Sequence[str] | None = None
) -> dict[str, list[str]]:
    """List the labelled sequences of each category in a source of `import_labels`, which has the same arguments."""
    labels = _read_published(source, sha256, categories)[1]
    return {
        category: sorted({*found, *(label.reference_seq for label in found.values())})
        for category, found in labels.items()
    }


def _read_published(
    source: str | Path, sha256: str | None, categories: Sequence[str] | None
) -> tuple[dict[tuple[str, str, str], bytes], dict[str, dict[str, PoseLabel]]]:
    """Return the checked files of a source by kind, folder and name, and its labels by category and sequence."""
    files, labels = {}, {}
    for path, data in _read_files(source, sha256):
        kind, group, name = PurePosixPath(path).parts[-3:]
        group, name = plain_name(group, "folder"), plain_name(name, "file")
        category = group if kind == "class_labels" else name.removesuffix(".pt")
        if categories is not None and category not in categories:
            continue
        if kind == "class_labels":
            label = parse_label(data, f"{source}: {path}")
            if f"{label.seq}.json" != name:
                raise InputError(f"{source}: label {path} is of sequence {label.seq!r}, expected that of its name")
            labels.setdefault(group, {})[label.seq] = label
        else:
            check_upstream_pairs(data, f"{source}: {path}")
        files[kind, group, name] = data
    if not files:
        wanted = "CATEGORY" if categories is None else " or ".join(categories)
        raise InputError(f"{source} holds no class_labels/{wanted}/SEQ.json, expected a clone of the published code")
    return files, labels


def labelled_v2_categories(root: str | Path) -> list[str]:
    """List the labelled categories of a data folder whose cameras are in the format of CO3D v2."""
    dataset, found = Co3D(root), []
    for category in dataset.categories():
        labels = read_labels(root, category)
        names = {key.sequence_name for key in dataset.frame_list(category)} & set(labels) if labels else set()
        views = (one.viewpoint for name in sorted(names)[:1] for one in dataset.frames(category, name))
        if any(view is not None and view.intrinsics_format == NDC_ISOTROPIC for view in views):
            found.append(category)
    return found


def transfer_labels(
    source: str | Path, target: str | Path, category: str, max_residual: float = MAX_RESIDUAL, replace: bool = False
) -> dict[str, float]:
    """Transfer the labels of a category from CO3D v1 to v2, where the sequences have other world coordinates.

    For each sequence, the camera centres of the frames in both data sets are aligned by Umeyama's method with scale.

    Args:
        source: Data folder with labels (v1).
        target: Data folder without (v2).
        category: Name of the category.
        max_residual: Largest accepted residual of a sequence.
        replace: Overwrite existing labels of other content.

    Returns:
        Residual of each sequence: RMS distance of the aligned camera centres over their RMS distance from their mean.

    Raises:
        InputError: A residual is above `max_residual`, a sequence is not in `target`, fewer than four cameras are in
            both data sets, or labels in `target` would be overwritten or have another reference sequence. Nothing is
            written then.
    """
    labels, old, new = read_labels(source, category), Co3D(source), Co3D(target)
    if not labels:
        raise InputError(f"{source} has no labels of category {category}, expected class_labels/{category}/SEQ.json")
    (reference, *others) = {label.reference_seq for label in labels.values()}
    if others:
        raise InputError(f"labels of {category} in {source} have several reference sequences, expected one")
    worlds, residuals = {}, {}
    for name in dict.fromkeys([reference, *labels]):
        worlds[name], residuals[name] = align_worlds(old, new, category, name)
        if residuals[name] > max_residual:
            raise InputError(
                f"sequence {category}/{name}: camera centres differ by {residuals[name]:.3f} of their spread after "
                f"alignment, expected at most {max_residual:g}; nothing was written"
            )
    centre = new.point_cloud(category, reference)[0].mean(axis=0)
    transferred = {}
    for name, label in labels.items():
        similarity = worlds[name] @ Sim3(1.0, label.trans[:3, :3], label.trans[:3, 3]) @ worlds[reference].inverse()
        moved = rigid_label(similarity, centre, name, reference)
        transferred[name] = PoseLabel(np.eye(4), name, reference) if name == reference else moved
    _check_one_reference(target, category, transferred)
    folder = label_folder(target, category)
    _write_all({folder / f"{name}.json": label_bytes(label) for name, label in transferred.items()}, replace)
    return residuals


def align_worlds(old: Co3D, new: Co3D, category: str, sequence: str) -> tuple[Sim3, float]:
    """Align a sequence's world coordinates in two data sets by the camera centres of the frames in both.

    Returns:
        The similarity from `old` to `new`, and its residual (see `transfer_labels`).
    """
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


def _read_files(source: str | Path, sha256: str | None) -> Iterator[tuple[str, bytes]]:
    """Yield the relative paths and contents of labels and pairs in a folder, an archive, or an archive at a URL."""
    if str(source).startswith(("http://", "https://")):
        yield from _read_url(str(source), sha256)
    elif Path(source).is_dir():
        if sha256:
            raise InputError(f"{source} is a folder, expected an archive or a URL where a SHA-256 is given")
        for folder, extension in _EXTENSIONS.items():
            for path in sorted(Path(source).glob(f"**/{folder}/*/*{extension}")):
                if path.is_file():
                    yield path.relative_to(source).as_posix(), read_bytes(path, "file")
    else:
        yield from _read_archive(Path(source), sha256)


def _read_url(url: str, sha256: str | None) -> Iterator[tuple[str, bytes]]:
    if not sha256:
        raise InputError(f"{url} needs its SHA-256, expected --sha256 with 64 hexadecimal digits")
    name = hashlib.sha256(url.encode()).hexdigest()[:16]
    path = fetch(url, cache_folder() / f"labels-{name}-{PurePosixPath(url).name}", most=MAX_FILE)
    try:
        yield from _read_archive(path, sha256)
    except InputError:
        path.unlink(missing_ok=True)  # so that the next call downloads it again
        raise


def _read_archive(path: Path, sha256: str | None) -> Iterator[tuple[str, bytes]]:
    data = read_bytes(path, "archive of labels")
    found = hashlib.sha256(data).hexdigest()
    if sha256 and found != sha256.lower():
        raise InputError(f"archive {path} has SHA-256 {found}, expected {sha256.lower()}")
    try:
        if zipfile.is_zipfile(io.BytesIO(data)):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                members = [member for member in archive.infolist() if _is_label_or_pairs(member.filename)]
                if sum(member.file_size for member in members) > growth_limit(len(data)):
                    raise ValueError(f"its labels are longer than {growth_limit(len(data))} bytes")
                for member in members:
                    yield member.filename, archive.read(member)
            return
        content = decompress(data, "its contents") if data[:2] == b"\x1f\x8b" else data
        with tarfile.open(fileobj=io.BytesIO(content), mode="r:") as archive:
            for member in archive:
                if member.isfile() and _is_label_or_pairs(member.name):
                    yield member.name, archive.extractfile(member).read()
    except (*ARCHIVE_ERRORS, tarfile.TarError) as error:
        raise InputError(
            f"archive {path} of {len(data)} bytes is damaged, encrypted or of another format, expected .zip or .tar.gz "
            f"({error})"
        ) from error


def _is_label_or_pairs(path: str) -> bool:
    parts = PurePosixPath(path).parts
    return len(parts) >= 3 and parts[-3] in _EXTENSIONS and path.endswith(_EXTENSIONS[parts[-3]])


def _write_all(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files; without `replace`, InputError and none is written if one exists with other content."""
    conflicts = [path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data]
    if conflicts and not replace:
        more = f" and {len(conflicts) - 1} more" if len(conflicts) > 1 else ""
        raise InputError(
            f"{conflicts[0]}{more} would be replaced by other content, expected --replace to do so; nothing was written"
        )
    for path, data in files.items():
        write_atomic(path, data)


def _check_one_reference(root: str | Path, category: str, new: dict[str, PoseLabel]) -> None:
    """Raise InputError if the existing labels updated by the new ones have several reference sequences."""
    references = sorted({label.reference_seq for label in (read_labels(root, category) | new).values()})
    if len(references) > 1:
        raise InputError(
            f"labels of {category} in {root} would have reference sequences {', '.join(references)}, expected one; "
            "nothing was written"
        )

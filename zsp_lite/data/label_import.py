"""Upstream's pose labels and evaluation pairs brought into a data folder, and labels carried from CO3D v1 to v2."""

import hashlib
import io
import lzma
import tarfile
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path, PurePosixPath

import numpy as np

from zsp_lite.alignment import Sim3, umeyama
from zsp_lite.data.co3d import Co3D
from zsp_lite.data.labels import PoseLabel, label_bytes, label_folder, parse_label, read_labels
from zsp_lite.data.pairs import check_upstream_pairs
from zsp_lite.errors import InputError
from zsp_lite.io.download import cache_folder, fetch
from zsp_lite.io.files import plain_name, read_bytes, write_atomic
from zsp_lite.labelling.keypoints import rigid_label

# Cameras of the same frames in v1 and v2 differ by a similarity, up to what the reconstruction was improved by.
MAX_RESIDUAL = 0.05
_FEWEST_CAMERAS = 4
_KINDS = {"class_labels": ".json", "determ_eval": ".pt"}  # folders and their files' endings
# What zipfile and tarfile raise for bytes that are cut or wrong, a password, or a compression they do not know.
_BROKEN = (
    zipfile.BadZipFile, tarfile.TarError, zlib.error, lzma.LZMAError, EOFError, OSError, RuntimeError, ValueError,
)  # fmt: skip


def import_labels(
    source: str | Path, root: str | Path, sha256: str | None = None, replace: bool = False
) -> dict[str, int]:
    """Bring labels and evaluation pairs from upstream's repository into the data folder `root`.

    source: a local clone (a folder), an archive of one (.zip, .tar, .tar.gz), or the URL of such an archive.  sha256:
    of the archive, required for a URL.  The files class_labels/CATEGORY/SEQ.json and determ_eval/SET/CATEGORY.pt are
    taken, wherever these folders lie; all are checked before the first is written, nothing in them is executed.
    replace: even files of these names that say something else.  Returns how many files of each kind came. Raises
    InputError where the checksum differs, a file is not what it should be, one would be lost, the labels of a category
    would have two reference sequences, or there are none.
    """
    if not Path(root).is_dir():
        raise InputError(f"data folder {root} is not there, expected a folder with categories in CO3D's layout")
    files, labels = {}, {}
    for path, data in _files(source, sha256):
        kind, group, name = PurePosixPath(path).parts[-3:]
        group, name = plain_name(group, "folder"), plain_name(name, "file")
        if kind == "class_labels":
            label = parse_label(data, f"{source}: {path}")
            if f"{label.seq}.json" != name:
                raise InputError(f"{source}: label {path} is of sequence {label.seq!r}, expected that of its name")
            labels.setdefault(group, {})[label.seq] = label
            files[kind, label_folder(root, group) / name] = data
        else:
            check_upstream_pairs(data, f"{source}: {path}")
            files[kind, Path(root) / kind / group / name] = data
    if not files:
        raise InputError(f"{source} holds no class_labels/CATEGORY/SEQ.json, expected a clone of the published code")
    for category, brought in labels.items():
        _check_one_reference(root, category, brought)
    _write({path: data for (_, path), data in files.items()}, replace)
    kinds = [kind for kind, _ in files]
    return {kind: kinds.count(kind) for kind in ("class_labels", "determ_eval")}


def transfer_labels(
    source: str | Path, target: str | Path, category: str, max_residual: float = MAX_RESIDUAL, replace: bool = False
) -> dict[str, float]:
    """Labels made on `source` (CO3D v1) written for the same sequences of `target` (v2), whose worlds differ.

    The centres of the same frames' cameras are aligned by Umeyama with scale, sequence by sequence; labels are carried
    along. Returns the residual of each sequence: root mean square distance, a share of the centres' spread. Raises
    InputError, and writes nothing, where one exceeds `max_residual`, a sequence lacks in `target`, fewer than four
    cameras are common, or `target` has labels of another reference sequence, or other ones and not `replace`.
    """
    labels, old, new = read_labels(source, category), Co3D(source), Co3D(target)
    if not labels:
        raise InputError(f"{source} has no labels of category {category}, expected class_labels/{category}/SEQ.json")
    (reference, *others) = {label.reference_seq for label in labels.values()}
    if others:
        raise InputError(f"labels of {category} in {source} have several references, expected one")
    worlds, residuals = {}, {}
    for name in dict.fromkeys([reference, *labels]):
        worlds[name], residuals[name] = align_worlds(old, new, category, name)
        if residuals[name] > max_residual:
            raise InputError(
                f"sequence {category}/{name}: camera centres differ by {residuals[name]:.3f} of their spread after "
                f"alignment, expected at most {max_residual:g}; nothing was written"
            )
    centre = new.point_cloud(category, reference)[0].mean(axis=0)
    carried = []
    for name, label in labels.items():
        rigid = Sim3(1.0, label.trans[:3, :3], label.trans[:3, 3])
        trans = rigid_label(worlds[name] @ rigid @ worlds[reference].inverse(), centre, name, reference)
        carried.append(PoseLabel(np.eye(4), name, reference) if name == reference else trans)
    _check_one_reference(target, category, {label.seq: label for label in carried})
    _write({label_folder(target, category) / f"{label.seq}.json": label_bytes(label) for label in carried}, replace)
    return residuals


def align_worlds(old: Co3D, new: Co3D, category: str, sequence: str) -> tuple[Sim3, float]:
    """The similarity from a sequence's world in one data set to that in another, and its residual (see above)."""
    centres = [
        {one.frame_number: data.camera(one).centre for one in data.frames(category, sequence) if one.viewpoint}
        for data in (old, new)
    ]
    common = sorted(centres[0].keys() & centres[1].keys())
    if len(common) < _FEWEST_CAMERAS:
        raise InputError(
            f"sequence {category}/{sequence}: {len(common)} frames have cameras in both data sets, "
            f"expected at least {_FEWEST_CAMERAS}"
        )
    first, second = (np.array([one[number] for number in common]) for one in centres)
    sim3 = umeyama(first, second)
    distance = np.square(sim3.apply(first) - second).sum(axis=1).mean()
    return sim3, float(np.sqrt(distance / np.square(second - second.mean(axis=0)).sum(axis=1).mean()))


def _files(source: str | Path, sha256: str | None) -> Iterator[tuple[str, bytes]]:
    """Relative paths and contents of the labels and pairs in a folder or archive."""
    if str(source).startswith(("http://", "https://")):
        if not sha256:
            raise InputError(f"{source} needs its SHA-256, expected --sha256 with 64 hexadecimal digits")
        name = hashlib.sha256(str(source).encode()).hexdigest()[:16]
        path = cache_folder() / f"labels-{name}-{PurePosixPath(str(source)).name}"
        fetch(str(source), path)
        try:
            yield from _files(path, sha256)
        except InputError:
            path.unlink(missing_ok=True)  # another try shall fetch it again
            raise
        return
    source = Path(source)
    if source.is_dir():
        if sha256:
            raise InputError(f"{source} is a folder, expected an archive or a URL where a SHA-256 is given")
        for folder, ending in _KINDS.items():
            for path in sorted(source.glob(f"**/{folder}/*/*{ending}")):
                if path.is_file():
                    yield path.relative_to(source).as_posix(), read_bytes(path, "file")
        return
    data = read_bytes(source, "archive of labels")
    found = hashlib.sha256(data).hexdigest()
    if sha256 and found != sha256.lower():
        raise InputError(f"archive {source} has SHA-256 {found}, expected {sha256.lower()}")
    try:
        if zipfile.is_zipfile(io.BytesIO(data)):
            with zipfile.ZipFile(io.BytesIO(data)) as archive:
                for name in archive.namelist():
                    if _is_taken(name):
                        yield name, archive.read(name)
            return
        with tarfile.open(fileobj=io.BytesIO(data)) as archive:
            for member in archive:
                if member.isfile() and _is_taken(member.name):
                    yield member.name, archive.extractfile(member).read()
    except _BROKEN as error:
        raise InputError(
            f"archive {source} of {len(data)} bytes is broken, locked or none, expected .zip or .tar.gz"
        ) from error


def _is_taken(path: str) -> bool:
    """Whether a file of an archive is a label or an evaluation set."""
    parts = PurePosixPath(path).parts
    return len(parts) >= 3 and parts[-3] in _KINDS and path.endswith(_KINDS[parts[-3]])


def _write(files: dict[Path, bytes], replace: bool) -> None:
    """Write all files, or none where one of them stands there with other content and may not be replaced."""
    lost = [path for path, data in files.items() if path.exists() and read_bytes(path, "file") != data]
    if lost and not replace:
        more = f" and {len(lost) - 1} more" if len(lost) > 1 else ""
        raise InputError(
            f"{lost[0]}{more} would be replaced by other content, expected --replace where that is meant; "
            "nothing was written"
        )
    for path, data in files.items():
        write_atomic(path, data)


def _check_one_reference(root: str | Path, category: str, new: dict[str, PoseLabel]) -> None:
    """InputError where the category's labels, with the new ones over those that are there, have several references."""
    references = sorted({label.reference_seq for label in (read_labels(root, category) | new).values()})
    if len(references) > 1:
        raise InputError(
            f"labels of {category} in {root} would have references {', '.join(references)}, expected one; "
            "nothing was written"
        )

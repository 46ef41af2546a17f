"""Download of the published archives of CO3D: the list of archives, disk space, unpacking.

A category of CO3D v2 is published in chunks of up to 20 GB, of which the first holds the
annotations; a category of v1 is one archive. Single sequences can be read out of an archive without
downloading the rest of it.
"""

import io
import os
import shutil
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
from tqdm import tqdm

from zsp_lite.errors import InputError, check_choice
from zsp_lite.io.download import RemoteFile, fetch, remote_size
from zsp_lite.io.files import path_inside, read_json, write_atomic
from zsp_lite.io.locks import writing

CATALOGUE = Path(__file__).with_name("co3d_archives.json")  # names and SHA-256 digests
# Environment variables with the address of a mirror, by data set. v1 is the version of the paper.
URL_VARIABLES = {"co3d": "ZSP_LITE_CO3D_URL", "co3d-v1": "ZSP_LITE_CO3D_V1_URL"}
_PART = 1 << 22  # bytes of a request for a part of an archive
_WORK = ".download"  # in the data folder: archives in progress
_RECORD = f"{_WORK}/unpacked.json"  # what is unpacked, by category


@dataclass(frozen=True)
class Archive:
    """A published archive of a category."""

    category: str
    origin: str  # data set and subset
    name: str
    url: str
    sha256: str
    # What is read out of the archive on the server, with the annotations; if empty, the whole
    # archive is downloaded.
    sequences: tuple[str, ...] = ()


class _Unpacked(msgspec.Struct):
    """What is unpacked of a category: names of archives, and of single sequences."""

    origin: str
    done: list[str] = []


def list_archives(
    dataset: str, category: str, single_sequence: bool = False, chunks: int | None = None
) -> list[Archive]:
    """List the first archives of a category of "co3d" (v2) or "co3d-v1".

    The very first holds the annotations.
    """
    subset = "single-sequence" if single_sequence else "full"
    suffix = "_singlesequence" if single_sequence else ""
    catalogue = msgspec.json.decode(CATALOGUE.read_bytes())[dataset]
    origin = f"{dataset} ({subset})"
    digests = catalogue.get(subset, {})
    check_choice(f"category of {origin}", category, digests)
    base = (os.environ.get(URL_VARIABLES[dataset]) or catalogue["url"]).rstrip("/")
    archives = []
    for number, sha256 in enumerate(digests[category][:chunks]):
        name = f"{category}_{number:03d}{suffix}.zip" if dataset == "co3d" else f"{category}.zip"
        archives.append(Archive(category, origin, name, f"{base}/{name}", sha256))
    return archives


def missing_archives(root: Path, archives: Sequence[Archive]) -> list[Archive]:
    """Return what is not unpacked yet of archives; InputError for a category from elsewhere."""
    record = _read_record(root)
    missing = []
    for archive in archives:
        folder = root / archive.category
        unpacked = record.get(archive.category, _Unpacked(archive.origin))
        origin = unpacked.origin
        if archive.category not in record and folder.is_dir() and any(folder.iterdir()):
            origin = "elsewhere"
        if origin != archive.origin:
            raise InputError(
                f"{folder} is from {origin}, expected another folder (--root) for {archive.origin}"
            )
        sequences = tuple(name for name in archive.sequences if name not in unpacked.done)
        # Missing are whole archives, and those of which some sequences are.
        if archive.name not in unpacked.done and (sequences or not archive.sequences):
            missing.append(replace(archive, sequences=sequences))
    return missing


def download_size(archive: Archive) -> int | None:
    """Return the number of bytes to download, None if the server does not tell."""
    if not archive.sequences:
        return remote_size(archive.url)
    with _zip(RemoteFile(archive.url), archive.url) as zipped:
        return sum(member.compress_size for member in _members(zipped, archive))


def check_disk(root: Path, missing: Sequence[Archive], sizes: Sequence[int | None]) -> int:
    """Return the bytes that missing archives of these sizes need; InputError if the disk has less.

    An unknown size counts 0.
    """
    # Unpacked archives are about as large as the archives. Of whole archives, one at a time is
    # there, too.
    whole = [size or 0 for archive, size in zip(missing, sizes) if not archive.sequences]
    # What an interrupted download has left.
    present = [
        path.stat().st_size
        for archive in missing
        for path in (root / _WORK).glob(f"{archive.name}*")
    ]
    needed = sum(size or 0 for size in sizes) + max(whole, default=0) - sum(present)
    # The disk of the nearest folder that exists.
    existing = next(path for path in (root.absolute(), *root.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise InputError(
            f"disk of {root} has {free / 1e9:.1f} GB free, expected at least "
            f"{needed / 1e9:.1f} GB; choose another folder, or fewer chunks"
        )
    return max(0, needed)


def download_archives(root: Path, archives: Sequence[Archive]) -> None:
    """Download, verify and unpack archives, or sequences of them.

    An interrupted download is continued.
    """
    with writing(root / _WORK):
        # The first archive has the annotations: it comes last.
        for archive in reversed(missing_archives(root, archives)):
            path = root / _WORK / archive.name
            if not archive.sequences and not path.exists():
                fetch(archive.url, path, remote_size(archive.url), digest=archive.sha256)
            # The origin is recorded before the folder has files, for an interrupted run.
            record = _read_record(root)
            category = record.setdefault(archive.category, _Unpacked(archive.origin))
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            file = RemoteFile(archive.url) if archive.sequences else io.FileIO(path)
            with _zip(file, archive.url) as zipped:
                _unpack(zipped, root, _members(zipped, archive))
            category.done += archive.sequences or [archive.name]
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            path.unlink(missing_ok=True)


def _unpack(zipped: zipfile.ZipFile, root: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Unpack members of a zip archive, annotations last: a category with them is complete."""
    # All paths are checked before the first file is written.
    targets = {member: path_inside(root, member.filename) for member in members}
    members = sorted(members, key=lambda member: (_is_annotation(member), member.header_offset))
    for member in tqdm(members, "unpacking", disable=None):
        path = targets[member]
        # Other files that are there in full size are left by an interrupted run.
        if _is_annotation(member) or not path.is_file() or path.stat().st_size != member.file_size:
            write_atomic(path, zipped.read(member))


def _members(zipped: zipfile.ZipFile, archive: Archive) -> list[zipfile.ZipInfo]:
    """List the files of an archive's category, or the annotations and its `sequences` only."""
    members = [
        member
        for member in zipped.infolist()
        if member.filename.startswith(f"{archive.category}/") and not member.is_dir()
    ]
    if not archive.sequences:
        return members
    folder_of = {member: member.filename.split("/")[1] for member in members}
    absent = sorted(set(archive.sequences) - set(folder_of.values()))
    if absent:
        raise InputError(
            f"archive {archive.name} has no sequence {absent[0]!r}, expected all that are labelled"
        )
    return [
        member
        for member in members
        if _is_annotation(member) or folder_of[member] in archive.sequences
    ]


@contextmanager
def _zip(file: io.RawIOBase, where: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; InputError where it turns out to be damaged or encrypted."""
    try:
        with io.BufferedReader(file, _PART) as buffered, zipfile.ZipFile(buffered) as zipped:
            yield zipped
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(f"archive {where} is damaged or encrypted: {error}") from error


def _is_annotation(member: zipfile.ZipInfo) -> bool:
    """Tell the annotations, in the category's folder itself, from the files of sequences."""
    return member.filename.count("/") == 1


def _read_record(root: Path) -> dict[str, _Unpacked]:
    """Read what is unpacked, by category."""
    path = root / _RECORD
    return read_json(path, dict[str, _Unpacked], "list") if path.is_file() else {}

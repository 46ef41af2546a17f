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
# Bytes of one request for a part of an archive. Larger parts would hold more that is not needed,
# smaller ones need more requests.
_PART = 1 << 22
_DOWNLOADS = ".download"  # folder in the data folder that holds archives until they are unpacked
_RECORD = f"{_DOWNLOADS}/unpacked.json"  # the list of what is unpacked, by category


@dataclass(frozen=True)
class Archive:
    """A published archive of a category."""

    category: str
    origin: str  # data set and subset
    name: str
    url: str
    sha256: str
    # Sequences that are read out of the archive on the server, with the annotations. If there are
    # none, the whole archive is downloaded.
    sequences: tuple[str, ...] = ()


class _Unpacked(msgspec.Struct):
    """Names of the archives and of the single sequences of a category that are unpacked."""

    origin: str
    done: list[str] = []


def list_archives(
    dataset: str, category: str, single_sequence: bool = False, chunks: int | None = None
) -> list[Archive]:
    """List the first `chunks` archives of a category of "co3d" (v2) or "co3d-v1", by default all.

    The first archive holds the annotations.
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
    """Return the archives, or the sequences of them, that are not unpacked yet.

    InputError if the category's folder is from another source.
    """
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
        # An archive without `sequences` is missing as a whole, others if a sequence is missing.
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
    # Unpacked files are about as large as the archives. While a whole archive is unpacked, it is on
    # the disk beside its files.
    whole = [size or 0 for archive, size in zip(missing, sizes) if not archive.sequences]
    # Bytes of interrupted downloads need not be downloaded again.
    present = 0
    for archive in missing:
        for path in (root / _DOWNLOADS).glob(f"{archive.name}*"):
            present += path.stat().st_size
    needed = sum(size or 0 for size in sizes) + max(whole, default=0) - present
    # `root` may not exist yet: its disk is that of the nearest folder above it that exists.
    absolute = root.absolute()
    existing = next(path for path in (absolute, *absolute.parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise InputError(
            f"disk of {root} has {free / 1e9:.1f} GB free, expected at least "
            f"{needed / 1e9:.1f} GB; choose another folder, or fewer chunks"
        )
    return max(0, needed)


def download_archives(root: Path, archives: Sequence[Archive]) -> None:
    """Download, verify and unpack `missing_archives`; an interrupted download is continued."""
    with writing(root / _DOWNLOADS):
        # The first archive has the annotations. It comes last, so that a category with annotations
        # is complete.
        for archive in reversed(archives):
            path = root / _DOWNLOADS / archive.name
            if not archive.sequences and not path.exists():
                fetch(archive.url, path, remote_size(archive.url), digest=archive.sha256)
            # The origin is recorded before files are unpacked: after an interruption, they would
            # count as files from elsewhere.
            record = _read_record(root)
            unpacked = record.setdefault(archive.category, _Unpacked(archive.origin))
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            file = RemoteFile(archive.url) if archive.sequences else io.FileIO(path)
            with _zip(file, archive.url) as zipped:
                _unpack(zipped, root, _members(zipped, archive))
            unpacked.done += archive.sequences or [archive.name]
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            path.unlink(missing_ok=True)


def _unpack(zipped: zipfile.ZipFile, root: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Unpack members of a zip archive, annotations last: a category with them is complete."""
    # All paths are checked before the first file is written.
    targets = {member: path_inside(root, member.filename) for member in members}
    members = sorted(members, key=lambda member: (_is_annotation(member), member.header_offset))
    for member in tqdm(members, "unpacking", disable=None):
        path = targets[member]
        # Files of full size are left by an interrupted run and need not be unpacked again.
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
    """Open a zip archive; InputError if the block finds it damaged or encrypted."""
    try:
        with io.BufferedReader(file, _PART) as buffered, zipfile.ZipFile(buffered) as zipped:
            yield zipped
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(f"archive {where} is damaged or encrypted: {error}") from error


def _is_annotation(member: zipfile.ZipInfo) -> bool:
    """Whether a file lies in the category's folder itself, not in the folder of a sequence."""
    return member.filename.count("/") == 1


def _read_record(root: Path) -> dict[str, _Unpacked]:
    """Read the list of what is unpacked, by category."""
    path = root / _RECORD
    return read_json(path, dict[str, _Unpacked], "list") if path.is_file() else {}

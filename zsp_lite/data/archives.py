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
    """List the first archives of a category of "co3d" (v2) or "co3d-v1"; the very first holds the
    annotations."""
    subset, suffix = ("single-sequence", "_singlesequence") if single_sequence else ("full", "")
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
    """Return what is not unpacked yet of archives; InputError if the folder has a category from
    elsewhere."""
    record, missing = _read_record(root), []
    for archive in archives:
        place, found = root / archive.category, record.get(archive.category)
        origin = (
            found.origin
            if found
            else "elsewhere"
            if place.is_dir() and any(place.iterdir())
            else archive.origin
        )
        if origin != archive.origin:
            raise InputError(
                f"{place} is from {origin}, expected another folder (--root) for {archive.origin}"
            )
        done = found.done if found else []
        sequences = tuple(name for name in archive.sequences if name not in done)
        if archive.name not in done and (sequences or not archive.sequences):
            missing.append(replace(archive, sequences=sequences))
    return missing


def download_size(archive: Archive) -> int | None:
    """Return the number of bytes to download, None if the server does not tell."""
    if not archive.sequences:
        return remote_size(archive.url)
    with _zip(RemoteFile(archive.url), archive.url) as zipped:
        return sum(member.compress_size for member in _members(zipped, archive))


def check_disk(root: Path, missing: Sequence[Archive], sizes: Sequence[int | None]) -> int:
    """Return the number of bytes that missing archives of these sizes need on the disk; InputError
    if it has less."""
    # Unpacked archives are about as large as the archives. Of whole archives, one at a time is
    # there, too.
    whole = [size or 0 for archive, size in zip(missing, sizes) if not archive.sequences]
    present = [
        path.stat().st_size
        for archive in missing
        for path in (root / _WORK).glob(f"{archive.name}*")
    ]
    needed = sum(size or 0 for size in sizes) + max(whole, default=0) - sum(present)
    existing = next(path for path in (root.absolute(), *root.absolute().parents) if path.exists())
    if needed > (free := shutil.disk_usage(existing).free):
        raise InputError(
            f"disk of {root} has {free / 1e9:.1f} GB free, expected at least "
            f"{needed / 1e9:.1f} GB; choose another folder, or fewer chunks"
        )
    return max(0, needed)


def download_archives(root: Path, archives: Sequence[Archive]) -> None:
    """Download archives, verify them, and unpack them, or sequences of them; continues an
    interrupted download."""
    with writing(root / _WORK):
        # The first archive has the annotations: it comes last.
        for archive in reversed(missing_archives(root, archives)):
            path = root / _WORK / archive.name
            if not archive.sequences and not path.exists():
                fetch(archive.url, path, remote_size(archive.url), digest=archive.sha256)
            record = _read_record(root)
            category = record.setdefault(archive.category, _Unpacked(archive.origin))
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            with _zip(
                RemoteFile(archive.url) if archive.sequences else io.FileIO(path), archive.url
            ) as zipped:
                _unpack(zipped, root, _members(zipped, archive))
            category.done += archive.sequences or [archive.name]
            write_atomic(root / _RECORD, msgspec.json.encode(record))
            path.unlink(missing_ok=True)


def _unpack(zipped: zipfile.ZipFile, root: Path, members: Sequence[zipfile.ZipInfo]) -> None:
    """Unpack members of a zip archive, annotations last, so that a category is read only if it is
    complete."""
    # All paths are checked before the first file is written.
    targets = {one: path_inside(root, one.filename) for one in members}
    members = sorted(members, key=lambda one: (_is_annotation(one), one.header_offset))
    for one in tqdm(members, "unpacking", disable=None):
        path = targets[one]
        if _is_annotation(one) or not path.is_file() or path.stat().st_size != one.file_size:
            write_atomic(path, zipped.read(one))


def _members(zipped: zipfile.ZipFile, archive: Archive) -> list[zipfile.ZipInfo]:
    """List the files of the category in an archive, or its annotations and the files of the
    archive's `sequences`."""
    members = [
        one
        for one in zipped.infolist()
        if one.filename.startswith(f"{archive.category}/") and not one.is_dir()
    ]
    if not archive.sequences:
        return members
    folder_of = {one: one.filename.split("/")[1] for one in members}
    if absent := sorted(set(archive.sequences) - set(folder_of.values())):
        raise InputError(
            f"archive {archive.name} has no sequence {absent[0]!r}, expected all that are labelled"
        )
    return [one for one in members if _is_annotation(one) or folder_of[one] in archive.sequences]


@contextmanager
def _zip(file: io.RawIOBase, where: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; InputError where it turns out to be damaged or encrypted."""
    try:
        with io.BufferedReader(file, _PART) as buffered, zipfile.ZipFile(buffered) as zipped:
            yield zipped
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(f"archive {where} is damaged or encrypted: {error}") from error


def _is_annotation(member: zipfile.ZipInfo) -> bool:
    return member.filename.count("/") == 1


def _read_record(root: Path) -> dict[str, _Unpacked]:
    path = root / _RECORD
    return read_json(path, dict[str, _Unpacked], "list") if path.is_file() else {}

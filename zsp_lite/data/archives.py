"""Download of the published archives of CO3D: the list of archives, disk space, unpacking.

A category of CO3D v2 is published in chunks of up to 20 GB, of which the first holds the annotations; a category of v1
is one archive. The names and SHA-256 digests stand in `co3d_archives.json`. Single sequences can be read out of an
archive without downloading the rest of it.
"""

import functools
import io
import os
import shutil
import stat
import zipfile
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import msgspec

from zsp_lite.data.annotations import decode
from zsp_lite.errors import InputError
from zsp_lite.io.download import fetch
from zsp_lite.io.files import ARCHIVE_ERRORS, path_inside, read_bytes, write_atomic
from zsp_lite.io.locks import writing
from zsp_lite.io.remote import RemoteFile, remote_size

CATALOGUE = Path(__file__).with_name("co3d_archives.json")
# Environment variables with the address of a mirror, by data set. v1 is the version of the paper.
URL_VARIABLES = {"co3d": "ZSP_LITE_CO3D_URL", "co3d-v1": "ZSP_LITE_CO3D_V1_URL"}
_PART = 1 << 22  # bytes of a request for a part of an archive
_WORK = ".download"  # in the data folder: archives in progress, and the list of what is unpacked


@dataclass(frozen=True)
class Archive:
    """A published archive: the file `name`, with its SHA-256 digest."""

    dataset: str  # "co3d" (v2) or "co3d-v1"
    category: str
    subset: str  # "full" or "single-sequence"
    number: int  # of the chunk, from 0
    name: str
    sha256: str

    @property
    def url(self) -> str:
        """Address of the file."""
        base = os.environ.get(URL_VARIABLES[self.dataset]) or _catalogue(CATALOGUE)[self.dataset]["url"]
        return base.rstrip("/") + "/" + self.name


class _Unpacked(msgspec.Struct):
    """What is unpacked of a category: names of archives, and of single sequences."""

    dataset: str
    subset: str
    archives: list[str] = []
    sequences: list[str] = []


def list_archives(
    dataset: str, category: str, single_sequence: bool = False, chunks: int | None = None
) -> list[Archive]:
    """List the archives of a category.

    Args:
        dataset: "co3d" (v2) or "co3d-v1".
        category: Name of the category.
        single_sequence: The single-sequence subset of v2: a few sequences of each category.
        chunks: Number of archives, from the first; None for all.

    Returns:
        The archives; the one with the annotations is the first. InputError if there are not so many.
    """
    if dataset not in URL_VARIABLES:
        raise InputError(f"data set is {dataset!r}, expected one of {', '.join(URL_VARIABLES)}")
    subset = "single-sequence" if single_sequence else "full"
    digests = _catalogue(CATALOGUE)[dataset].get(subset)
    if digests is None:
        raise InputError(f"{dataset} has no {subset} subset, expected co3d")
    if category not in digests:
        raise InputError(f"category {category!r} is not in {dataset} ({subset}), which has {', '.join(digests)}")
    count = len(digests[category])
    if chunks is not None and not 1 <= chunks <= count:
        raise InputError(f"chunks are {chunks}, expected 1 to {count} for {category} of {dataset} ({subset})")
    suffix = "_singlesequence" if single_sequence else ""
    endings = [f"_{number:03d}{suffix}" for number in range(count)] if dataset == "co3d" else [""]
    return [
        Archive(dataset, category, subset, number, f"{category}{ending}.zip", sha256)
        for number, (ending, sha256) in enumerate(zip(endings, digests[category], strict=True))
    ][:chunks]


def missing_archives(root: str | Path, archives: Sequence[Archive]) -> list[Archive]:
    """Return the archives that are not unpacked yet; InputError if the folder has a category from elsewhere."""
    root, record = Path(root), _read_record(root)
    for archive in archives:
        place = root / archive.category
        if (found := record.get(archive.category)) is None:
            if place.is_dir() and any(place.iterdir()):
                raise InputError(f"{place} exists and is not from this command, expected another folder (--root)")
        elif (found.dataset, found.subset) != (archive.dataset, archive.subset):
            raise InputError(
                f"{place} is from {found.dataset} ({found.subset}), expected another folder (--root) for "
                f"{archive.dataset} ({archive.subset})"
            )
    return [one for one in archives if one.category not in record or one.name not in record[one.category].archives]


def missing_sequences(root: str | Path, archive: Archive, sequences: Iterable[str]) -> list[str]:
    """Return the sequences of an archive that are not unpacked in a data folder yet."""
    if not missing_archives(root, [archive]):
        return []
    record = _read_record(Path(root))
    there = record[archive.category].sequences if archive.category in record else []
    return sorted(set(sequences) - set(there))


def sequence_size(archive: Archive, sequences: Collection[str]) -> int:
    """Return the size of sequences and of the annotations in an archive on the server, bytes."""
    with _remote_archive(archive) as zipped:
        return sum(member.compress_size for member in _members(zipped, archive.category, archive.url, sequences))


def check_disk(root: str | Path, missing: Sequence[Archive], sizes: Sequence[int | None], whole: bool = True) -> int:
    """Return the number of bytes that missing archives need on the disk; InputError if it has less.

    These are the unpacked archives, which are about as large as the archives, and one archive, as an archive is removed
    once it is unpacked. With `whole` false, parts of the archives are unpacked at once. Unknown sizes are None.
    """
    known = [size for size in sizes if size is not None]
    needed = sum(known) + (max(known, default=0) if whole else 0)
    for archive in missing:
        for path in (_archive_path(root, archive), _part_path(root, archive)):
            needed -= path.stat().st_size if path.is_file() else 0
    _check_free(Path(root), max(0, needed))
    return max(0, needed)


def download_archives(
    root: str | Path, archives: Sequence[Archive], progress: Callable[..., Iterable] | None = None
) -> None:
    """Download archives, verify their SHA-256 and unpack them into a data folder.

    An interrupted download is continued by the next call. The annotations of a category are unpacked last, so that the
    category is read only if it is complete. `progress` wraps the list of an archive's files, such as `tqdm`.

    Raises:
        InputError: A download fails or has another digest, an archive is damaged or holds a path that leads out of the
            folder or a link, the disk is too small, or another process writes to the folder.
    """
    root = Path(root)
    with writing(root / _WORK):
        missing = missing_archives(root, archives)
        # The chunk with the annotations comes last.
        for archive in sorted(missing, key=lambda one: (one.category, one.number == 0, one.number)):
            path = _fetch(root, archive)
            with _recorded(root, archive) as category, open(path, "rb") as file, _zip(file, str(path)) as zipped:
                unpack(zipped, root, archive.category, str(path), progress=progress)
                category.archives.append(archive.name)
            path.unlink()


def download_sequences(
    root: str | Path,
    archive: Archive,
    sequences: Collection[str],
    progress: Callable[..., Iterable] | None = None,
) -> None:
    """Read sequences and the annotations out of an archive on the server, without downloading the rest of it.

    Each file is verified by the CRC-32 in the archive. The SHA-256 is that of the whole archive and cannot be verified.
    Raises as `download_archives`, and if the server does not send parts of files or the archive lacks a sequence.
    """
    root = Path(root)
    with writing(root / _WORK):
        if missing := missing_sequences(root, archive, sequences):
            with _recorded(root, archive) as category, _remote_archive(archive) as zipped:
                unpack(zipped, root, archive.category, archive.url, missing, progress)
                category.sequences += missing


def unpack(
    zipped: zipfile.ZipFile,
    root: Path,
    category: str,
    where: str,
    sequences: Collection[str] | None = None,
    progress: Callable[..., Iterable] | None = None,
) -> None:
    """Unpack the folder of a category, or the given sequences of it with its annotations, from the zip archive `where`.

    All members are checked before the first is written. A file that exists with the same size is not written again,
    except the annotations. Members that are not in the folder of the category are left out.
    """
    targets = {one: path_inside(root, one.filename) for one in _members(zipped, category, where, sequences)}
    wanted = [member for member, target in targets.items() if not _is_there(member, target)]
    wanted.sort(key=lambda one: (_is_annotation(one.filename), one.header_offset))
    _check_free(root, sum(one.file_size for one in wanted))
    for member in progress(wanted) if progress else wanted:
        _write_member(zipped, member, targets[member])


def _members(
    zipped: zipfile.ZipFile, category: str, where: str, sequences: Collection[str] | None
) -> list[zipfile.ZipInfo]:
    """List the files of a category, or of some sequences of it, after all members were checked."""
    members = [member for member in zipped.infolist() if not member.is_dir()]
    for member in members:
        _check_member(member, where)
    members = [one for one in members if PurePosixPath(one.filename).parts[0] == category]
    if not members:
        raise InputError(f"archive {where} has no folder {category}, expected one as in CO3D")
    if sequences is None:
        return members
    found = {one.filename.split("/")[1] for one in members if not _is_annotation(one.filename)}
    if absent := sorted(set(sequences) - found):
        raise InputError(f"archive {where} has no sequence {absent[0]!r}, expected {len(sequences)} sequences")
    return [one for one in members if _is_annotation(one.filename) or one.filename.split("/")[1] in sequences]


def _fetch(root: Path, archive: Archive) -> Path:
    """Download an archive unless it is there, up to the size that the server tells."""
    if (path := _archive_path(root, archive)).exists():
        return path
    return fetch(archive.url, path, remote_size(archive.url), digest=archive.sha256)


@contextmanager
def _recorded(root: Path, archive: Archive) -> Iterator[_Unpacked]:
    """Record that the category is from this archive, and at the end what was unpacked of it."""
    record = _read_record(root)
    category = record.setdefault(archive.category, _Unpacked(archive.dataset, archive.subset))
    _write_record(root, record)
    yield category
    _write_record(root, record)


@contextmanager
def _zip(file: io.BufferedReader, where: str) -> Iterator[zipfile.ZipFile]:
    """Open a zip archive; InputError where it turns out to be damaged or encrypted."""
    try:
        with zipfile.ZipFile(file) as zipped:
            yield zipped
    except InputError:
        raise
    except (NotImplementedError, *(kind for kind in ARCHIVE_ERRORS if kind is not OSError)) as error:
        raise InputError(f"archive {where} is damaged or encrypted: {error}") from error


@contextmanager
def _remote_archive(archive: Archive) -> Iterator[zipfile.ZipFile]:
    with io.BufferedReader(RemoteFile(archive.url), _PART) as file, _zip(file, archive.url) as zipped:
        yield zipped


def _check_member(member: zipfile.ZipInfo, where: str) -> None:
    """Raise InputError for anything that is not a plain file at a relative path without dots."""
    name = member.filename
    mode = member.external_attr >> 16
    if mode and stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise InputError(f"archive {where} holds {name!r}, which is a link or a device, expected plain files")
    parts = name.split("/")
    if any(part in ("", ".", "..") for part in parts) or any(character in name for character in "\\:\0"):
        raise InputError(f"archive {where} holds the path {name!r}, expected paths inside the data folder")


def _is_annotation(name: str) -> bool:
    return name.count("/") == 1


def _is_there(member: zipfile.ZipInfo, target: Path) -> bool:
    return not _is_annotation(member.filename) and target.is_file() and target.stat().st_size == member.file_size


def _write_member(archive: zipfile.ZipFile, member: zipfile.ZipInfo, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(target.name + ".part")  # renamed when complete, so that sizes tell what is there
    try:
        with archive.open(member) as source, open(part, "wb") as file:
            shutil.copyfileobj(source, file, 1 << 20)
        os.replace(part, target)
    finally:
        part.unlink(missing_ok=True)


def _check_free(folder: Path, needed: int) -> None:
    existing = next(path for path in (folder.absolute(), *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    if needed > free:
        raise InputError(
            f"disk of {folder} has {free / 1e9:.1f} GB free, expected at least {needed / 1e9:.1f} GB; choose another "
            "folder, or fewer chunks"
        )


def _archive_path(root: str | Path, archive: Archive) -> Path:
    return Path(root) / _WORK / archive.name


def _part_path(root: str | Path, archive: Archive) -> Path:
    return _archive_path(root, archive).with_name(archive.name + ".part")


def _read_record(root: Path) -> dict[str, _Unpacked]:
    path = root / _WORK / "unpacked.json"
    return decode(read_bytes(path, "list"), dict[str, _Unpacked], path) if path.is_file() else {}


def _write_record(root: Path, record: dict[str, _Unpacked]) -> None:
    write_atomic(root / _WORK / "unpacked.json", msgspec.json.encode(record))


@functools.cache
def _catalogue(path: Path) -> dict:
    return msgspec.json.decode(path.read_bytes())

"""Download of a file over HTTP, with resume, checksum and a limit on its size (pooch cannot resume)."""

import hashlib
import http.client
import os
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tqdm import tqdm

from zsp_lite.errors import InputError
from zsp_lite.io.files import read_bytes, sha256, write_atomic

CHUNK = 1 << 18  # bytes
TIMEOUT = 30  # of a connection, s


def cache_folder() -> Path:
    """Return the folder of downloaded files: $ZSP_LITE_CACHE, or ~/.cache/zsp-lite."""
    return Path(os.environ.get("ZSP_LITE_CACHE") or Path.home() / ".cache" / "zsp-lite")


def fetch(
    url: str,
    path: str | Path,
    size: int | None = None,
    md5_prefix: str = "",
    digest: str = "",
    most: int | None = None,
) -> Path:
    """Download a file unless it exists.

    Data is written to `path`.part, which is renamed after its size and checksum were verified. An interrupted download
    is resumed, in up to three attempts and by later calls.

    Args:
        url: URL of the file.
        path: Where to store it, and the result.
        size: Expected size, bytes; None if unknown.
        md5_prefix: Expected first digits of the MD5 digest.
        digest: Expected SHA-256 digest; empty if unknown.
        most: Largest size, bytes, where `size` is unknown. A longer download is stopped and removed.

    Raises:
        InputError: The server cannot be reached, the download is interrupted three times or is too long, or the size
            or checksum differs.
    """
    path = Path(path)
    if path.exists():
        return path
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(3):
            if _fetch_rest(url, part, size, most if size is None else size):
                break
        else:
            raise InputError(
                f"download of {url} was interrupted three times, at {part.stat().st_size} bytes; call again to resume"
            )
        if not has_size_and_hash(part, size, md5_prefix) or (digest and sha256(part, "download") != digest):
            received = part.stat().st_size
            part.unlink()  # resuming from wrong data would never succeed
            checksum = f"SHA-256 {digest}" if digest else f"MD5 {md5_prefix or '(any)'}..."
            length = "any number of" if size is None else size
            raise InputError(
                f"download of {url} gave another file of {received} bytes, expected {length} bytes with {checksum}; "
                "removed"
            )
        os.replace(part, path)
    except urllib.error.HTTPError as error:
        raise InputError(f"download of {url} failed: HTTP {error.code} {error.reason}") from error
    except InputError:
        raise
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise InputError(f"download of {url} failed: {getattr(error, 'reason', error)}") from error
    return path


def has_size_and_hash(path: Path, size: int | None = None, md5_prefix: str = "") -> bool:
    """Check the size of a file (bytes, if given) and the first digits of its MD5 digest."""
    if size is not None and path.stat().st_size != size:
        return False
    if not md5_prefix:
        return True
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
    return digest.startswith(md5_prefix)


@contextmanager
def pinned(path: Path) -> Iterator[None]:
    """Use a file without a published digest; InputError if it differs from the first use, whose SHA-256 is stored."""
    pin, found = path.with_name(path.name + ".sha256"), sha256(path, "weights")
    if known := pin.is_file():
        expected = read_bytes(pin, "digest")[:64].decode("ascii", "replace")
        if found != expected:
            raise InputError(
                f"{path} has changed since its first use: its SHA-256 is {found}, expected {expected} as in "
                f"{pin.name}; remove both files to download it again"
            )
    yield
    if not known:
        with suppress(OSError):  # a folder that cannot be written
            write_atomic(pin, f"{found}  {path.name}\n".encode())


def _fetch_rest(url: str, part: Path, size: int | None, most: int | None) -> bool:
    """Request the missing rest of `part`. Returns True if the file is complete, False if interrupted."""
    start = part.stat().st_size if part.exists() else 0
    if size is not None and start >= size:
        return True
    request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})
    try:
        response = urllib.request.urlopen(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        if error.code != 416:  # 416 "range not satisfiable": complete already, or the file on the server changed
            raise
        if error.headers.get("Content-Range", "") == f"bytes */{start}":
            return True
        part.unlink()
        return False
    with response:
        if start and not (
            response.status == 206 and response.headers.get("Content-Range", "").startswith(f"bytes {start}-")
        ):
            start = 0  # the server ignored the Range header and sends the whole file
        length = response.headers.get("Content-Length")
        total = start + int(length) if length is not None else None
        if most is not None and (total or 0) > most:
            raise InputError(f"download of {url} has {total} bytes, expected at most {most}")
        bar = tqdm(desc=part.stem, total=total, initial=start, unit="B", unit_scale=True, disable=None)
        with bar, open(part, "ab" if start else "wb") as file:
            try:
                while chunk := response.read(CHUNK):
                    file.write(chunk)
                    bar.update(len(chunk))
                    if most is not None and file.tell() > most:
                        part.unlink()
                        raise InputError(f"download of {url} has more than {most} bytes, expected no more; removed")
            except (http.client.IncompleteRead, ConnectionError, TimeoutError):
                return False
            return total is None or file.tell() >= total

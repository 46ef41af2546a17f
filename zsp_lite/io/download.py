"""Download of a file over HTTP, with resume and checksum. Written here because pooch cannot resume a download."""

import hashlib
import http.client
import os
import urllib.error
import urllib.request
from pathlib import Path

from tqdm import tqdm

from zsp_lite.errors import InputError

CHUNK = 1 << 18  # bytes


def cache_folder() -> Path:
    """Return the folder of downloaded files: $ZSP_LITE_CACHE, or ~/.cache/zsp-lite."""
    return Path(os.environ.get("ZSP_LITE_CACHE") or Path.home() / ".cache" / "zsp-lite")


def fetch(url: str, path: str | Path, size: int | None = None, md5_prefix: str = "", timeout: float = 30.0) -> Path:
    """Download a file unless it exists.

    Data is written to `path`.part, which is renamed after its size and checksum were verified. An interrupted download
    is resumed, in up to three attempts and by later calls.

    Args:
        url: URL of the file.
        path: Where to store it.
        size: Expected size, bytes; None if unknown.
        md5_prefix: Expected first digits of the MD5 digest.
        timeout: Timeout of the connection, seconds.

    Returns:
        `path`.

    Raises:
        InputError: The server cannot be reached, the download was interrupted three times, or the size or checksum
            differs.
    """
    path = Path(path)
    if path.exists():
        return path
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for _ in range(3):
            if _fetch_rest(url, part, size, timeout):
                break
        else:
            raise InputError(
                f"download of {url} was interrupted three times, at {part.stat().st_size} bytes; call again to resume"
            )
        if not has_size_and_hash(part, size, md5_prefix):
            received = part.stat().st_size
            part.unlink()  # resuming from wrong data would never succeed
            raise InputError(
                f"download of {url} gave another file of {received} bytes, expected "
                f"{size if size is not None else 'any number of'} bytes with MD5 {md5_prefix or '(any)'}...; removed"
            )
        os.replace(part, path)
    except urllib.error.HTTPError as error:
        raise InputError(f"download of {url} failed: HTTP {error.code} {error.reason}") from error
    except (OSError, http.client.HTTPException, ValueError) as error:
        if isinstance(error, InputError):
            raise
        reason = getattr(error, "reason", error)
        raise InputError(f"download of {url} failed: {reason}") from error
    return path


def has_size_and_hash(path: Path, size: int | None = None, md5_prefix: str = "") -> bool:
    """Check the size of a file (bytes, if given) and the first digits of its MD5 digest."""
    if size is not None and path.stat().st_size != size:
        return False
    with open(path, "rb") as file:
        digest = hashlib.file_digest(file, lambda: hashlib.md5(usedforsecurity=False)).hexdigest()
    return digest.startswith(md5_prefix)


def _fetch_rest(url: str, part: Path, size: int | None, timeout: float) -> bool:
    """Request the missing rest of `part`. Returns True if the file is complete, False if interrupted."""
    start = part.stat().st_size if part.exists() else 0
    if size is not None and start == size:
        return True
    if size is not None and start > size:
        start = 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={start}-"} if start else {})
    try:
        response = urllib.request.urlopen(request, timeout=timeout)
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
        bar = tqdm(desc=part.stem, total=total, initial=start, unit="B", unit_scale=True, disable=None)
        with bar, open(part, "ab" if start else "wb") as file:
            try:
                while chunk := response.read(CHUNK):
                    file.write(chunk)
                    bar.update(len(chunk))
            except (http.client.IncompleteRead, ConnectionError, TimeoutError):
                return False
            received = file.tell()
    return total is None or received >= total

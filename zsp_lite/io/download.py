"""Files on a server: download with resume, checksum and a limit on the size; parts of a file.

The package pooch cannot resume.
"""

import hashlib
import http.client
import io
import math
import os
import urllib.error
import urllib.request
from pathlib import Path

from tqdm import tqdm

from zsp_lite.errors import InputError
from zsp_lite.io.files import file_size
from zsp_lite.io.locks import writing

CHUNK = 1 << 18  # bytes that are read at once
TIMEOUT = 30  # seconds until a server that does not answer is given up
ATTEMPTS = 3  # number of requests, before the user must call again
# What urllib raises if a server cannot be reached, sends no file, or has an invalid address.
NETWORK_ERRORS = (OSError, http.client.HTTPException, ValueError)


def sha256(path: str | Path, what: str) -> str:
    """Return the SHA-256 digest of a file in hexadecimal digits."""
    file_size(path, what)
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def fetch(
    url: str,
    path: Path,
    size: int | None = None,
    md5_prefix: str = "",
    digest: str = "",
    most: float = math.inf,
) -> Path:
    """Download a file of `size` bytes, or at most `most`, unless it exists.

    Data is written to `path`.part. This file is renamed after its size, the first digits of its MD5
    digest and its SHA-256 `digest` are verified. An interrupted download is resumed, in up to
    three attempts and by later calls. Processes that download the same file take turns.
    """
    if path.exists():
        return path
    with writing(path.parent, f"{path.name}.lock", timeout=-1):
        if path.exists():  # another process has downloaded it
            return path
        part = path.with_name(path.name + ".part")
        if size is not None:
            most = size
        try:
            # `any` stops after the first attempt that is not interrupted.
            complete = any(_fetch_rest(url, part, most) for _ in range(ATTEMPTS))
            received = part.stat().st_size
        except NETWORK_ERRORS as error:
            raise InputError(f"download of {url} failed: {error}") from error
        if not complete:
            raise InputError(
                f"download of {url} was interrupted at {received} bytes; call again to resume"
            )
        matches = has_size_and_hash(part, size, md5_prefix) and digest in (
            "",
            sha256(part, "download"),
        )
        if received > most or not matches:
            part.unlink()  # resuming from wrong data would never succeed
            limit = f"at most {most}" if size is None else most
            raise InputError(
                f"download of {url} is another file of {received} bytes, expected {limit} bytes "
                f"with the checksum {digest or md5_prefix or '(any)'}; removed"
            )
        os.replace(part, path)
        return path


def has_size_and_hash(path: Path, size: int | None = None, md5_prefix: str = "") -> bool:
    """Check the size of a file (bytes, if given) and the first digits of its MD5 digest."""
    digest = ""
    with open(path, "rb") as file:
        if md5_prefix:
            # MD5 finds errors of the transfer, not attacks: systems without MD5 allow this use.
            md5 = hashlib.file_digest(file, lambda: hashlib.md5(usedforsecurity=False))
            digest = md5.hexdigest()
    return size in (None, path.stat().st_size) and digest.startswith(md5_prefix)


def remote_size(url: str) -> int | None:
    """Ask a server for the size of a file in bytes; None if it does not tell."""
    try:
        request = urllib.request.Request(url, method="HEAD")
        with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
            length = response.headers.get("Content-Length")
            return None if length is None else int(length)
    except NETWORK_ERRORS as error:
        raise InputError(f"{url} cannot be reached: {error}") from error


class RemoteFile(io.RawIOBase):
    """A file on a server, of which only what is read is transferred (HTTP range requests)."""

    def __init__(self, url: str):
        super().__init__()
        self.url = url
        self.size = remote_size(url) or 0
        self._position = 0

    def readable(self) -> bool:
        return True

    seekable = readable

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Move to an offset from the start, the position or the end, as in `io.IOBase.seek`."""
        origins = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self.size}
        self._position = max(0, origins[whence] + offset)
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """Read up to `len(buffer)` bytes; InputError if the server does not send them."""
        count = min(len(buffer), self.size - self._position)
        if count <= 0:
            return 0
        problem = "the connection was closed"
        for _ in range(ATTEMPTS):
            try:
                with _request(self.url, self._position, self._position + count) as response:
                    if not _is_part(response, self._position):
                        problem = "the server does not send parts of files, expected range requests"
                        continue
                    received = response.readinto(memoryview(buffer)[:count])
                    if received:
                        self._position += received
                        return received
            except NETWORK_ERRORS as error:
                problem = str(error)
        raise InputError(f"{self.url} cannot be read: {problem}")


def _request(url: str, start: int, end: int | None = None) -> http.client.HTTPResponse:
    """Request the bytes of a file from `start` to before `end`."""
    headers = {}
    if start or end:
        headers["Range"] = f"bytes={start}-{'' if end is None else end - 1}"
    return urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=TIMEOUT)


def _is_part(response: http.client.HTTPResponse, start: int) -> bool:
    """Tell whether a server sends a file from `start`, rather than all of it."""
    return response.headers.get("Content-Range", "").startswith(f"bytes {start}-")


def _fetch_rest(url: str, part: Path, most: float) -> bool:
    """Request the rest of `part`, up to `most` bytes of the file; False if it is interrupted."""
    start = part.stat().st_size if part.exists() else 0
    if start >= most:
        return True
    try:
        response = _request(url, start)
    except urllib.error.HTTPError as error:
        if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        # The part is as long as the file, or the file has changed on the server: start again.
        part.unlink()
        return False
    with response:
        # A server that does not resume sends the whole file.
        start = start if _is_part(response, start) else 0
        length = response.headers.get("Content-Length")
        total = None if length is None else start + int(length)
        bar = tqdm.wrapattr(response, "read", total, desc=part.stem, initial=start, disable=None)
        with bar as source, open(part, "ab" if start else "wb") as file:
            try:
                # Up to a chunk more than `most`, by which `fetch` tells that the file is larger.
                while file.tell() <= most and (chunk := source.read(CHUNK)):
                    file.write(chunk)
            except (http.client.IncompleteRead, ConnectionError, TimeoutError):
                return False
            return total is None or file.tell() >= min(total, most)

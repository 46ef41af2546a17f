"""Size and parts of a file on a server, without downloading all of it."""

import http.client
import io
import urllib.error
import urllib.request

from zsp_lite.errors import InputError
from zsp_lite.io.download import TIMEOUT

_ATTEMPTS = 3  # requests of one part before it is given up


def remote_size(url: str) -> int | None:
    """Ask a server for the size of a file in bytes, None if it does not tell; InputError if it has no such file."""
    try:
        with urllib.request.urlopen(urllib.request.Request(url, method="HEAD"), timeout=TIMEOUT) as response:
            length = response.headers.get("Content-Length")
        return None if length is None else int(length)
    except (OSError, http.client.HTTPException, ValueError) as error:
        raise InputError(f"{url} cannot be reached: {_reason(error)}") from error


class RemoteFile(io.RawIOBase):
    """A file on a server, of which only the parts that are read are transferred (HTTP range requests).

    For zipfile and the like; `io.BufferedReader(RemoteFile(url), size)` makes few large requests of many small reads.
    """

    def __init__(self, url: str):
        """Ask for the size of the file; InputError if the server cannot be reached or does not tell it."""
        super().__init__()
        self.url, self.size, self._position = url, remote_size(url), 0
        if self.size is None:
            raise InputError(f"{url}: the server does not tell the size of the file, expected Content-Length")

    def readable(self) -> bool:
        """Return True."""
        return True

    def seekable(self) -> bool:
        """Return True."""
        return True

    def tell(self) -> int:
        """Return the position in bytes."""
        return self._position

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        """Set the position, as for every file."""
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._position, io.SEEK_END: self.size}[whence]
        self._position = max(0, start + offset)
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:
        """Read up to `len(buffer)` bytes; InputError if the server cannot be reached or does not send parts."""
        end = min(self._position + len(buffer), self.size)
        if end <= self._position:
            return 0
        problem: object = "the connection was closed"
        for _ in range(_ATTEMPTS):
            try:
                if data := self._request(end):
                    buffer[: len(data)] = data
                    self._position += len(data)
                    return len(data)
            except urllib.error.HTTPError as error:
                raise InputError(f"{self.url} cannot be read: {_reason(error)}") from error
            except (OSError, http.client.HTTPException) as error:
                problem = _reason(error)
        raise InputError(f"{self.url} cannot be read: {problem}")

    def _request(self, end: int) -> bytes:
        wanted = f"bytes {self._position}-{end - 1}/"
        request = urllib.request.Request(self.url, headers={"Range": f"bytes={self._position}-{end - 1}"})
        with urllib.request.urlopen(request, timeout=TIMEOUT) as response:
            if response.status != 206 or not response.headers.get("Content-Range", "").startswith(wanted):
                raise InputError(f"{self.url}: the server does not send parts of files, expected range requests")
            try:
                return response.read(end - self._position)  # a server may send more than was asked for
            except http.client.IncompleteRead as error:
                return error.partial  # the next call reads on from there


def _reason(error: Exception) -> object:
    if isinstance(error, urllib.error.HTTPError):
        return f"HTTP {error.code} {error.reason}"
    return getattr(error, "reason", error)

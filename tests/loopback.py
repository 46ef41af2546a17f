"""An HTTP server on loopback for the tests of downloads."""

import http.server
import re
import threading


class Server:
    """An HTTP server on loopback that counts requests and can misbehave."""

    def __init__(self, files: dict[str, bytes]):
        self.files = files  # content by path
        self.ranges = []  # Range header of each GET request so far, or None
        self.break_after = None  # the connection is closed after so many bytes of a response
        self.stall_after = None  # nothing is sent after so many bytes, but the connection stays open
        self.knows_ranges = True  # whether Range headers are honoured
        self.chunked, self.surplus = False, b""  # whether the length is not sent; sent after the content
        self.closed = threading.Event()
        outer = self

        class Handler(http.server.BaseHTTPRequestHandler):
            def do_HEAD(self):
                content = outer.files.get(self.path)
                if content is None:
                    return self.send_error(404)
                self.send_response(200)
                self.send_header("Content-Length", str(len(content)))
                self.end_headers()

            def do_GET(self):
                outer.ranges.append(self.headers.get("Range"))
                content = outer.files.get(self.path)
                if content is None:
                    return self.send_error(404)
                start, end = 0, len(content)
                if outer.knows_ranges and outer.ranges[-1]:
                    first, last = re.fullmatch(r"bytes=(\d+)-(\d*)", outer.ranges[-1]).groups()
                    start, end = int(first), min(end, int(last) + 1) if last else end
                    if start >= len(content):
                        self.send_response(416)
                        self.send_header("Content-Range", f"bytes */{len(content)}")
                        self.send_header("Content-Length", "0")
                        return self.end_headers()
                    self.send_response(206)
                    self.send_header("Content-Range", f"bytes {start}-{end - 1}/{len(content)}")
                else:
                    self.send_response(200)
                if not outer.chunked:
                    self.send_header("Content-Length", str(end - start))
                self.end_headers()
                limits = [one for one in (outer.break_after, outer.stall_after) if one is not None]
                self.close_connection = True
                try:
                    self.wfile.write(content[start : min([end, *(start + one for one in limits)])] + outer.surplus)
                    if outer.stall_after is not None:
                        outer.closed.wait()
                except ConnectionError:  # the client closed the connection before the end
                    return

            def log_message(self, *_):
                return

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.http.server_port}"
        threading.Thread(target=self.http.serve_forever, args=(0.02,), daemon=True).start()

    def close(self) -> None:
        """End the server and its stalled responses."""
        self.closed.set()
        self.http.shutdown()
        self.http.server_close()

"""A server in place of the internet, for the tests of downloads."""

import http.server
import re
import threading


class Server:
    """An HTTP server on loopback that counts requests and can misbehave."""

    def __init__(self, files: dict[str, bytes]):
        self.files = files  # content by path
        self.ranges = []  # the Range header of each GET request, None where it has none
        self.break_after = None  # bytes of a response after which the connection is closed
        self.knows_ranges = True  # whether Range headers are honoured
        self.chunked = False  # whether the length is left out, as in chunked responses
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
                self.close_connection = True
                end = end if outer.break_after is None else min(end, start + outer.break_after)
                try:
                    self.wfile.write(content[start:end])
                except ConnectionError:  # the client closed the connection before the end
                    return

            def log_message(self, *_):
                return  # nothing on stderr

        self.http = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        self.url = f"http://127.0.0.1:{self.http.server_port}"
        # It looks every 0.02 s whether it is to stop.
        threading.Thread(target=self.http.serve_forever, args=(0.02,), daemon=True).start()

    def close(self) -> None:
        """Stop the server."""
        self.http.shutdown()
        self.http.server_close()

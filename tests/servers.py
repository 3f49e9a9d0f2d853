"""A web server on this machine that gives ranges of files, or fails as servers do."""

import re
import threading
import time
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer


class _Handler(BaseHTTPRequestHandler):
    def do_GET(self):
        server, path = self.server, self.server.folder / self.path.lstrip("/").partition("?")[0]
        if not path.is_file():
            self.send_error(404)
            return
        if server.refusals:
            self.send_error(server.refusals.pop())
            return
        data, asked = path.read_bytes(), re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
        if asked and server.ranges:
            first, last = int(asked[1]), min(int(asked[2]), len(data) - 1)
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {first}-{last}/{len(data)}")
            body = data[first : last + 1]
        else:
            self.send_response(200)
            body = data
        self.send_header("Content-Length", str(len(body)))
        self.send_header("ETag", server.tag)
        self.send_header("Last-Modified", server.modified)
        self.end_headers()
        server.asked += 1
        if first_of(server) or len(body) < 2:
            self._send(body)
        elif server.breaks:
            server.breaks -= 1
            self._send(body[: len(body) // 2])
        elif server.stalls:
            server.stalls -= 1
            self._send(body[: len(body) // 2])
            time.sleep(server.silence)
        else:
            self._send(body)
        self.close_connection = True

    def _send(self, body):
        self.server.sent += len(body)
        self.wfile.write(body)
        self.wfile.flush()

    def log_message(self, *words):
        pass


def first_of(server):
    """Whether the first answers, of which the file's beginning is one, are still to be given."""
    return server.asked <= server.good


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, request, client_address):
        """Who asked has gone."""


@contextmanager
def serving(folder, *, ranges=True, breaks=0, stalls=0, silence=1.0, good=1, refusals=()):
    """Give a server of a folder's files: ``sent`` counts bytes of bodies, ``asked`` requests that were answered."""
    server = _Server(("127.0.0.1", 0), _Handler)
    server.folder, server.ranges, server.breaks, server.stalls = folder, ranges, breaks, stalls
    server.silence, server.good, server.refusals, server.tag = silence, good, list(refusals), '"1"'
    server.modified = ""
    server.sent = server.asked = 0
    server.url = f"http://127.0.0.1:{server.server_address[1]}"
    thread = threading.Thread(target=server.serve_forever, args=(0.02,), daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()

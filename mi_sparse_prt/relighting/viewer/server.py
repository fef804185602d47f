"""A page on the loopback, for this machine alone: under an address that nobody guesses, and for no other site.

What the page asks of Python comes as one POST after the other: it sends the next one when it has the answer, so that
neither side ever falls behind the other.
"""

from __future__ import annotations

import json
import secrets
import struct
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import urlsplit

from mi_sparse_prt.core.errors import PrtError

ADDRESS = "127.0.0.1"
NAMES = (ADDRESS, "localhost")
PATIENCE = 10.0  # seconds that a browser may take to ask, or to read
ASK = "ask"  # where questions go, beside the page
LONGEST = 1 << 28  # bytes of a question

Reply = Callable[[dict[str, Any], bytes], tuple[dict[str, Any], bytes]]


class PageServer(ThreadingHTTPServer):
    """Serves one page.

    Parameters
    ----------
    page : bytes
        HTML.
    port : int
        0 for any that is free.
    answer : callable, optional
        ``answer(question, content)`` gives a header and bytes (``Answers.reply``).

    Attributes
    ----------
    url : str
        With a token that others cannot know.

    Raises
    ------
    PrtError
        If the port is taken or not allowed.
    """

    daemon_threads = True

    def __init__(self, page: bytes, port: int = 0, answer: Reply | None = None) -> None:
        self.page, self.answer, self._token = page, answer, secrets.token_urlsafe(16)
        try:
            super().__init__((ADDRESS, port), _Answer)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise PrtError(f"port {port}: {reason.lower()}; give another --port, or 0 for any") from None
        self.url = f"http://{ADDRESS}:{self.server_address[1]}/{self._token}/"

    def refusal(
        self, path: str, host: str | None, origin: str | None, asks: bool = False
    ) -> HTTPStatus | None:
        """Why a request is not answered; None if it is."""
        port = self.server_address[1]
        ours = [f"{name}:{port}" for name in NAMES]
        if host not in ours or (origin is not None and origin not in [f"http://{name}" for name in ours]):
            return HTTPStatus.FORBIDDEN  # another site's script, or another name of this machine
        ours_alone = f"/{self._token}/{ASK if asks else ''}"
        return None if secrets.compare_digest(path.encode(), ours_alone.encode()) else HTTPStatus.NOT_FOUND


class _Answer(BaseHTTPRequestHandler):
    """Of one request: the page, what it asks, or no."""

    server: PageServer
    timeout = PATIENCE
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._page(self.wfile.write)

    def do_HEAD(self) -> None:
        self._page(lambda content: None)

    def do_POST(self) -> None:
        """A question: the length of its header, the header in JSON, and bytes. The answer is the same."""
        refusal, answer = self._refusal(asks=True), self.server.answer
        words = self.headers.get("Content-Length", "")
        length = int(words) if words.isdecimal() else LONGEST + 1
        if refusal is not None or answer is None or length > LONGEST:
            refusal = refusal or HTTPStatus.BAD_REQUEST
            self.close_connection = True  # the question itself is not read
            return self._send(refusal.phrase.encode(), refusal, "text/plain", self.wfile.write)
        content = _answered(answer, self.rfile.read(length))
        self._send(content, HTTPStatus.OK, "application/octet-stream", self.wfile.write)

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal belongs to the command."""

    def _refusal(self, asks: bool) -> HTTPStatus | None:
        path, headers = urlsplit(self.path).path, self.headers
        return self.server.refusal(path, headers.get("Host"), headers.get("Origin"), asks)

    def _page(self, write: Callable[[bytes], object]) -> None:
        refusal = self._refusal(asks=False)
        if refusal is None:
            self._send(self.server.page, HTTPStatus.OK, "text/html; charset=utf-8", write)
        else:
            self._send(refusal.phrase.encode(), refusal, "text/plain", write)

    def _send(self, content: bytes, status: HTTPStatus, kind: str, write: Callable[[bytes], object]) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Connection", "close")  # nobody keeps a thread of a server that is closed
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")  # the token stays here
        self.end_headers()
        try:
            write(content)
        except OSError:
            self.close_connection = True  # the browser went away, or stopped reading


def _answered(answer: Reply, asked: bytes) -> bytes:
    """A question in bytes, answered in bytes."""
    try:
        (length,) = struct.unpack_from("<I", asked)
        question = dict(json.loads(struct.unpack_from(f"{length}s", asked, 4)[0]))
    except (struct.error, ValueError, TypeError):
        header, content = {"error": "this is no question of a page"}, b""
    else:
        header, content = answer(question, asked[4 + length :])
    words = json.dumps(header).encode()
    return struct.pack("<I", len(words)) + words + content

"""A page on the loopback, for this machine alone: under an address that nobody guesses, and for no other site."""

from __future__ import annotations

import secrets
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlsplit

from mi_sparse_prt.core.errors import PrtError

ADDRESS = "127.0.0.1"
NAMES = (ADDRESS, "localhost")
PATIENCE = 10.0  # seconds that a browser may take to ask


class PageServer(ThreadingHTTPServer):
    """Serves one page.

    Parameters
    ----------
    page : bytes
        HTML.
    port : int
        0 for any that is free.

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

    def __init__(self, page: bytes, port: int = 0) -> None:
        self.page, self._token = page, secrets.token_urlsafe(16)
        try:
            super().__init__((ADDRESS, port), _Answer)
        except (OSError, OverflowError) as error:
            reason = getattr(error, "strerror", None) or str(error)
            raise PrtError(f"port {port}: {reason.lower()}; give another --port, or 0 for any") from None
        self.url = f"http://{ADDRESS}:{self.server_address[1]}/{self._token}/"

    def refusal(self, path: str, host: str | None, origin: str | None) -> HTTPStatus | None:
        """Why a request is not answered; None if it is."""
        port = self.server_address[1]
        ours = [f"{name}:{port}" for name in NAMES]
        if host not in ours or (origin is not None and origin not in [f"http://{name}" for name in ours]):
            return HTTPStatus.FORBIDDEN  # another site's script, or another name of this machine
        return (
            None
            if secrets.compare_digest(path.encode(), f"/{self._token}/".encode())
            else HTTPStatus.NOT_FOUND
        )


class _Answer(BaseHTTPRequestHandler):
    """Of one request: the page, or no."""

    server: PageServer
    timeout = PATIENCE
    protocol_version = "HTTP/1.1"

    def do_GET(self) -> None:
        self._answer(self.wfile.write)

    def do_HEAD(self) -> None:
        self._answer(lambda content: None)

    def log_message(self, *_: object) -> None:
        """Say nothing: the terminal belongs to the command."""

    def _answer(self, write: Callable[[bytes], object]) -> None:
        path = urlsplit(self.path).path
        refusal = self.server.refusal(path, self.headers.get("Host"), self.headers.get("Origin"))
        content = self.server.page if refusal is None else refusal.phrase.encode()
        self.send_response(refusal or HTTPStatus.OK)
        self.send_header("Content-Type", "text/html; charset=utf-8" if refusal is None else "text/plain")
        self.send_header("Content-Length", str(len(content)))
        self.send_header("Cache-Control", "no-store")
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Referrer-Policy", "no-referrer")  # the token stays here
        self.end_headers()
        try:
            write(content)
        except OSError:
            self.close_connection = True  # the browser went away

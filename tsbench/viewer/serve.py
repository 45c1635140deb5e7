"""The live view: a small local server that plays an episode and serves its page.

The page is the same as in a file, and has a form for a push besides. For a request of
`/?push=100N@0.5s:+y` the server plays the episode again with that push.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlencode, urlsplit

from tsbench.core.errors import TsbenchError

HOST = "127.0.0.1"  # other machines cannot connect
KEPT = 8  # pages kept in memory, so that reloading one is quick

Render = Callable[[str | None], str]  # makes the page for a push in words, or for None


def server(render: Render, port: int) -> ThreadingHTTPServer:
    """A server of pages, to be run with `serve_forever`.

    Args:
        render: makes a page; the server answers its TsbenchErrors as text.
        port: the port to listen on, 0 for any free one.

    Raises:
        TsbenchError: the port is taken.
    """
    kept = lru_cache(KEPT)(render)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked = urlsplit(self.path)
            if asked.path != "/":
                self._answer(HTTPStatus.NOT_FOUND, "text/plain", "there is only one page: /")
                return
            push = parse_qs(asked.query).get("push", [None])[0]
            try:
                self._answer(HTTPStatus.OK, "text/html", kept(push))
            except TsbenchError as error:
                self._answer(HTTPStatus.BAD_REQUEST, "text/plain", str(error))

        def _answer(self, status: HTTPStatus, kind: str, text: str) -> None:
            content = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Logs nothing, to keep the user's terminal free."""

    try:
        return ThreadingHTTPServer((HOST, port), Handler)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TsbenchError(f"cannot listen on port {port}: {reason}") from None


def address(running: ThreadingHTTPServer, push: str | None) -> str:
    """The address of the page."""
    query = f"?{urlencode({'push': push})}" if push else ""
    return f"http://{HOST}:{running.server_address[1]}/{query}"

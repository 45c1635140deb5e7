"""The live view: a small server on this machine that plays an episode and hands out its page.

The page is the same as the one in a file, with one thing more: asked for `/?push=100N@0.5s:+y` the
server plays the episode again with that push.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import parse_qs, urlencode, urlsplit

from tsbench.core.errors import TsbenchError

HOST = "127.0.0.1"  # nobody else's machine
KEPT = 8  # pages, so that reloading one is quick

Render = Callable[[str | None], str]  # a push as people write it, or None -> the page


def server(render: Render, port: int) -> ThreadingHTTPServer:
    """A server of pages, to be run with `serve_forever`.

    Args:
        render: makes a page; what it raises as TsbenchError the reader is told.
        port: to listen on, 0 for any that is free.

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
            """Nothing: the terminal belongs to the user."""

    try:
        return ThreadingHTTPServer((HOST, port), Handler)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TsbenchError(f"cannot listen on port {port}: {reason}") from None


def address(running: ThreadingHTTPServer, push: str | None) -> str:
    """Where the page is to be seen."""
    query = f"?{urlencode({'push': push})}" if push else ""
    return f"http://{HOST}:{running.server_address[1]}/{query}"

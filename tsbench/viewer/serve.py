"""The live view: a small local server that plays an episode and serves its page.

The page is the same as in a file, and has a form for a push besides. For a request of
`/?push=100N@0.5s:+y` the server plays the episode again with that push.

Pages of other sites are refused, which a browser would let order pushes here: by the Host header,
which names the site that the browser believes it talks to, and by Sec-Fetch-Site.
"""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from functools import lru_cache
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, quote, urlencode, urlsplit

from tsbench.core.errors import TsbenchError

HOST = "127.0.0.1"  # other machines cannot connect
HTTP_PORT = 80  # which browsers leave out of the Host header
KEPT = 8  # pages kept in memory, so that reloading one is quick
WAITING = 8  # requests that may wait for a page

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
    rendering, waiting = threading.Lock(), threading.Semaphore(WAITING)

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            if problem := self._foreign():
                self._answer(HTTPStatus.FORBIDDEN, "text/plain", problem)
                return
            if not waiting.acquire(blocking=False):
                self._answer(HTTPStatus.SERVICE_UNAVAILABLE, "text/plain", "too many requests")
                return
            try:
                self._get()
            finally:
                waiting.release()

        def _foreign(self) -> str:
            """Why the request is another site's, or "" if it is none."""
            names = [f"{name}:{listening.server_port}" for name in (HOST, "localhost")]
            if listening.server_port == HTTP_PORT:
                names += [HOST, "localhost"]
            if self.headers.get("Host") not in names:
                return f"this server is {names[0]}"
            asker = self.headers.get("Sec-Fetch-Site", "none")
            return "" if asker in ("none", "same-origin") else "pages of other sites are refused"

        def _get(self) -> None:
            asked = urlsplit(self.path)
            if asked.path != "/":
                self._answer(HTTPStatus.NOT_FOUND, "text/plain", "there is only one page: /")
                return
            # A plus sign is one, as in +y, and not a space as in the words of forms.
            push = parse_qs(asked.query.replace("+", "%2B")).get("push", [None])[0]
            try:
                with rendering:  # who asks for the same page meanwhile finds it made
                    page = kept(push)
            except TsbenchError as error:
                self._answer(HTTPStatus.BAD_REQUEST, "text/plain", str(error))
                return
            self._answer(HTTPStatus.OK, "text/html", page)

        def _answer(self, status: HTTPStatus, kind: str, text: str) -> None:
            content = text.encode()
            self.send_response(status)
            self.send_header("Content-Type", f"{kind}; charset=utf-8")
            self.send_header("Content-Length", str(len(content)))
            self.end_headers()
            self.wfile.write(content)

        def log_message(self, *_: object) -> None:
            """Logs nothing, to keep the user's terminal free."""

    class Server(ThreadingHTTPServer):
        def server_close(self) -> None:
            """Waits for the page in the making, and lets no other begin: a process that ends while
            a thread of it renders ends by a segmentation fault."""
            super().server_close()
            rendering.acquire()

        def handle_error(self, request: Any, client_address: Any) -> None:
            if not isinstance(sys.exception(), ConnectionError):  # the browser has left
                super().handle_error(request, client_address)

    try:
        listening = Server((HOST, port), Handler)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise TsbenchError(f"cannot listen on port {port}: {reason}") from None
    return listening


def address(running: ThreadingHTTPServer, push: str | None) -> str:
    """The address of the page."""
    query = f"?{urlencode({'push': push}, quote_via=quote)}" if push else ""
    return f"http://{HOST}:{running.server_address[1]}/{query}"

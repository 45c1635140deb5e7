"""The live view: an address, a page, and the episode played again with a push."""

from __future__ import annotations

import http.client
import re
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tsbench.core.errors import TsbenchError
from tsbench.viewer import serve


def fetch(url: str) -> tuple[int, str]:
    try:
        with urllib.request.urlopen(url, timeout=60) as answer:
            return answer.status, answer.read().decode()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode()


def render(push: str | None) -> str:
    if push == "bad":
        raise TsbenchError("cannot read the push 'bad'")
    return f"<p>{push}</p>"


@contextmanager
def running(render: serve.Render) -> Iterator[str]:
    server = serve.server(render, 0)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield serve.address(server, None)
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_page_with_or_without_a_push() -> None:
    with running(render) as url:
        assert fetch(url) == (200, "<p>None</p>")
        assert fetch(f"{url}?push=100N%400.5s%3A%2By") == (200, "<p>100N@0.5s:+y</p>")
        assert fetch(f"{url}?push=100N@0.5s:+y") == (200, "<p>100N@0.5s:+y</p>")
        assert fetch(f"{url}?push=bad") == (400, "cannot read the push 'bad'")
        assert fetch(f"{url}favicon.ico")[0] == 404


def test_other_sites_cannot_order_pages() -> None:
    """By a name of theirs that leads here (DNS rebinding), or by a link or form."""
    with running(render) as url:
        for headers in ({"Host": "evil.example"}, {"Sec-Fetch-Site": "cross-site"}):
            asked = urllib.request.Request(f"{url}?push=100N%400.5s%3A%2By", headers=headers)
            with pytest.raises(urllib.error.HTTPError, match="403"):
                urllib.request.urlopen(asked, timeout=60)
        same = urllib.request.Request(url, headers={"Sec-Fetch-Site": "same-origin"})
        assert urllib.request.urlopen(same, timeout=60).status == 200


def test_the_address_of_a_push_with_spaces() -> None:
    with running(render) as url, serve.server(render, 0) as other:
        asked = serve.address(other, "9N @ 1s : +y").partition("?")[2]
        assert fetch(f"{url}?{asked}") == (200, "<p>9N @ 1s : +y</p>")


def test_browsers_leave_out_the_port_of_http(monkeypatch: pytest.MonkeyPatch) -> None:
    with running(render) as url:
        asked = urllib.request.Request(url, headers={"Host": "127.0.0.1"})
        with pytest.raises(urllib.error.HTTPError, match="403"):
            urllib.request.urlopen(asked, timeout=60)
        monkeypatch.setattr(serve, "HTTP_PORT", int(url.split(":")[2].strip("/")))
        assert urllib.request.urlopen(asked, timeout=60).status == 200


def test_one_page_for_all_who_ask_at_once() -> None:
    made: list[str | None] = []

    def slow(push: str | None) -> str:
        made.append(push)
        time.sleep(0.3)
        return "page"

    with running(slow) as url, ThreadPoolExecutor(20) as pool:
        answers = list(pool.map(fetch, [url] * 20))
    assert made == [None]
    assert {status for status, _ in answers} <= {200, 503}
    assert (200, "page") in answers


@pytest.mark.parametrize("said", ["", "GET /", "GET / HTTP/1.1\r\nHost: {}\r\n\r\n"])
def test_a_browser_that_leaves_early(said: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Before it has asked, or while its page is made: the others are served, nothing is said."""
    left, asked = threading.Event(), []

    def slowly(push: str | None) -> str:
        asked.append(push)
        left.wait(60.0)
        return "x" * 5_000_000

    with running(slowly) as url:
        host = url.split("/")[2]
        name, port = host.split(":")
        with socket.create_connection((name, int(port))) as connection:
            connection.sendall(said.format(host).encode())
            deadline = time.monotonic() + 60.0
            while said.endswith("\n") and not asked and time.monotonic() < deadline:
                time.sleep(0.01)
            # Closed so that the server's next read or write is an error.
            linger = struct.pack("ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        left.set()
        status, page = fetch(url)
    assert (status, len(page)) == (200, 5_000_000)
    assert capfd.readouterr().err == ""


def test_closing_waits_for_the_page_in_the_making() -> None:
    began, ended = threading.Event(), threading.Event()

    def slow(_: str | None) -> str:
        began.set()
        time.sleep(0.3)
        ended.set()
        return "page"

    with running(slow) as url:
        threading.Thread(target=fetch, args=(url,)).start()
        assert began.wait(60)
    assert ended.is_set()


def test_a_page_is_made_once() -> None:
    made: list[str | None] = []

    def count(push: str | None) -> str:
        made.append(push)
        return "page"

    with running(count) as url:
        assert [fetch(url)[1], fetch(url)[1]] == ["page", "page"]
    assert made == [None]


def test_a_port_that_is_taken() -> None:
    first = serve.server(render, 0)
    port = first.server_address[1]
    with first, pytest.raises(TsbenchError, match=f"cannot listen on port {port}: Address already"):
        serve.server(render, port)


@pytest.mark.parametrize("wait", [None, 0.02, 0.3])
def test_the_command_says_where_and_ends_at_ctrl_c(
    wait: float | None, make_run: Callable[..., Path], tmp_path: Path
) -> None:
    """After a page was fetched, and while one is made: so many seconds after it was asked for."""

    def leave(url: str) -> None:
        with suppress(OSError, http.client.HTTPException):
            fetch(url)

    run = make_run("laikago_trot")
    words = ["view", str(run), "--push", "60N@0.5s:+y"]
    with subprocess.Popen(
        [sys.executable, "-m", "tsbench", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        # A shell starts a background process with Ctrl-C ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    ) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            found = re.match(r"(http://127\.0\.0\.1:\d+/\?push=60N%400\.5s%3A%2By) \(Ctrl-C", line)
            assert found, line
            if wait is None:
                status, text = fetch(found[1])
                assert status == 200
                assert "<b>push</b>" in text  # the legend
                assert '"served": true' in text
            else:
                threading.Thread(target=leave, args=(found[1],)).start()
                time.sleep(wait)
            process.send_signal(signal.SIGINT)
            _, errors = process.communicate(timeout=60)
        finally:
            process.kill()  # otherwise the end of the context waits for it
    assert (process.returncode, errors) == (0, "")

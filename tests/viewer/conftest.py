"""Fixtures of the viewer's tests: runs made without training, and a browser."""

from __future__ import annotations

import base64
import ctypes
import io
import itertools
import json
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from tsbench import tasks
from tsbench.core.files import write_json
from tsbench.core.motion import Plan, ReferenceMotion
from tsbench.core.policy import Policy, PolicyInfo
from tsbench.runs.directory import Record
from tsbench.sim.model import fingerprint

WIDTH, HEIGHT = 1000, 560
PATIENCE = 120.0  # s
SCREENSHOTS = Path(__file__).parents[2] / "screenshots"  # kept, for people to look at
DRAWN = """new Promise((done) => {
  const frames = (count) => requestAnimationFrame(() => count ? frames(count - 1) : done());
  if (document.readyState === "complete") frames(4); else addEventListener("load", () => frames(4));
})"""


SPEECH = ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded")


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "browser: opens a page in headless Chromium")


def steady(name: str, *action: float) -> Policy:
    """A policy for the task with a constant action."""
    task = tasks.make(name)
    layers = (task.observation_size, 1, task.action_size)
    info = PolicyInfo(name, task.version, fingerprint(task.spec()), "none", "tanh", layers)
    return Policy(
        info,
        mean=np.zeros(layers[0], np.float32),
        scale=np.ones(layers[0], np.float32),
        weights=(np.zeros((1, layers[0]), np.float32), np.zeros((layers[2], 1), np.float32)),
        biases=(
            np.zeros(1, np.float32),
            np.resize(np.array(action or (0.0,), np.float32), layers[2]),
        ),
    )


@pytest.fixture
def make_run(
    tmp_path: Path,
    naive_plan: Callable[[str], Plan],
    naive_reference: Callable[[str], ReferenceMotion],
    invented_record: Callable[[str], Record],
) -> Callable[..., Path]:
    """A function that makes a run directory with the hand-made plan and a constant policy."""

    def make(name: str, *action: float, directory: str = "run") -> Path:
        path = tmp_path / directory
        path.mkdir()
        steady(name, *action).save(path)
        naive_plan(name).save(path / "plan.npz")
        naive_reference(name).save(path / "reference.npz")
        write_json(path / "score.json", invented_record(name).as_dict())
        rows = [
            {"stage": "plan", "steps": 100 * i, "seconds": i, "episode_return": i} for i in range(5)
        ]
        (path / "metrics.jsonl").write_text("\n".join(map(json.dumps, rows)))
        return path

    return make


class Browser:
    """Headless Chromium with software WebGL, controlled by its DevTools protocol.

    Chromium's flags --virtual-time-budget and --screenshot are not used: on a busy machine its
    virtual time sometimes stops for good.
    """

    def __init__(self, connection: ClientConnection) -> None:
        self._connection = connection
        self._calls = itertools.count(1)
        self._session: str | None = None  # of the open page
        self._heard: str | None = None  # of the page whose messages are kept
        self._spoken: list[str] = []

    def call(self, method: str, **parameters: Any) -> Any:
        """Sends a command and returns its result; keeps the page's messages that arrive before."""
        number = next(self._calls)
        message = {"id": number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        self._connection.send(json.dumps(message))
        while True:
            answer = json.loads(self._connection.recv(PATIENCE))
            if answer.get("id") == number:
                assert "error" not in answer, answer
                return answer["result"]
            if answer.get("method") in SPEECH and answer.get("sessionId") == self._heard:
                self._spoken.append(json.dumps(answer["params"]))

    @contextmanager
    def open(
        self, url: str, size: tuple[int, int] = (WIDTH, HEIGHT), *, dark: bool = False
    ) -> Iterator[None]:
        """Opens a page and waits until it is drawn. A console message then fails the test. Narrow
        screens are those of phones."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = self._heard = session["sessionId"]
        self._spoken = []
        try:
            for domain in ("Page", "Runtime", "Log"):
                self.call(f"{domain}.enable")
            screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1}
            self.call("Emulation.setDeviceMetricsOverride", **screen, mobile=size[0] < 500)
            scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
            self.call("Emulation.setEmulatedMedia", features=[scheme])
            self.call("Page.navigate", url=url)
            self.ask(DRAWN)
            yield
        finally:
            self._session = None
            self.call("Target.closeTarget", targetId=target)
        # Chromium itself writes this line about the screenshot.
        assert not [line for line in self._spoken if "GPU stall due to ReadPixels" not in line]

    def go(self, address: str) -> None:
        """Changes what stands behind the # of the page's address, and waits until it is drawn."""
        self.ask(f"location.hash = {json.dumps(address)}")
        self.ask(DRAWN)

    def ask(self, expression: str) -> Any:
        """The value of an expression in the page; waits for a promise."""
        result = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def screenshot(self, name: str) -> NDArray[np.int64]:
        """A screenshot of the page, saved under that name, shape (rows, columns, 3)."""
        content = base64.b64decode(self.call("Page.captureScreenshot")["data"])
        SCREENSHOTS.mkdir(exist_ok=True)
        (SCREENSHOTS / f"{name}.png").write_bytes(content)
        return np.asarray(Image.open(io.BytesIO(content)).convert("RGB"), np.int64)

    def picture(self, path: Path, address: str) -> NDArray[np.int64]:
        """A screenshot of a page's picture in 3-D, shape (rows, columns, 3)."""
        with self.open(f"{path.as_uri()}#{address}"):
            name = f"{path.stem}_{re.sub('[^a-z0-9]+', '_', address)}"
            box = self.ask("document.getElementById('stage').getBoundingClientRect().toJSON()")
            whole = self.screenshot(name)
            return whole[round(box["top"]) : round(box["bottom"]), round(box["left"]) :]


def _end_with_parent() -> None:
    """Has Linux end this process when the tests end, even if they are killed."""
    ctypes.CDLL(None).prctl(1, signal.SIGKILL)  # 1: PR_SET_PDEATHSIG


@pytest.fixture(scope="package")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    programs = [program for name in names if (program := shutil.which(name))]
    if not programs:
        pytest.fail("no Chromium on PATH: install `chromium` (Debian) or Google Chrome")
    profile = tmp_path_factory.mktemp("chromium")
    command = [
        *(programs[0], "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic"),
        *("--no-first-run", "--disable-background-networking", "--disable-component-update"),
        *("--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
        *("--hide-scrollbars", "--force-device-scale-factor=1", f"--user-data-dir={profile}"),
        *("--remote-debugging-port=0", "about:blank"),
    ]
    quiet = subprocess.DEVNULL
    with subprocess.Popen(
        command, stdout=quiet, stderr=quiet, start_new_session=True, preexec_fn=_end_with_parent
    ) as process:
        try:
            port = profile / "DevToolsActivePort"  # its port, then the path of its socket
            deadline = time.monotonic() + PATIENCE
            while not (port.exists() and port.read_text().count("\n")):
                assert process.poll() is None, "Chromium ended at once"
                assert time.monotonic() < deadline, "Chromium did not start"
                time.sleep(0.1)
            number, path = port.read_text().splitlines()
            with connect(f"ws://127.0.0.1:{number}{path}", max_size=None, proxy=None) as connection:
                yield Browser(connection)
        finally:
            with suppress(ProcessLookupError):  # it has ended at once
                os.killpg(process.pid, signal.SIGKILL)  # with all its children

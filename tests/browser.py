"""A browser without a screen, driven through its own debugging protocol: what a page shows, and what keys do to it."""

import base64
import contextlib
import io
import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from websockets.sync.client import ClientConnection, connect

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
FLAGS = ("--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run")


class Page:
    """One page of the browser."""

    def __init__(self, connection: ClientConnection) -> None:
        self._connection, self._number = connection, 0

    def call(self, method: str, **parameters: Any) -> Any:
        """One command of the protocol, and what came of it."""
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=60))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def picture(self) -> np.ndarray:
        """What the page shows, (height, width, 3)."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def press(self, key: str, code: int) -> None:
        """Press and release a key, for long enough that a frame is drawn in between."""
        names = {"key": key, "code": key, "windowsVirtualKeyCode": code, "nativeVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", **names)
        time.sleep(0.3)
        self.call("Input.dispatchKeyEvent", type="keyUp", **names)

    def mouse(self, kind: str, x: float, y: float, **more: Any) -> None:
        """Move, press or release the mouse at x, y pixels."""
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


@contextlib.contextmanager
def browser(url: str, profile: Path, *, size: tuple[int, int] = (800, 560)) -> Iterator[Page]:
    """Opens `url`; the browser ends with the block."""
    assert CHROMIUM is not None
    window = f"--window-size={size[0]},{size[1]}"
    command = [CHROMIUM, *FLAGS, window, f"--user-data-dir={profile}", "--remote-debugging-port=0", url]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            told, until = profile / "DevToolsActivePort", time.monotonic() + 60
            while not (told.exists() and told.read_text().count("\n")):
                assert time.monotonic() < until, "the browser did not start"
                assert process.poll() is None, "the browser ended"
                time.sleep(0.1)
            port, endpoint = told.read_text().split()
            whole = Page(connect(f"ws://127.0.0.1:{port}{endpoint}", max_size=None))
            page = next(one for one in whole.call("Target.getTargets")["targetInfos"] if one["type"] == "page")
            with connect(f"ws://127.0.0.1:{port}/devtools/page/{page['targetId']}", max_size=None) as connection:
                yield Page(connection)
        finally:
            process.kill()

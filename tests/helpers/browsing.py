"""A headless browser, driven through its debugging protocol: what a page shows, and how it reacts to keys."""

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
        """Send one command of the protocol; its result."""
        self._number += 1
        self._connection.send(json.dumps({"id": self._number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(self._connection.recv(timeout=600))
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]

    def picture(self) -> np.ndarray:
        """What the page shows, (height, width, 3)."""
        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"))

    def press(self, key: str, code: int) -> None:
        """Press a key for long enough that a frame is drawn, and release it."""
        names = {"key": key, "code": key, "windowsVirtualKeyCode": code, "nativeVirtualKeyCode": code}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", **names)
        time.sleep(0.3)
        self.call("Input.dispatchKeyEvent", type="keyUp", **names)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Move the mouse from one pixel to another with Ctrl and its right button held."""
        control = {"key": "Control", "code": "ControlLeft", "windowsVirtualKeyCode": 17, "nativeVirtualKeyCode": 17}
        self.call("Input.dispatchKeyEvent", type="rawKeyDown", modifiers=2, **control)
        held = {"button": "right", "buttons": 2}
        self._mouse("mouseMoved", start, buttons=0)
        self._mouse("mousePressed", start, clickCount=1, **held)
        for part in np.linspace(0, 1, 9):
            self._mouse("mouseMoved", tuple((1 - part) * np.array(start) + part * np.array(end)), **held)
        self._mouse("mouseReleased", end, clickCount=1, **held)
        self.call("Input.dispatchKeyEvent", type="keyUp", **control)

    def pictures(self) -> Iterator[np.ndarray]:
        """What the page shows, once it draws a scene, and from then on each picture that differs."""
        last, until = self.picture(), time.monotonic() + 600
        while time.monotonic() < until:
            picture = self.picture()
            # Before the scene is there the page is dark; colours are what the scene has.
            if np.ptp(picture.reshape(-1, 3), axis=0).min() > 150 and (picture != last).any():
                yield picture
            last = picture
            time.sleep(0.3)

    def _mouse(self, kind: str, place: tuple[float, ...], **more: Any) -> None:
        where = {"x": float(place[0]), "y": float(place[1]), "modifiers": 2}
        self.call("Input.dispatchMouseEvent", type=kind, **where, **more)
        time.sleep(0.25)  # for as long as a frame may take to draw


@contextlib.contextmanager
def browser(url: str, profile: Path, *, size: tuple[int, int] = (800, 560)) -> Iterator[Page]:
    """Open `url`; the browser is closed at the end of the block."""
    assert CHROMIUM is not None
    window = f"--window-size={size[0]},{size[1]}"
    command = [CHROMIUM, *FLAGS, window, f"--user-data-dir={profile}", "--remote-debugging-port=0", url]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as process:
        try:
            told, until = profile / "DevToolsActivePort", time.monotonic() + 600
            while not (told.exists() and told.read_text().count("\n")):
                assert time.monotonic() < until, "the browser did not start"
                assert process.poll() is None, "the browser ended"
                time.sleep(0.1)
            port, endpoint = told.read_text().split()
            with connect(f"ws://127.0.0.1:{port}{endpoint}", max_size=None) as connection:
                targets = Page(connection).call("Target.getTargets")["targetInfos"]
            page = next(target for target in targets if target["type"] == "page")
            with connect(f"ws://127.0.0.1:{port}/devtools/page/{page['targetId']}", max_size=None) as connection:
                yield Page(connection)
        finally:
            process.kill()

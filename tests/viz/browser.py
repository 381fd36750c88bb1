"""A small driver for a headless Chromium, over a pair of pipes.

It speaks the DevTools protocol with nothing but the standard library, and keeps what
a test wants to know of a page: errors, requests, pictures.
"""

from __future__ import annotations

import base64
import fcntl
import io
import json
import os
import select
import subprocess
import sys
import tempfile
import time
from typing import Any

import numpy as np

_LAUNCH = (
    "import os, sys; os.dup2(int(sys.argv[1]), 3); os.dup2(int(sys.argv[2]), 4); "
    "os.execv(sys.argv[3], sys.argv[3:])"
)
_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--remote-debugging-pipe",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)


class Browser:
    """One browser with one page; use it as a context manager."""

    def __init__(self, chromium: str) -> None:
        self.chromium = chromium

    def __enter__(self) -> Browser:
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_read, self.write_end = os.pipe()
        self.read_end, to_write = os.pipe()
        # High numbers, so that moving them to 3 and 4 cannot overwrite one another.
        ends = [fcntl.fcntl(fd, fcntl.F_DUPFD, 20) for fd in (to_read, to_write)]
        self.process = subprocess.Popen(
            [
                *(sys.executable, "-c", _LAUNCH, *map(str, ends)),
                *(self.chromium, *_FLAGS),
                f"--user-data-dir={self.profile.name}",
                "about:blank",
            ],
            pass_fds=ends,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        for fd in (to_read, to_write, *ends):
            os.close(fd)
        self.unread = b""
        self.number = 0
        self.session: str | None = None
        self.errors: list[str] = []
        self.requests: list[str] = []
        targets = self.send("Target.getTargets")["targetInfos"]
        page = next(t["targetId"] for t in targets if t["type"] == "page")
        attached = self.send("Target.attachToTarget", targetId=page, flatten=True)
        self.session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")
        return self

    def __exit__(self, *_: object) -> None:
        self.session = None
        try:
            self.send("Browser.close")
            self.process.wait(timeout=10)
        except (OSError, TimeoutError, subprocess.TimeoutExpired):
            self.process.kill()
            self.process.wait()
        finally:
            os.close(self.read_end)
            os.close(self.write_end)
            self.profile.cleanup()

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Sends a command and returns its result; notes events that come meanwhile."""
        self.number += 1
        message: dict[str, Any] = {"id": self.number, "method": method}
        message["params"] = params
        if self.session:
            message["sessionId"] = self.session
        os.write(self.write_end, json.dumps(message).encode() + b"\0")
        while (answer := self._receive()).get("id") != self.number:
            self._note(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']}")
        return answer["result"]

    def _receive(self) -> dict[str, Any]:
        deadline = time.monotonic() + 60
        while b"\0" not in self.unread:
            left = max(0.0, deadline - time.monotonic())
            if not select.select([self.read_end], [], [], left)[0]:
                raise TimeoutError("the browser did not answer within 60 s")
            part = os.read(self.read_end, 1 << 20)
            if not part:
                raise ConnectionError("the browser closed the connection")
            self.unread += part
        line, self.unread = self.unread.split(b"\0", 1)
        return json.loads(line)

    def _note(self, event: dict[str, Any]) -> None:
        method, params = event.get("method"), event.get("params", {})
        if method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])
        elif method == "Runtime.exceptionThrown":
            self.errors.append(json.dumps(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled":
            self.errors.append(json.dumps(params["args"]))
        elif method == "Log.entryAdded":
            entry = params["entry"]
            # Chromium remarks on pictures read back from its software renderer.
            if "GPU stall due to ReadPixels" not in entry["text"]:
                self.errors.append(entry["text"])

    def look(self, *, width: int, height: int, dark: bool, still: bool = True) -> None:
        """Sets the size of the window [pixels] and what the reader prefers."""
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )
        preferences = {
            "prefers-color-scheme": "dark" if dark else "light",
            "prefers-reduced-motion": "reduce" if still else "no-preference",
        }
        features = [{"name": k, "value": v} for k, v in preferences.items()]
        self.send("Emulation.setEmulatedMedia", features=features)

    def open(self, url: str) -> None:
        """Opens a page and waits until it shows its clock."""
        self.send("Page.navigate", url=url)
        self.wait("document.querySelector('#clock')?.textContent.length > 0")

    def run(self, script: str) -> Any:
        """Evaluates a script in the page and returns its value."""
        result = self.send(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        if "exceptionDetails" in result:
            raise RuntimeError(json.dumps(result["exceptionDetails"]))
        return result["result"].get("value")

    def wait(self, condition: str, seconds: float = 20.0) -> None:
        """Waits until a script is true."""
        deadline = time.monotonic() + seconds
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > deadline:
                raise TimeoutError(f"still false after {seconds} s: {condition}")
            time.sleep(0.05)

    def settle(self) -> None:
        """Waits until the page has drawn what is due."""
        self.run(
            "new Promise(r => setTimeout(() => requestAnimationFrame(() => "
            "requestAnimationFrame(() => r(true))), 60))"
        )

    def press(self, key: str) -> None:
        """Presses and releases a key."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def drag(self, start: tuple[int, int], end: tuple[int, int]) -> None:
        """Drags with the left mouse button from one pixel to another."""
        common = {"button": "left", "buttons": 1, "clickCount": 1}
        for kind, (x, y) in (
            ("mousePressed", start),
            ("mouseMoved", end),
            ("mouseReleased", end),
        ):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **common)

    def picture(self) -> np.ndarray:
        """What the page looks like, (height, width, 3) uint8."""
        from matplotlib.image import imread

        self.settle()
        data = self.send("Page.captureScreenshot", format="png")["data"]
        pixels = imread(io.BytesIO(base64.b64decode(data)), format="png")
        return np.rint(255 * pixels[..., :3]).astype(np.uint8)

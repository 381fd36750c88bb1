"""Pictures per second of the live page, and the delay of a pull.

A client gets pictures over HTTP, with one connection for pictures and one for commands,
as a browser does. The scene is that of examples/live_arm.py, at rest. The delay is the
time from the start of a pull until the client has a picture in which the tip has moved
by 10 micrometres. In the browser it is the time from the event of the mouse to the
picture on the page, in milliseconds of the page's clock. Other programs slow this,
above all without a graphics card, so the benchmark prints the load of the machine.
"""

from __future__ import annotations

import argparse
import http.client
import json
import os
import random
import shutil
import statistics
import sys
import time
from collections.abc import Iterator
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks.shared.files import ROOT, example
from benchmarks.shared.page_tables import measured_table
from jaxrod import viz
from jaxrod.viz.interactive import HEAD as NUMBERS

PAGE = ROOT / "docs" / "live.md"
HEAD = (
    "| client | pictures per second | delay of a pull, median [ms] | largest [ms] "
    "| other processes per core |\n"
    "|---|---:|---:|---:|---:|"
)
SECONDS, PULLS, TIP, MOVED = 10.0, 40, 20, 1e-5
AWAY = (0.1, 0.0, 0.2)
CHROMIUM = ("chromium", "chromium-browser", "google-chrome", "chrome")
DELAY = """
new Promise((done) => {
  const live = window.live, start = live.recording.point(20, 0, 0);
  const drawNow = live.drawNow.bind(live);
  const [x, y] = live.onScreen(20), begin = performance.now();
  const event = (kind, x, y) => live.canvas.dispatchEvent(new PointerEvent(kind, {
    clientX: x, clientY: y, button: 0, buttons: 1, pointerId: 1, bubbles: true}));
  live.canvas.setPointerCapture = () => {};
  live.drawNow = () => {
    drawNow();
    if (length(subtract(live.recording.point(20, 0, 0), start)) < 1e-5) return;
    live.drawNow = drawNow;
    event("pointerup", x, y);
    done(performance.now() - begin);
  };
  const length = (a) => Math.hypot(...a);
  const subtract = (a, b) => a.map((x, k) => x - b[k]);
  event("pointerdown", x, y);
  event("pointermove", x + 60, y);
})
"""
DRAWN = """
new Promise((done) => {
  const live = window.live, drawNow = live.drawNow.bind(live);
  let count = 0;
  live.drawNow = () => { count += 1; drawNow(); };
  setTimeout(() => { live.drawNow = drawNow; done(count / 5); }, 5000);
})
"""


class Client:
    """A page without a browser."""

    def __init__(self, url: str) -> None:
        """Connects to the page at an address."""
        place = urlsplit(url).netloc
        self.pictures = http.client.HTTPConnection(place, timeout=10)
        self.commands = http.client.HTTPConnection(place, timeout=10)
        self.number = 0

    def picture(self) -> np.ndarray:
        """Position of the tip in the next picture [m]."""
        self.pictures.request("GET", f"/picture?after={self.number}")
        data = self.pictures.getresponse().read()
        self.number = int(np.frombuffer(data, "<f8", 1)[0])
        values = 6  # three sliders, and the target
        points = np.frombuffer(data, "<f4", offset=8 * (NUMBERS + values))
        return points[3 * TIP : 3 * TIP + 3]

    def do(self, command: dict[str, Any]) -> None:
        """Sends a command."""
        body = json.dumps(command)
        kind = {"Content-Type": "application/json"}
        self.commands.request("POST", "/do", body, kind)
        self.commands.getresponse().read()


def by_client(page: viz.Live) -> tuple[float, list[float]]:
    """Pictures per second, and delays of pulls [s]."""
    assert page.url is not None
    client = Client(page.url)
    client.picture()
    first, begin = client.number, time.perf_counter()
    while time.perf_counter() < begin + SECONDS:
        client.picture()
    rate = (client.number - first) / (time.perf_counter() - begin)
    delays, chance = [], random.Random(0)
    for _ in range(PULLS):
        client.do({"reset": True, "pull": None})
        until = time.perf_counter() + chance.uniform(0.1, 0.2)
        while time.perf_counter() < until:
            rest = client.picture()
        sent = time.perf_counter()
        client.do({"pull": {"node": TIP, "point": AWAY}})
        while np.linalg.norm(client.picture() - rest) < MOVED:
            pass
        delays.append(time.perf_counter() - sent)
    client.do({"reset": True, "pull": None})
    return rate, delays


def by_browser(page: viz.Live) -> tuple[float, list[float]]:
    """Drawn pictures per second, and delays of pulls [s]."""
    sys.path.insert(0, str(ROOT / "tests"))
    from viz.browser import Browser

    found = next(filter(None, map(shutil.which, CHROMIUM)), None)
    if found is None:
        raise ValueError("there is no Chromium here")
    with Browser(found) as browser:
        browser.look(width=1100, height=720, dark=False)
        assert page.url is not None
        browser.open(page.url)
        time.sleep(5.0)  # the page finds its resolution
        rate, delays = browser.run(DRAWN), []
        for _ in range(PULLS):
            page.do({"reset": True, "pull": None})
            time.sleep(0.3)
            delays.append(browser.run(DELAY) / 1000)
    return rate, delays


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the arguments."""
    parser.add_argument("--browser", action="store_true", help="measure a browser, too")
    parser.add_argument("--dry", action="store_true", help="leave the page as it is")


def rows(browser: bool) -> Iterator[str]:
    """Rows of the table."""
    arm = example("live_arm")
    clients = {"program": by_client}
    if browser:
        clients["headless Chromium, 1100 by 720, drawn by a processor"] = by_browser
    with viz.live(*arm.build(), arm.controls(), law=arm.follow, floor=0.0) as page:
        for name, measure in clients.items():
            others = os.getloadavg()[0] / (os.cpu_count() or 1)
            rate, delays = measure(page)
            middle, largest = statistics.median(delays), max(delays)
            times = f"{1e3 * middle:.0f} | {1e3 * largest:.0f}"
            yield f"| {name} | {rate:.0f} | {times} | {others:.1f} |"


def run(args: argparse.Namespace) -> int:
    """Measures, and writes the table."""
    measured_table(PAGE, "measured", HEAD, lambda: rows(args.browser), dry=args.dry)
    return 0

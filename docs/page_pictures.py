"""Make the pictures of the viewer's page in docs/images from the real ``body_tracking up`` in Chromium.

    python docs/page_pictures.py [NAME ...]

It plays shipped recordings slowly through the live graph, since software draws a frame in a second or so. The picture
of README.md moves, in the recording's own time. Pictures of the start page and of faults are made by tests
(docs/development.md).
"""

from __future__ import annotations

import argparse
import io
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
SIZE, MOVING_SIZE, MOVING_WIDTH = (1360, 820), (1280, 720), 800
"""Pixels of the page; the moving picture is made smaller."""
RATE = 0.1
"""Of the recording's time."""
LARGEST = 1_500_000
"""Bytes that README.md's picture may have."""
WAVE = ("--bag", "bags/tpose_wave", "--filter", "ekf", "--convention", "isb")
CAMERA = ("--bag", "bags/camera_reaching", "--camera", "camera1", "--compressed", "colour", "--filter", "ekf")
MESH = ("--bag", "bags/mesh_reaching", "--depth", "kinect1")
MARKERS = ("--sensors", "none", "--bag", "bags/markers_arm", "--marker-setup", "config/marker_setup")
PAGES = {
    "viewer": (WAVE, 11.0),
    "viewer_camera": (CAMERA, 7.0),
    "viewer_mesh": (MESH, 6.1),
    "viewer_markers": (MARKERS, 4.0),
}
"""Arguments of ``up``, and the seconds of the recording after which the picture is taken."""
MOVING, FIRST_S, LAST_S = "moving", 4.0, 12.0
"""From the T-pose into the wave."""


def address(file: Path, patience: float = 60.0) -> str:
    """Of the viewer, as ``up`` prints it."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if found := re.search(r"http://[\d.]+:\d+", file.read_text(encoding="utf-8", errors="replace")):
            return found[0]
        time.sleep(0.1)
    raise SystemExit(f"up printed no address of the viewer:\n{file.read_text(errors='replace')}")


@contextmanager
def graph_page(arguments: tuple[str, ...], size: tuple[int, int]) -> Iterator[Any]:
    """A page in playwright that shows ``body_tracking up`` with these arguments."""
    from playwright.sync_api import sync_playwright

    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no chromium here: apt-get install chromium")
    command = (sys.executable, "-m", "body_tracking.cli", "up", *arguments, "--rate", str(RATE), "--viewer")
    environment = {**os.environ, "PYTHONUNBUFFERED": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "up.txt"
        with log.open("wb") as file:
            graph = subprocess.Popen(
                [*command, "--log-dir", folder], stdout=file, stderr=file, env=environment, cwd=ROOT
            )
        try:
            url = address(log)
            with sync_playwright() as driver:
                software = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
                chromium = driver.chromium.launch(executable_path=browser, args=software, timeout=60e3)
                page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
                page.set_default_timeout(60e3)
                page.goto(f"{url}/?fixedDpr=1")
                yield page
                chromium.close()
        finally:
            graph.send_signal(signal.SIGINT)
            graph.wait(60)


def reach(page: Any, position: float) -> None:
    """Wait until the page says that the recording is there, and close its notes."""
    end = time.monotonic() + 60.0 + 2.0 * position / RATE
    while True:
        found = re.search(r"playing \S+ ([\d.]+) of", page.inner_text("body").replace(",", ""))
        if found and float(found[1]) >= position:
            break
        if time.monotonic() > end:
            raise SystemExit(f"the recording does not reach {position} s:\n{page.inner_text('body')}")
        page.wait_for_timeout(200)
    for note in page.locator(".mantine-Notification-closeButton").all():
        note.dispatch_event("click")


def still(name: str) -> None:
    """Make one of :data:`PAGES`."""
    arguments, position = PAGES[name]
    with graph_page(arguments, SIZE) as page:
        reach(page, position - 3.0 * RATE)
        page.wait_for_timeout(3e3)
        image = Image.open(io.BytesIO(page.screenshot(timeout=60e3))).convert("RGB")
    file = IMAGES / f"{name}.png"
    image.save(file, optimize=True)
    print(f"{file.relative_to(ROOT)}: {file.stat().st_size / 1e3:.0f} kB")


def moving() -> None:
    """Make the picture of README.md."""
    taken: list[tuple[float, Image.Image]] = []
    with graph_page(WAVE, MOVING_SIZE) as page:
        reach(page, FIRST_S - 3.0 * RATE)
        page.wait_for_timeout(3e3)
        start = time.monotonic()
        while (now := (time.monotonic() - start) * RATE) < LAST_S - FIRST_S:
            image = Image.open(io.BytesIO(page.screenshot(timeout=60e3))).convert("RGB")
            height = MOVING_WIDTH * MOVING_SIZE[1] // MOVING_SIZE[0]
            taken.append((now, image.resize((MOVING_WIDTH, height), Image.Resampling.LANCZOS)))
            page.wait_for_timeout(max(0.0, 1e3 * ((now + 0.15) - (time.monotonic() - start) * RATE) / RATE))
    if len(taken) < 10:
        raise SystemExit(f"only {len(taken)} pictures: the machine is too slow")
    times = [seconds for seconds, _ in taken]
    steps = [round(1e3 * (b - a)) for a, b in pairwise(times)] + [600]
    images = [image for _, image in taken]
    file = IMAGES / "moving.webp"
    for quality in (70, 50, 35, 20):
        images[0].save(file, save_all=True, append_images=images[1:], duration=steps, loop=0, quality=quality, method=6)
        if file.stat().st_size <= LARGEST:
            break
    print(f"{file.relative_to(ROOT)}: {len(images)} pictures, {file.stat().st_size / 1e6:.2f} MB")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*PAGES, MOVING]
    parser.add_argument("name", nargs="*", default=names, help=f"which ones: {', '.join(names)} (default: all)")
    chosen = parser.parse_args().name
    if unknown := sorted(set(chosen) - set(names)):
        parser.error(f"no picture {', '.join(unknown)}: choose from {', '.join(names)}")
    for name in chosen:
        moving() if name == MOVING else still(name)


if __name__ == "__main__":
    main()

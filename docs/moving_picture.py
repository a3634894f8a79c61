"""Make docs/images/moving.webp, the moving picture of README.md, from the real viewer in Chromium.

    python docs/moving_picture.py

It plays a shipped recording slowly through the live graph, since software draws a frame in a second or so, and shows
the pictures in the recording's own time.
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
from itertools import pairwise
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parent.parent
BAG = ROOT / "bags" / "tpose_wave"
SIZE = (1280, 720)
WIDTH = 800
"""Pixels of the picture."""
RATE = 0.1
FIRST_S, LAST_S = 4.0, 12.0
"""Of the recording: from the T-pose into the wave."""
LARGEST = 1_500_000
"""Bytes that README.md's picture may have."""
COMMAND = (
    *(sys.executable, "-m", "body_tracking.cli", "up", "--bag", str(BAG), "--rate", str(RATE)),
    *("--filter", "ekf", "--convention", "isb"),
)


def address(file: Path, patience: float = 60.0) -> str:
    """Of the viewer, as ``up`` prints it."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if found := re.search(r"http://[\d.]+:\d+", file.read_text(encoding="utf-8", errors="replace")):
            return found[0]
        time.sleep(0.1)
    raise SystemExit(f"up printed no address of the viewer:\n{file.read_text(errors='replace')}")


def pictures(url: str) -> list[tuple[float, Image.Image]]:
    """(seconds, picture) of the page."""
    from playwright.sync_api import sync_playwright

    browser = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if browser is None:
        raise SystemExit("no chromium here: apt-get install chromium")
    taken = []
    with sync_playwright() as driver:
        software = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
        chromium = driver.chromium.launch(executable_path=browser, args=software, timeout=60e3)
        page = chromium.new_page(viewport={"width": SIZE[0], "height": SIZE[1]})
        page.set_default_timeout(60e3)
        page.goto(f"{url}/?fixedDpr=1")
        page.wait_for_timeout(1e3 * FIRST_S / RATE)
        for note in page.locator(".mantine-Notification-closeButton").all():
            note.dispatch_event("click")
        page.wait_for_timeout(3e3)
        start = time.monotonic()
        while (now := (time.monotonic() - start) * RATE) < LAST_S - FIRST_S:
            image = Image.open(io.BytesIO(page.screenshot(timeout=60e3))).convert("RGB")
            taken.append((now, image.resize((WIDTH, WIDTH * SIZE[1] // SIZE[0]), Image.Resampling.LANCZOS)))
            page.wait_for_timeout(max(0.0, 1e3 * ((now + 0.15) - (time.monotonic() - start) * RATE) / RATE))
        chromium.close()
    return taken


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "images" / "moving.webp")
    output = parser.parse_args().output
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "up.txt"
        environment = {**os.environ, "PYTHONUNBUFFERED": "1", "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
        with log.open("wb") as file:
            graph = subprocess.Popen(
                [*COMMAND, "--viewer", "--log-dir", folder], stdout=file, stderr=file, env=environment, cwd=ROOT
            )
        try:
            taken = pictures(address(log))
        finally:
            graph.send_signal(signal.SIGINT)
            graph.wait(60)
    if len(taken) < 10:
        raise SystemExit(f"only {len(taken)} pictures: the machine is too slow")
    times = [seconds for seconds, _ in taken]
    steps = [round(1e3 * (b - a)) for a, b in pairwise(times)] + [600]
    images = [image for _, image in taken]
    for quality in (70, 50, 35, 20):
        images[0].save(
            output, save_all=True, append_images=images[1:], duration=steps, loop=0, quality=quality, method=6
        )
        if output.stat().st_size <= LARGEST:
            break
    print(f"{output}: {len(images)} pictures, {output.stat().st_size / 1e6:.2f} MB")


if __name__ == "__main__":
    main()

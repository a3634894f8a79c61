"""A real browser that shows the viewer's page, for tests; it draws in software."""

from __future__ import annotations

import os
import re
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from running import Running

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
SOFTWARE = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox")
PICTURES = os.environ.get("BODY_TRACKING_SCREENSHOTS")
"""A folder, to which tests write the pictures of the documentation."""
PATIENCE = 120.0
"""Seconds: software draws a frame in one of them where processors are shared."""

JOINTS = """name => {
  const node = window.__viserSceneTree?.getState()[name];
  if (!node || !node.message.props.batched_positions) return null;
  const bytes = node.message.props.batched_positions;
  return Array.from(new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4));
}"""


ON_SCREEN = """([name, index]) => {
  const view = window.__viserMutable, box = view.canvas.getBoundingClientRect();
  const bytes = window.__viserSceneTree.getState()[name].message.props.batched_positions;
  const at = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4).slice(3 * index, 3 * index + 3);
  const point = view.camera.position.clone().set(...at);
  point.applyMatrix4(view.nodeRefFromName[name].matrixWorld).project(view.camera);
  return [box.x + (0.5 + 0.5 * point.x) * box.width, box.y + (0.5 - 0.5 * point.y) * box.height];
}"""

LABELS = (
    """() => Object.values(window.__viserSceneTree.getState()).map(each => each.message.props.text).filter(Boolean)"""
)

SHOWN = """prefix => Object.entries(window.__viserSceneTree.getState()).some(
  ([name, node]) => name.startsWith(prefix) && node?.effectiveVisibility)"""

OUT_OF_REACH = """roles => roles.flatMap(role => Array.from(document.querySelectorAll(role))).filter(each => {
  each.scrollIntoView({block: "center"});
  const box = each.getBoundingClientRect();
  if (!box.width || !box.height || each.closest("[inert]")) return false;
  const [x, y] = [box.x + box.width / 2, box.y + box.height / 2];
  if (x < 0 || y < 0 || x >= innerWidth || y >= innerHeight) return true;
  const hit = document.elementFromPoint(x, y);
  if (hit?.closest(".mantine-Notification-root")) return false;
  return !hit || !(each.contains(hit) || hit.contains(each) || each.parentElement.contains(hit));
}).map(each => each.innerText || each.outerHTML.slice(0, 200))"""
"""The visible elements of these selectors whose middle is outside of the window, or covered, except by a note."""

_PIXELS = """() => Array.from(document.querySelectorAll("img")).filter(each => each.naturalWidth > 300).map(each => {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = [each.naturalWidth, each.naturalHeight];
  const context = canvas.getContext("2d");
  context.drawImage(each, 0, 0);
  const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
  let count = 0;
  for (let k = 0; k < data.length; k += 4) {
    const [low, high] = [Math.min(data[k], data[k + 1], data[k + 2]), Math.max(data[k], data[k + 1], data[k + 2])];
    count += CONDITION;
  }
  return [count, 4 * count / data.length];
})"""


def pixels_where(condition: str) -> str:
    """A script that counts pixels of each image on the page that is wider than 300 pixels.

    Args:
        condition: in JavaScript, on the ``low`` and ``high`` of a pixel's red, green and blue, 0 to 255.

    Returns:
        Of which ``page.evaluate`` makes a list of (number, share of the image).
    """
    return _PIXELS.replace("CONDITION", condition)


def need_chromium() -> None:
    """Skip the test where there is no browser."""
    if CHROMIUM is None:
        pytest.skip("no chromium here: apt-get install chromium")


class Browser:
    """A page and the graph that it shows, whose filtered skeletons are received in a thread of their own."""

    def __init__(self, running: Running, page: Any, clouds: list[Any], name: str = "viewer") -> None:
        self.running, self.page, self.clouds, self.name = running, page, clouds, name

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Wait for a condition; a timeout fails the test."""
        end = time.monotonic() + PATIENCE
        while not (found := condition()):
            assert time.monotonic() < end, f"waited {PATIENCE} s for: {what}\n{self.running.log(self.name)}"
            self.page.wait_for_timeout(100)
        return found

    def joints(self, name: str) -> np.ndarray | None:
        """(n, 3) points that the page draws there."""
        numbers = self.page.evaluate(JOINTS, name)
        return None if numbers is None else np.array(numbers).reshape(-1, 3)

    def click(self, name: str, index: int) -> None:
        """Click on one of the points that the page draws there."""
        self.page.mouse.click(*self.page.evaluate(ON_SCREEN, [name, index]))

    def places(self, *buttons: str) -> list[Any]:
        """Where the buttons are: x, y, width and height in pixels."""
        return [self.page.get_by_role("button", name=each, exact=True).bounding_box() for each in buttons]

    def labels(self) -> list[str]:
        """The names in the scene."""
        return list(self.page.evaluate(LABELS))

    def shows(self, prefix: str) -> bool:
        """Whether the scene has a visible node whose name begins so."""
        return bool(self.page.evaluate(SHOWN, prefix))

    def press(self, button: str) -> None:
        self.page.get_by_role("button", name=button, exact=True).dispatch_event("click")

    def answer(self, pattern: str) -> str:
        """The notification that matches."""
        text = re.compile(pattern)
        return str(self.until(lambda: self._found(text), f"an answer like {pattern!r}"))

    def _found(self, pattern: re.Pattern[str]) -> str:
        texts = self.page.locator("[role=alert], .mantine-Notification-root").all_inner_texts()
        return next((text for text in texts if pattern.search(text) and "waits for an answer" not in text), "")

    def text(self) -> str:
        """All words on the page."""
        return str(self.page.inner_text("body"))

    def reads(self, pattern: str) -> None:
        """Wait until a text on the page matches."""
        self.until(lambda: re.search(pattern, self.text()), f"{pattern!r} on the page")

    def out_of_reach(self, *roles: str) -> list[str]:
        """The controls that cannot be reached, even after scrolling to them."""
        self.close_notes()
        return [str(each) for each in self.page.evaluate(OUT_OF_REACH, list(roles))]

    def close_notes(self) -> None:
        """Close all notifications."""
        for note in self.page.locator(".mantine-Notification-closeButton").all():
            with suppress(Exception):  # it may close by itself meanwhile
                note.dispatch_event("click", timeout=1e3)

    def picture(self) -> bytes:
        """The middle of the scene, where the person stands."""
        size = self.page.viewport_size
        clip = {"x": 0.42 * size["width"], "y": 0.3 * size["height"], "width": 0.2 * size["width"], "height": 200}
        return bytes(self.page.screenshot(clip=clip, timeout=1e3 * PATIENCE))

    def save(self, name: str, height: int | None = None) -> None:
        """A picture for the documentation, if these are asked for: of the page, or of the state in words and below."""
        if PICTURES:
            file = Path(PICTURES) / name
            file.parent.mkdir(parents=True, exist_ok=True)
            self.close_notes()
            self.page.wait_for_timeout(5e3)
            size = self.page.viewport_size
            top = self.page.locator("div[style*='line-height:1.35']").first.bounding_box()["y"]
            panel = {"x": size["width"] - 292, "y": top, "width": 292, "height": height or 0}
            whole: dict[str, Any] = {} if height is None else {"clip": panel}
            self.page.screenshot(path=file, timeout=1e3 * PATIENCE, **whole)


@contextmanager
def browsing(
    running: Running, folder: Path, size: tuple[int, int], sharpness: float, name: str = "viewer"
) -> Iterator[Any]:
    """The page of a running viewer, in playwright.

    Args:
        running: with a node ``viewer``.
        folder: for temporary files.
        size: of the window, pixels.
        sharpness: pixels that are drawn per pixel of the window.
        name: of the process that serves the page.
    """

    def opened() -> bool:
        return (running.folder / f"{name}.log").exists() and "open http" in running.log(name)

    assert running.until(opened, PATIENCE), running.log(name)
    address = re.search(r"http://\S+", running.log(name))
    assert address is not None and address[0].startswith("http://127.0.0.1:")
    with opened_page(address[0], folder, size, sharpness) as page:
        yield page


@contextmanager
def opened_page(address: str, folder: Path, size: tuple[int, int], sharpness: float) -> Iterator[Any]:
    """A page in playwright; arguments as of :func:`browsing`."""
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    with playwright.sync_playwright() as driver:
        # Software draws as fast as it can; what it draws comes first.
        gentle = folder / "chromium"
        gentle.write_text(f'#!/bin/sh\nexec nice -n 19 {CHROMIUM} "$@"\n')
        gentle.chmod(0o755)
        chromium = driver.chromium.launch(executable_path=gentle, args=list(SOFTWARE), timeout=1e3 * PATIENCE)
        page = chromium.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(f"{address}/?fixedDpr={sharpness}")
        yield page
        chromium.close()

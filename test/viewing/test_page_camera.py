"""Where the page's camera is at first."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="the page needs viser")

from body_tracking.viewing.page import WIDTH, Page


class Browser:
    """A browser of a height of 720 pixels."""

    def __init__(self, width: int) -> None:
        self.callbacks: list[Callable[[Any], None]] = []
        self.camera: Any = SimpleNamespace(image_width=width, image_height=720, on_update=self.callbacks.append)
        self.atomic = contextlib.nullcontext

    def resize(self, width: int) -> None:
        self.camera.image_width = width
        for each in self.callbacks:
            each(self.camera)

    def distance(self) -> float:
        return float(np.linalg.norm(self.camera.position - self.camera.look_at))


def seen_by(browser: Browser, *widths: int) -> float:
    """Distance of the camera to the person, once the scene of the browser has had these widths."""
    page = object.__new__(Page)  # without a server
    page._target = np.zeros(3)
    page._look_at_person(browser)  # type: ignore[arg-type]
    for width in widths:
        browser.resize(width)
    return browser.distance()


def test_the_person_is_as_large_from_the_start_page_as_without_it() -> None:
    """The panels of the start page are wider, and leave 360 of 1280 pixels when this page comes."""
    scene = 1280 - 2 * WIDTH
    alone = seen_by(Browser(1280), scene)
    assert seen_by(Browser(1280)) == pytest.approx(alone)
    assert seen_by(Browser(360), scene) == pytest.approx(alone)
    assert seen_by(Browser(360)) > 1.5 * alone  # until it is resized


def test_a_camera_that_the_user_moves_stays() -> None:
    browser = Browser(1280)
    seen_by(browser, 700)
    browser.camera.position = np.full(3, 7.0)
    browser.resize(700)  # an update without another width
    assert np.array_equal(browser.camera.position, np.full(3, 7.0))


def test_a_scene_that_is_resized_while_the_camera_is_placed_is_seen_from_as_near() -> None:
    scene, browser = 1280 - 2 * WIDTH, Browser(360)

    @contextlib.contextmanager
    def atomic() -> Iterator[None]:
        browser.camera.image_width = scene  # before anybody is told
        yield

    browser.atomic = atomic  # type: ignore[assignment]
    assert seen_by(browser) == pytest.approx(seen_by(Browser(1280), scene))

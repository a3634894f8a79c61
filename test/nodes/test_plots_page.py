"""The plots of joint angles in a real browser: the labels of their axes can be read."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS is not installed")
pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
pytest.importorskip("viser", reason="viser is not installed")

from browser import need_chromium, opened_page

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.viewing.curves import AngleHistory
from body_tracking.viewing.page import WIDTH
from body_tracking.viewing.plots import PLOTS, Plots
from body_tracking.viewing.server import address_of, serve, stop

pytestmark = [pytest.mark.slow, pytest.mark.alone]  # the browser draws in software, on all processors

NAMES = ("elbow_flexion_left", "elbow_flexion_right", "shoulder_elevation_left", "shoulder_elevation_right")
RANGES = ((-100.0, -100.0), (0.0, 0.01), (64.1, 64.2), (-179.0, 179.0), (20.0, 43.0), (-120.0, -80.0), (3.0, 77.0))
"""Lowest and highest angle that a plot shows, degrees."""
AXES = """() => Object.values(window.__viserTestpoints?.uplots ?? {}).map(({chart}) => {
  const axis = chart.axes[1], box = chart.bbox, context = chart.ctx, ratio = devicePixelRatio;
  const labels = axis._splits.map((at, k) => [chart.valToPos(at, "y"), String(axis._values[k] ?? "")]);
  const font = context.font;
  context.font = axis.font[0];
  const widths = labels.map(([, text]) => context.measureText(text).width / ratio);
  context.font = font;
  return {
    labels: labels.filter(([at, text]) => text && at >= -0.5 && at <= box.height / ratio + 0.5),
    top: box.top / ratio,
    room: axis._size - axis.gap - (axis.ticks.show ? axis.ticks.size : 0), widest: Math.max(...widths),
  };
})"""
"""Per plot: position in pixels and text of each label of the vertical axis, the room above the uppermost place, the
widest label, and the room for it."""


@pytest.fixture
def plots(tmp_path: Path) -> Iterator[tuple[Plots, Any]]:
    """Plots on a page, and a browser that shows it."""
    need_chromium()
    server = serve("127.0.0.1", 0)
    panel = server.gui.add_panel()
    with panel.add_tab("angles"):
        shown = Plots(server.gui, 15.0)
    panel.dock_left()
    panel.set_width(WIDTH)
    with opened_page(address_of(server), tmp_path, (1000, 700), 1.0) as page:
        yield shown, page
    stop(server)


def history(low: float, high: float, stddev: float) -> AngleHistory:
    """Angles that swing between two values, degrees."""
    angles = AngleHistory(15.0)
    for k in range(300):
        value = np.radians(0.5 * (low + high) + 0.5 * (high - low) * np.sin(0.1 * k))
        angles.add(k * NANOSECONDS // 20, NAMES, np.full(PLOTS, value), np.full(PLOTS, np.radians(stddev)))
    return angles


def test_vertical_axes_have_two_labels_that_do_not_overlap(plots: tuple[Plots, Any]) -> None:
    shown, page = plots
    for low, high in RANGES:
        for stddev in (0.0, 0.02, 6.0, 29.0):
            shown.draw(history(low, high, stddev))
            page.wait_for_function(f"({AXES})().length === {PLOTS}")
            page.wait_for_timeout(700)
            for axis in page.evaluate(AXES):
                places = sorted(at for at, _ in axis["labels"])
                assert len(places) >= 2, (low, high, stddev, axis)
                assert axis["top"] + places[0] >= 5.0, (low, high, stddev, axis)  # half a label's height
                assert min(np.diff(places)) >= 10.0, (low, high, stddev, axis)
                assert len({text for _, text in axis["labels"]}) == len(places), axis
                assert axis["widest"] <= axis["room"], (low, high, stddev, axis)

"""Centroids of rendered balls against their truth: RMS per axis in pixels, by category, distance, blur and saturation.

A camera of 640x480 pixels, f 834 px, balls of 14 mm. ``sd`` is the root mean square of the stated standard deviation,
``inside`` the share of errors within 1.96 of it, ``missed`` and ``extra`` are numbers of balls that were not found and
of those that are none, ``ms`` is the median CPU time of an image. The categories pool distances of 0.6 to 2.5 m.
Half overlap: one of two balls hides half of the other. The border cuts off 15 to 50 % of a ball's diameter. A limb
hides half of a ball. ``of 1 m`` is the brightness of a ball 1 m away, of what saturates the sensor.

The exit code is 1 where a bar is missed.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import common
import cv2
import numpy as np

from body_tracking.markers.detection import detect
from body_tracking.markers.rendering import Rendered, Sensor
from body_tracking.simulation.ball_images import (
    apart,
    cut_by_border,
    found,
    half_hidden,
    overlapping,
    three_touching,
)

DEPTHS = (0.6, 1.0, 1.5, 2.0, 2.5)
USUAL = Sensor()
CATEGORIES: dict[str, Callable[[int, float], Rendered]] = {
    "isolated": lambda seed, depth: apart(seed, depth, depth, USUAL),
    "two that touch": lambda seed, depth: overlapping(seed, depth, 0.05, USUAL, 2.0),
    "half overlap": lambda seed, depth: overlapping(seed, depth, 0.05, USUAL),
    "three that touch": lambda seed, depth: three_touching(seed, depth, USUAL),
    "cut by the border": lambda seed, depth: cut_by_border(seed, depth, USUAL),
    "half hidden by a limb": lambda seed, depth: half_hidden(seed, depth, USUAL),
}
BARS_PX = {"isolated": 0.03, "half overlap": 0.15}


@dataclass(frozen=True, slots=True)
class Row:
    """Figures of a set of images; pixels, per cent, numbers of balls, milliseconds of CPU."""

    rms: float
    sd: float
    inside: float
    missed: int
    extra: int
    ms: float

    @classmethod
    def of(cls, scenes: list[Rendered], which: slice = slice(None)) -> Row:
        """Of some of the balls of each scene."""
        wrong, stated, missed, extra = found(scenes, which)
        inside = 100.0 * float((np.abs(wrong) < 1.96 * stated).mean()) if len(wrong) else float("nan")
        spent = []
        for scene in scenes:
            begin = time.thread_time()
            detect(scene.image)
            spent.append(1e3 * (time.thread_time() - begin))
        return cls(common.rms(wrong), common.rms(stated), inside, missed, extra, float(np.median(spent)))


def by_category(count: int) -> dict[str, Row]:
    """The categories; so many images of each distance, of balls apart a quarter of them, which show 15 balls each."""
    return {
        name: Row.of(
            [make(seed, d) for d in DEPTHS for seed in range(max(count // 4, 1) if name == "isolated" else count)]
        )
        for name, make in CATEGORIES.items()
    }


def in_detail(count: int) -> dict[str, Row]:
    """Each distance, blur, brightness and overlap."""
    rows = {f"{d} m": Row.of([apart(seed, d, d, USUAL) for seed in range(count)]) for d in (*DEPTHS, 3.0)}
    sensors = {"0.5 to 3 m, 16 bits": (0.5, 3.0, Sensor(bits=16))}
    sensors |= {f"0.5 to 2.5 m, blur {blur} px": (0.5, 2.5, Sensor(blur=blur)) for blur in (0.3, 0.5, 1.0, 1.5)}
    sensors |= {f"0.8 to 1.2 m, {b} of 1 m": (0.8, 1.2, Sensor(brightness=b)) for b in (0.5, 0.9, 2.0, 5.0, 20.0)}
    for name, (low, high, sensor) in sensors.items():
        rows[name] = Row.of([apart(seed, low, high, sensor) for seed in range(count)])
    rows["0.5 to 3 m, 10 glints"] = Row.of([apart(seed, 0.5, 3.0, USUAL, glints=10) for seed in range(count)])
    for depth in (*DEPTHS, 2.9):
        for behind in (0.02, 0.2):
            scenes = [overlapping(seed, depth, behind, USUAL) for seed in range(2 * count)]
            name = f"half overlap {depth} m, {behind} m behind"
            rows[name], rows[f"{name}: the hidden one"] = Row.of(scenes), Row.of(scenes, slice(1, None))
    for depth in DEPTHS:
        rows[f"half hidden by a limb, {depth} m"] = Row.of([half_hidden(s, depth, USUAL) for s in range(2 * count)])
        rows[f"three that touch, {depth} m"] = Row.of([three_touching(s, depth, USUAL) for s in range(2 * count)])
    return rows


def show(figures: dict[str, dict[str, Row]]) -> None:
    """The tables."""
    print(f"{'':46s} {'RMS px':>7s} {'sd px':>7s} {'inside':>8s} {'missed':>6s} {'extra':>6s} {'ms':>6s}")
    for rows in figures.values():
        for name, row in rows.items():
            print(
                f"{name:46s} {row.rms:7.4f} {row.sd:7.4f} {row.inside:6.1f} % "
                f"{row.missed:6d} {row.extra:6d} {row.ms:6.2f}"
            )


def main() -> int:
    """Print the tables."""
    parser = common.parser(__doc__)
    parser.add_argument("--images", type=int, default=20, metavar="N", help="of each row (default: %(default)s)")
    parser.add_argument("--detail", action="store_true", help="also by distance, blur, brightness and overlap")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    figures: dict[str, Any] = {"categories": by_category(args.images)}
    if args.detail:
        figures["detail"] = in_detail(args.images)
    common.report(args, figures, lambda: show(figures))
    rows = figures["categories"]
    met = {f"{name}: {rows[name].rms:.4f} px, at most {bar:g}": rows[name].rms <= bar for name, bar in BARS_PX.items()}
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

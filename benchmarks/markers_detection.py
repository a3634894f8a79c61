"""Centroids of rendered balls against their truth: RMS per axis in pixels, by category.

A camera of 640x480 pixels, f 834 px, balls of 14 mm. ``sd`` is the root mean square of the stated standard deviation,
``inside`` the share of errors within 1.96 of it, ``missed`` and ``extra`` are the numbers of balls that were not found
and of detections without a ball, ``ms`` is the median CPU time of an image. The categories pool distances of 0.6 to
2.5 m. Half overlap: one of two balls hides half of the other. The border cuts off 15 to 50 % of a ball's diameter. A
limb hides half of a ball.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import common
import cv2
import numpy as np
from ball_images import (
    apart,
    cut_by_border,
    found,
    half_hidden,
    overlapping,
    three_touching,
)

from body_tracking.markers.detection import detect
from body_tracking.markers.rendering import Rendered, Sensor

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
    def of(cls, scenes: list[Rendered]) -> Row:
        """Figures of these images."""
        wrong, stated, missed, extra = found(scenes)
        inside = 100.0 * float((np.abs(wrong) < 1.96 * stated).mean()) if len(wrong) else float("nan")
        spent = []
        for scene in scenes:
            begin = time.thread_time()
            detect(scene.image)
            spent.append(1e3 * (time.thread_time() - begin))
        return cls(common.rms(wrong), common.rms(stated), inside, missed, extra, float(np.median(spent)))


def by_category(count: int) -> dict[str, Row]:
    """Rows of the categories with ``count`` images per distance; isolated balls, 15 an image, with a quarter of it."""
    return {
        name: Row.of(
            [make(seed, d) for d in DEPTHS for seed in range(max(count // 4, 1) if name == "isolated" else count)]
        )
        for name, make in CATEGORIES.items()
    }


def main() -> int:
    """Print the tables."""
    parser = common.parser(__doc__)
    parser.add_argument("--images", type=int, default=20, metavar="N", help="of each row (default: %(default)s)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    rows = by_category(args.images)
    common.report(args, {"categories": rows})
    met = {f"{name}: {rows[name].rms:.4f} px, at most {bar:g}": rows[name].rms <= bar for name, bar in BARS_PX.items()}
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

"""Centroids of rendered balls against their truth: RMS per axis in pixels, by distance, blur, saturation and overlap.

A camera of 640x480 pixels, f 834 px, balls of 14 mm. ``sd`` is the root mean square of the stated standard deviation,
``inside`` the share of errors within 1.96 of it, ``missed`` and ``extra`` are numbers of balls that were not found and
of those that are none. ``of 1 m`` is the brightness of a ball 1 m away, of what saturates the sensor. The half overlap:
two balls of which one hides half of the other; the errors of both, or of the hidden one. A limb hides half of a ball.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import common
import cv2
import numpy as np

from body_tracking.markers.detection import detect
from body_tracking.markers.rendering import Rendered, Sensor
from body_tracking.simulation.ball_images import apart, found, half_hidden, overlapping


def _row(name: str, make: Callable[[int], Rendered], count: int, which: slice = slice(None)) -> None:
    wrong, stated, missed, extra = found([make(seed) for seed in range(count)], which)
    rms, sd = np.sqrt((wrong**2).mean()), np.sqrt((stated**2).mean())
    inside = (np.abs(wrong) < 1.96 * stated).mean()
    print(f"{name:34s} {rms:7.4f} {sd:7.4f} {100.0 * inside:6.1f} % {missed:6d} {extra:6d}")


def _milliseconds(image: np.ndarray) -> float:
    """Least CPU time of five rounds."""
    rounds = []
    for _ in range(5):
        begin = time.process_time()
        for _ in range(20):
            detect(image)
        rounds.append((time.process_time() - begin) / 20)
    return 1e3 * min(rounds)


def main() -> None:
    """Print the table."""
    parser = common.parser(__doc__)
    parser.add_argument("--images", type=int, default=20, help="of each row (default 20)")
    count = parser.parse_args().images
    cv2.setNumThreads(1)
    usual = Sensor()
    print(f"{'':34s} {'RMS px':>7s} {'sd px':>7s} {'inside':>8s} {'missed':>6s} {'extra':>6s}")
    for depth in (0.5, 0.7, 1.0, 1.5, 2.0, 2.5, 3.0):
        _row(f"{depth} m", lambda seed, d=depth: apart(seed, d, d, usual), count)
    _row("0.5 to 3 m", lambda seed: apart(seed, 0.5, 3.0, usual), count)
    _row("0.5 to 3 m, 10 glints", lambda seed: apart(seed, 0.5, 3.0, usual, glints=10), count)
    _row("0.5 to 3 m, 16 bits", lambda seed: apart(seed, 0.5, 3.0, Sensor(bits=16)), count)
    for blur in (0.3, 0.5, 1.0, 1.5):
        _row(f"0.5 to 2.5 m, blur {blur} px", lambda seed, b=blur: apart(seed, 0.5, 2.5, Sensor(blur=b)), count)
    for bright in (0.5, 0.9, 2.0, 5.0, 20.0):
        sensor = Sensor(brightness=bright)
        _row(f"0.8 to 1.2 m, {bright} of 1 m", lambda seed, s=sensor: apart(seed, 0.8, 1.2, s), count)
    for depth in (0.6, 1.0, 1.5, 2.0, 2.5, 2.9):
        for behind in (0.02, 0.2):
            make = lambda seed, d=depth, b=behind: overlapping(seed, d, b, usual)  # noqa: E731
            _row(f"half overlap {depth} m, {behind} m behind", make, 2 * count)
            _row("  the hidden one", make, 2 * count, slice(1, None))
    for depth in (0.7, 1.0, 1.5, 2.0, 2.5):
        _row(f"half hidden by a limb, {depth} m", lambda seed, d=depth: half_hidden(seed, d, usual), 2 * count)
    print(f"CPU of an image of 15 balls apart: {_milliseconds(apart(1, 0.5, 3.0, usual).image):.2f} ms")
    print(f"CPU of two that overlap by half: {_milliseconds(overlapping(1, 1.5, 0.05, usual).image):.2f} ms")


if __name__ == "__main__":
    main()

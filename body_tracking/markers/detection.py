"""Bright balls in an infrared image, with sub-pixel centroids and their covariance (Gaschler 2011, section 3.1).

The threshold comes from quantiles of the brightness (section 3.1.2), the components from one pass. Each centroid is
weighted by the brightness above the background around the ball (equation 3.2), over a window wider than the thresholded
region, so that the threshold cuts nothing off. :mod:`body_tracking.markers.discs` explains regions that are not the
image of one whole ball.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.discs import MOST_DISCS, Discs, cut_by_border, explain
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.regions import (
    Components,
    Regions,
    Shapes,
    background_of,
    groups_of,
    histogram,
    regions_of,
    shapes_of,
)
from body_tracking.markers.spheres import sphere_centre_correction as sphere_centre_correction

_ROWS: Final = 4
"""The histogram uses every fourth row, as in section 3.1.2."""
_APART: Final = 5.0
"""Pixels between the edges of balls, below which they disturb each other's centroids."""
_TOGETHER: Final = 0.06
"""Largest misfit at which neighbouring regions, or regions cut by the border, are taken for one ball each."""
_FIT_FLOOR: Final = 0.004
"""Standard deviation of a fitted disc's centre without noise, pixels."""
_DISTURBED: Final = 0.05
"""Standard deviation of a centroid due to the light of a ball nearby, pixels."""
_LOST: Final = 4.0
"""Pixels of area by which edge blur lowers :attr:`~body_tracking.markers.regions.Shapes.fill` at most."""
_ELONGATION_NOISE: Final = 4.0
"""Elongation due to noise, in standard deviations of the centroid in radii of the ball."""
_QUANTISATION: Final = 1.0 / 12.0
"""Variance of rounding to integers."""
_MOST: Final = 2**16 - 1


_Ball = tuple[FloatArray, float, FloatArray]
"""Centroid (2,), area, covariance (2, 2)."""


class ImageError(BodyTrackingError):
    """Raised for an array that is not a grey image of 8 or 16 bits."""


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """Settings of the detection of balls; each field's ``doc`` describes it.

    Raises:
        ImageError: a value out of its range.
    """

    dark: float = number_field(
        0.95,
        "quantile of the brightness that is background; Gaschler has 0.98, but 15 near balls are 2 %",
        "",
        0.1,
        0.99,
    )
    bright: float = number_field(0.9999, "quantile of the brightness that is a ball's", "", 0.99, 1.0)
    lower: float = number_field(
        0.1,
        "place of the threshold between background (0) and balls (1); Gaschler has 0.2, a smaller value finds far "
        "balls beside near ones",
        "",
        0.0,
        1.0,
    )
    noise: float = number_field(
        6.0, "least distance of the threshold from the background, standard deviations of its noise", "", 3.0, 100.0
    )
    least_area: float = number_field(
        5.0, "smallest area of a ball; a smaller region is a glint or a broken pixel", "px^2", 1.0, 1e4
    )
    most_area: float = number_field(
        2500.0, "largest area of a ball; a larger region is a lamp, a window, a coat", "px^2", 10.0, 1e6
    )
    most_balls: float = number_field(
        64.0, "largest number of regions of an image that are measured, the largest first", "", 1.0, 1000.0
    )
    elongation: float = number_field(
        1.12, "ratio of its axes from which a region is taken for more or less than one whole ball", "", 1.0, 10.0
    )
    fill: float = number_field(
        0.93,
        "ratio of its area to an ellipse's of its moments, under which it is; of three balls that touch 0.82 to 0.87",
        "",
        0.0,
        1.0,
    )
    misfit: float = number_field(
        0.12, "RMS difference from discs, share of the brightness, over which a region is dropped", "", 0.01, 1.0
    )
    saturation: float = number_field(
        0.0, "brightness at which the sensor saturates; 0 for the largest number of the image's type", "", 0.0, 65535.0
    )
    full_well: float = number_field(10_000.0, "electrons of a saturated pixel, for the shot noise", "", 100.0, 1e7)
    floor: float = number_field(
        0.005,
        "standard deviation of a centroid without noise where the edge of a ball is 1.3 pixels wide from 10 to 90 % "
        "of its brightness; it goes with the inverse square of the width",
        "px",
        0.0,
        1.0,
    )

    def __post_init__(self) -> None:
        check_fields(self, "detection of balls", ImageError)


_DEFAULT: Final = DetectionSettings()


def detect(
    image: NDArray[Any], stamp_ns: int = 0, camera: str = "", settings: DetectionSettings | None = None
) -> ImageBalls:
    """The balls in an image.

    Args:
        image: (h, w) uint8 or uint16.
        stamp_ns: capture time, nanoseconds.
        camera: its frame.
        settings: of the detection.

    Raises:
        ImageError: another shape or type, or no pixels.
    """
    settings = settings or _DEFAULT
    if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        shape, kind = getattr(image, "shape", ()), getattr(image, "dtype", type(image).__name__)
        raise ImageError(f"image of camera {camera or '(no name)'}: {shape} of {kind}, expected (h, w) uint8 or uint16")
    if not image.size:
        raise ImageError(f"image of camera {camera or '(no name)'}: {image.shape}, no pixels")
    image = np.ascontiguousarray(image)
    brightness = _Histogram.of(image, settings)
    components = Components.of(image, brightness.threshold)
    areas = components.areas
    none = ImageBalls(stamp_ns, camera, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), len(areas) - 1)
    keep = (areas >= settings.least_area) & (areas <= settings.most_area)
    keep[0] = False
    kept = np.flatnonzero(keep)
    kept = np.sort(kept[np.argsort(-areas[kept], kind="stable")[: int(settings.most_balls)]])
    if not len(kept) or len(areas) > _MOST:
        return none
    background = brightness.background, brightness.variance
    saturation = settings.saturation or float(np.iinfo(image.dtype).max)
    regions = regions_of(image, components, kept, background, saturation, settings.full_well)
    shapes = shapes_of(regions, settings.floor)
    odd, cut = _odd(shapes, settings), ~components.inside[kept]
    groups = groups_of(np.ascontiguousarray(shapes.pixels), np.ascontiguousarray(shapes.areas), _APART)
    members = np.bincount(groups, minlength=len(groups))
    # most regions are the image of a single isolated ball
    plain = (members[groups] == 1) & ~odd & ~cut
    found: list[_Ball] = []
    dropped = len(areas) - 1 - len(kept)
    for first in np.flatnonzero((members > 0) & ~plain).tolist():
        group = np.flatnonzero(groups == first)
        balls = _explained(regions, shapes, group, _TOGETHER) if 1 < len(group) <= MOST_DISCS else []
        for region in group if not balls else []:
            if cut[region]:
                alone = _balls(cut_by_border(*regions.of(np.array([region]))), _TOGETHER)
            elif odd[region]:
                alone = _explained(regions, shapes, np.array([region]), settings.misfit)
            else:
                covariance = shapes.covariance[region] + _DISTURBED**2 * np.eye(2)
                alone = [(shapes.pixels[region], float(shapes.areas[region]), covariance)]
            dropped += not alone
            balls += alone
        found += balls
    centres, sizes, covariances = shapes.pixels[plain], shapes.areas[plain], shapes.covariance[plain]
    if found:
        centres = np.concatenate([centres, [ball[0] for ball in found]])
        sizes = np.concatenate([sizes, [ball[1] for ball in found]])
        covariances = np.concatenate([covariances, [ball[2] for ball in found]])
    return ImageBalls(stamp_ns, camera, centres, sizes, covariances, dropped)


def prepare() -> None:
    """Compile the loops, or load them, before the first image: two discs that overlap need all of them."""
    drawn = np.zeros((64, 64), dtype=np.uint8)
    for place in (28, 36):
        cv2.circle(drawn, (place, 32), 6, 200, -1)
    for kind in (np.uint8, np.uint16):
        image = cv2.GaussianBlur(drawn, (0, 0), 0.8).astype(kind)
        detect(image)
        # numba compiles read-only arrays, as images in a message's memory are, separately
        image.flags.writeable = False
        detect(image)


@dataclass(frozen=True, slots=True)
class _Histogram:
    """Threshold and background from the brightness of a whole image.

    Attributes:
        threshold: brighter pixels belong to balls.
        background: mean brightness.
        variance: of the background.
    """

    threshold: int
    background: float
    variance: float

    @classmethod
    def of(cls, image: NDArray[Any], settings: DetectionSettings) -> _Histogram:
        """The threshold between two quantiles of the brightness (Gaschler 2011, figure 3.1, eq. 3.1)."""
        counts = histogram(image, _ROWS, np.iinfo(image.dtype).max + 1)
        dark, bright, background, variance = background_of(counts, settings.dark, settings.bright)
        variance = max(variance, _QUANTISATION)
        by_quantiles = dark + settings.lower * (bright - dark)
        threshold = int(max(by_quantiles, background + settings.noise * np.sqrt(variance)))
        return cls(threshold, background, variance)


def _odd(shapes: Shapes, settings: DetectionSettings) -> BoolArray:
    """Which regions (n,) are not the image of one whole ball."""
    areas = np.maximum(shapes.areas, 2.0 * _LOST)
    noise = np.sqrt(np.pi * (shapes.covariance[:, 0, 0] + shapes.covariance[:, 1, 1]) / areas)
    elongated = shapes.elongation > settings.elongation + _ELONGATION_NOISE * noise
    return np.asarray(elongated | (shapes.fill < settings.fill * (1.0 - _LOST / areas)))


def _explained(regions: Regions, shapes: Shapes, members: IntArray, misfit: float) -> list[_Ball]:
    """Centres, areas and covariances of the balls in regions; empty if discs do not fit."""
    return _balls(explain(*regions.of(members), shapes.pixels[members]), misfit)


def _balls(discs: Discs, misfit: float) -> list[_Ball]:
    """Balls from discs; empty if the misfit is larger than allowed."""
    if discs.misfit > misfit:
        return []
    areas = np.pi * discs.radii**2
    return list(zip(discs.centres, areas.tolist(), discs.covariance + _FIT_FLOOR**2 * np.eye(2), strict=True))

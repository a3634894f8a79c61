"""Bright balls in an infrared image, with sub-pixel centroids and their covariance (Gaschler 2011, section 3.1).

The threshold comes from quantiles of the brightness (section 3.1.2), the components from one labelling. Each centroid
is weighted by the brightness above the background around the ball (equation 3.2), over a window that goes beyond the
threshold, so that the threshold cuts nothing off. What is not the image of one whole ball is explained by
:mod:`body_tracking.markers.discs`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.discs import MOST_DISCS, explain
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.spheres import sphere_centre_correction as sphere_centre_correction

_ROWS: Final = 4
"""Every so many rows are in the histogram, as in section 3.1.2."""
_MARGIN: Final = 3
"""Pixels around the thresholded region whose light is the ball's."""
_RING: Final = 2
"""Pixels around the margin, of the background."""
_REACH: Final = 0.8
"""By which the window of a centroid is larger than the ball, widths of the edge."""
_LEAST_REACH: Final = 1.2
"""Pixels."""
_SATURATED_REACH: Final = 2.5
"""Pixels; what is left of the edge of a saturated ball is its long tail."""
_APART: Final = 5.0
"""Pixels between the edges of balls that are near enough to disturb each other's centroids."""
_TOGETHER: Final = 0.06
"""Misfit up to which regions that are near to each other are one ball each."""
_FIT_FLOOR: Final = 0.004
"""Standard deviation of a fitted centre without noise, pixels."""
_DISTURBED: Final = 0.05
"""Standard deviation of a centroid by the light of a ball nearby, pixels."""
_LEAST_RING: Final = 12
"""Pixels from which the background around a ball is known."""
_LOWER: Final = 0.2
_UPPER: Final = 0.8
_LOST: Final = 3.0
"""Pixels of area by which the blur of an edge lowers :attr:`_Measured.fill` at most."""
_ELONGATION_NOISE: Final = 4.0
"""Elongation by noise, standard deviations of the centroid in radii of the ball."""
_EDGE: Final = 1.3
_LEAST_EDGE: Final = 0.5
"""Pixels between 10 and 90 % of a ball's brightness."""
_PASSES: Final = 2
_QUANTISATION: Final = 1.0 / 12.0
"""Variance of rounding to whole numbers."""
_MOST: Final = 2**16 - 1


_Ball = tuple[FloatArray, float, FloatArray]
"""Centroid (2,), area, covariance (2, 2)."""


class ImageError(BodyTrackingError):
    """An array is not a grey image of 8 or 16 bits."""


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """How balls are found; each field's ``doc`` says what it is.

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
        "where the threshold is between the two; Gaschler has 0.2, less finds far balls beside near ones",
        "",
        0.0,
        1.0,
    )
    noise: float = number_field(
        6.0, "by which the threshold is above the background at least, standard deviations of its noise", "", 3.0, 100.0
    )
    least_area: float = number_field(
        5.0, "area above the threshold under which a region is a glint or a broken pixel", "px^2", 1.0, 1e4
    )
    most_area: float = number_field(2500.0, "area above which it is a lamp, a window, a coat", "px^2", 10.0, 1e6)
    most_balls: float = number_field(64.0, "regions of an image that are measured, the largest", "", 1.0, 1000.0)
    elongation: float = number_field(
        1.12, "ratio of its axes from which a region is taken for more or less than one whole ball", "", 1.0, 10.0
    )
    fill: float = number_field(
        0.85, "ratio of its area to an ellipse's of its moments, under which it is", "", 0.0, 1.0
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


@dataclass(frozen=True, slots=True, eq=False)
class _Regions:
    """Pixels of all regions in one list, and what is known of each region; label 0 is none.

    Attributes:
        label: (p,) region of each pixel.
        x: (p,) and
        y: (p,) pixels.
        value: (p,) brightness above the background around the region.
        variance: (p,) of the brightness by noise.
        ceiling: (count,) brightness above the background at which the sensor saturates.
        count: of labels, with 0.
    """

    label: IntArray
    x: FloatArray
    y: FloatArray
    value: FloatArray
    variance: FloatArray
    ceiling: FloatArray
    count: int

    def sums(self, weights: FloatArray) -> FloatArray:
        """(count,) sums of weights (p,) of each region."""
        sums: FloatArray = np.bincount(self.label, weights, self.count).astype(np.float64)
        return sums


def detect(
    image: NDArray[Any], stamp_ns: int = 0, camera: str = "", settings: DetectionSettings | None = None
) -> ImageBalls:
    """The balls in an image.

    Gaschler (2011): section 3.1.3.

    Args:
        image: (h, w) uint8 or uint16.
        stamp_ns: capture time, nanoseconds.
        camera: its frame.
        settings: how balls are found.

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
    histogram = _Histogram.of(image, settings)
    mask = cv2.threshold(image, histogram.threshold, 255, cv2.THRESH_BINARY)[1].astype(np.uint8)
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    none = ImageBalls(stamp_ns, camera, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), count - 1)
    if count == 1 or count > _MOST:
        return none
    regions, core, inside = _regions(image, labels.astype(np.uint16), count, histogram, settings)
    keep = inside & (core >= settings.least_area) & (core <= settings.most_area)
    keep[0] = False
    kept = np.flatnonzero(keep)
    kept = np.sort(kept[np.argsort(-core[kept], kind="stable")[: int(settings.most_balls)]])
    if not len(kept):
        return none
    measured = _centroids(regions, settings)
    odd = measured.odd(settings)
    found: list[_Ball] = []
    dropped = count - 1 - len(kept)
    for group in _groups(kept, measured):
        balls = _explained(regions, measured, group, _TOGETHER) if 1 < len(group) <= MOST_DISCS else []
        for label in group if not balls else []:
            if odd[label]:
                alone = _explained(regions, measured, np.array([label]), settings.misfit)
            else:
                disturbed = _DISTURBED**2 * np.eye(2) * (len(group) > 1)
                alone = [(measured.pixels[label], measured.areas[label], measured.covariance[label] + disturbed)]
            dropped += not alone
            balls += alone
        found += balls
    if not found:
        return replace(none, dropped=dropped)
    pixels, areas, covariance = (np.stack(part) for part in zip(*found, strict=True))
    return ImageBalls(stamp_ns, camera, pixels, areas, covariance, dropped)


def prepare() -> None:
    """Compile the loops, or load them, before the first image: two discs that overlap need all of them."""
    image = np.zeros((64, 64), dtype=np.uint8)
    for place in (28, 36):
        cv2.circle(image, (place, 32), 6, 200, -1)
    detect(cv2.GaussianBlur(image, (0, 0), 0.8))


@dataclass(frozen=True, slots=True)
class _Histogram:
    """What the brightness of a whole image says.

    Attributes:
        threshold: a pixel that is brighter is a ball's.
        background: mean brightness.
        variance: of the background.
    """

    threshold: int
    background: float
    variance: float

    @classmethod
    def of(cls, image: NDArray[Any], settings: DetectionSettings) -> _Histogram:
        """The threshold between two quantiles of the brightness (Gaschler 2011, figure 3.1, eq. 3.1)."""
        counts = np.bincount(image[::_ROWS].ravel())
        total = np.cumsum(counts)
        quantiles = np.array([settings.dark, settings.bright]) * total[-1]
        dark, bright = np.searchsorted(total, quantiles).tolist()
        levels = np.arange(dark + 1, dtype=np.float64)
        counts = counts[: dark + 1].astype(np.float64)
        background = float(levels @ counts / counts.sum())
        variance = max(float((levels - background) ** 2 @ counts / counts.sum()), _QUANTISATION)
        by_quantiles = dark + settings.lower * (bright - dark)
        threshold = int(max(by_quantiles, background + settings.noise * np.sqrt(variance)))
        return cls(threshold, background, variance)


def _regions(
    image: NDArray[Any], labels: NDArray[np.uint16], count: int, histogram: _Histogram, settings: DetectionSettings
) -> tuple[_Regions, FloatArray, BoolArray]:
    """Regions with the margin around them; (count,) pixels above the threshold; (count,) which are off the border."""
    margin, ring = (np.ones((2 * size + 1, 2 * size + 1), dtype=np.uint8) for size in (_MARGIN, _RING))
    grown = cv2.dilate(labels, margin)
    near, wide = grown.ravel(), cv2.dilate(grown, ring).ravel()
    at = np.flatnonzero(wide != 0)
    label, in_near = wide[at].astype(np.intp), near[at] != 0
    value = image.ravel()[at].astype(np.float64)
    around = ~in_near
    pixels = np.bincount(label[around], minlength=count)
    enough = pixels >= _LEAST_RING
    total = np.bincount(label[around], value[around], count)
    background = np.where(enough, total / np.maximum(pixels, 1), histogram.background)
    squares = np.bincount(label[around], (value[around] - background[label[around]]) ** 2, count)
    noise = np.where(enough, squares / np.maximum(pixels - 1, 1), 0.0)
    noise = np.maximum(noise, histogram.variance)
    # from here on what is a ball's; the margin of one must not take the core of another
    core_label = labels.ravel()[at].astype(np.intp)
    label = np.where(core_label > 0, core_label, near[at])
    at, value, label, core_label = at[in_near], value[in_near], label[in_near], core_label[in_near]
    saturation = settings.saturation or float(np.iinfo(image.dtype).max)
    above = value - background[label]
    variance = noise[label] + saturation / settings.full_well * np.maximum(above, 0.0)
    variance[value >= saturation] = 0.0
    row, column = np.divmod(at, image.shape[1])
    core = np.bincount(core_label, minlength=count).astype(np.float64)
    inside = np.ones(count, dtype=bool)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        inside[border] = False
    x, y = column.astype(np.float64), row.astype(np.float64)
    return _Regions(label, x, y, above, variance, saturation - background, count), core, inside


@dataclass(frozen=True, slots=True, eq=False)
class _Measured:
    """Centroids of regions and their shape, each (count, ...) by label.

    Attributes:
        pixels: (count, 2).
        areas: (count,) pixels over half of the region's brightness.
        covariance: (count, 2, 2) by noise.
        elongation: (count,) ratio of the axes.
        fill: (count,) ratio of the area to that of an ellipse with the region's moments.
    """

    pixels: FloatArray
    areas: FloatArray
    covariance: FloatArray
    elongation: FloatArray
    fill: FloatArray

    def odd(self, settings: DetectionSettings) -> BoolArray:
        """Which regions (count,) are not the image of one whole ball."""
        areas = np.maximum(self.areas, 2.0 * _LOST)
        noise = np.sqrt(np.pi * (self.covariance[:, 0, 0] + self.covariance[:, 1, 1]) / areas)
        elongated = self.elongation > settings.elongation + _ELONGATION_NOISE * noise
        return np.asarray(elongated | (self.fill < settings.fill * (1.0 - _LOST / areas)))


def _centroids(regions: _Regions, settings: DetectionSettings) -> _Measured:
    """Centres weighted by brightness (Gaschler 2011, eq. 3.2), and their covariances."""
    label, x, y, value = regions.label, regions.x, regions.y, regions.value
    peak = np.full(regions.count, 1e-9)
    np.maximum.at(peak, label, value)
    # the linear threshold (equation 3.1) by the region's own brightness
    linear = np.clip((value / peak[label] - _LOWER) / (_UPPER - _LOWER), 0.0, 1.0)
    area = np.maximum(regions.sums(linear), 1e-9)
    centre_x, centre_y = regions.sums(linear * x) / area, regions.sums(linear * y) / area
    offset_x, offset_y = x - centre_x[label], y - centre_y[label]
    xx, yy = regions.sums(linear * offset_x**2) / area, regions.sums(linear * offset_y**2) / area
    xy = regions.sums(linear * offset_x * offset_y) / area
    middle, spread = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    long, short = np.maximum(middle + spread, 1e-3), np.maximum(middle - spread, 1e-3)
    slope = (value > 0.1 * peak[label]) & (value < 0.9 * peak[label])
    edge = np.maximum(regions.sums(slope.astype(np.float64)) / (2.0 * np.sqrt(np.pi * area)), _LEAST_EDGE)
    # a window that is symmetrical about the centroid does not move it; half a pixel is its own edge
    reach = np.where(peak >= regions.ceiling, _SATURATED_REACH, np.clip(_REACH * edge, _LEAST_REACH, _MARGIN))
    radius = 2.0 * np.sqrt(long) + reach + 0.5
    for _ in range(_PASSES):
        offset_x, offset_y = x - centre_x[label], y - centre_y[label]
        weight = np.clip(radius[label] - np.hypot(offset_x, offset_y), 0.0, 1.0)
        light = weight * value
        total = np.maximum(regions.sums(light), 1e-9)
        centre_x = centre_x + regions.sums(light * offset_x) / total
        centre_y = centre_y + regions.sums(light * offset_y) / total
    noise = weight**2 * regions.variance
    # the sharper an edge, the less can pixels tell where it is; saturation sharpens it
    floor = settings.floor * (_EDGE / edge) ** 2
    covariance = np.empty((regions.count, 2, 2))
    covariance[:, 0, 0] = regions.sums(noise * offset_x**2) / total**2
    covariance[:, 1, 1] = regions.sums(noise * offset_y**2) / total**2
    covariance[:, 0, 1] = covariance[:, 1, 0] = regions.sums(noise * offset_x * offset_y) / total**2
    covariance += floor[:, None, None] ** 2 * np.eye(2)
    fill = area / (4.0 * np.pi * np.sqrt(long * short))
    return _Measured(np.stack([centre_x, centre_y], axis=1), area, covariance, np.sqrt(long / short), fill)


def _groups(kept: IntArray, measured: _Measured) -> list[IntArray]:
    """Labels of regions that are so near to each other that they must be measured together."""
    pixels, radii = measured.pixels[kept], np.sqrt(measured.areas[kept] / np.pi)
    apart = np.linalg.norm(pixels[:, None] - pixels, axis=2) - radii[:, None] - radii
    near = apart < _APART
    if near.sum() == len(kept):
        return list(kept[:, None])
    count, group = connected_components(near, directed=False)
    return [kept[group == index] for index in range(count)]


def _explained(regions: _Regions, measured: _Measured, members: IntArray, misfit: float) -> list[_Ball]:
    """Centres, areas and covariances of the balls in regions; none where they are no balls."""
    own = np.isin(regions.label, members)
    value, variance = regions.value[own], regions.variance[own]
    ceiling = float(regions.ceiling[members].min())
    discs = explain(regions.x[own], regions.y[own], value, variance, ceiling, measured.pixels[members])
    if discs.misfit > misfit:
        return []
    areas = np.pi * discs.radii**2
    return list(zip(discs.centres, areas.tolist(), discs.covariance + _FIT_FLOOR**2 * np.eye(2), strict=True))

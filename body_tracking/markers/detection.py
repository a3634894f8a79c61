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
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers.discs import explain
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.spheres import sphere_centre_correction as sphere_centre_correction

_ROWS: Final = 4
"""Every so many rows are in the histogram, as in section 3.1.2."""
_MARGIN: Final = 3
"""Pixels around the thresholded region whose light is the ball's."""
_RING: Final = 2
"""Pixels around the margin, of the background."""
_REACH: Final = 2.0
"""Pixels by which the window of a centroid is larger than the ball."""
_APART: Final = 4.0
"""Pixels between the edges of balls that are near enough to disturb each other's centroids."""
_LEAST_RING: Final = 12
"""Pixels from which the background around a ball is known."""
_LOWER: Final = 0.2
_UPPER: Final = 0.8
_LOST: Final = 1.45
"""Pixels of area that the blur of an edge takes from :attr:`_Measured.fill`."""
_ELONGATION_NOISE: Final = 4.0
"""Elongation by noise, standard deviations of the centroid in radii of the ball."""
_PASSES: Final = 2
_QUANTISATION: Final = 1.0 / 12.0
"""Variance of rounding to whole numbers."""
_MOST: Final = 2**16 - 1


class ImageError(BodyTrackingError):
    """An array is not a grey image of 8 or 16 bits."""


@dataclass(frozen=True, slots=True)
class DetectionSettings:
    """How balls are found.

    Attributes:
        dark: quantile of the brightness that is background for sure; Gaschler has 0.98, but 15 near balls are 2 %.
        bright: quantile that is ball for sure.
        lower: where between the two the threshold is. Gaschler has 0.2; less finds a ball at 3 m beside saturated ones.
        noise: of the background, standard deviations by which the threshold is above it at least.
        least_area: pixels above the threshold; fewer are a glint or a broken pixel.
        most_area: pixels above the threshold; more are a lamp, a window, a coat.
        most_balls: of an image, the largest.
        elongation: ratio of its axes from which a region is taken for more or less than one whole ball.
        fill: ratio of its area to that of an ellipse with its moments, under which it is.
        misfit: root of the mean squared difference from discs, share of the brightness, over which a region is dropped.
        saturation: brightness at which the sensor saturates; None for the largest number of the image's type.
        full_well: electrons of a saturated pixel, for the shot noise.
        floor: standard deviation of a centroid that blur and whole numbers leave, pixels.
        saturated_floor: the same of a ball that saturates: its edge is cut off pixel by pixel.
    """

    dark: float = 0.95
    bright: float = 0.9999
    lower: float = 0.1
    noise: float = 6.0
    least_area: int = 5
    most_area: int = 2500
    most_balls: int = 64
    elongation: float = 1.12
    fill: float = 0.85
    misfit: float = 0.12
    saturation: float | None = None
    full_well: float = 10_000.0
    floor: float = 0.004
    saturated_floor: float = 0.009


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
        return np.bincount(self.label, weights, self.count)


def detect(
    image: NDArray[Any], camera: str = "", stamp_ns: int = 0, settings: DetectionSettings | None = None
) -> ImageBalls:
    """The balls in an image.

    Args:
        image: (h, w) uint8 or uint16.
        camera: its frame.
        stamp_ns: capture time, nanoseconds.
        settings: how balls are found.

    Raises:
        ImageError: another shape or type, or no pixels.
    """
    settings = settings or DetectionSettings()
    if not isinstance(image, np.ndarray) or image.ndim != 2 or image.dtype not in (np.uint8, np.uint16):
        shape, kind = getattr(image, "shape", ()), getattr(image, "dtype", type(image).__name__)
        raise ImageError(f"image of camera {camera or '(no name)'}: {shape} of {kind}, expected (h, w) uint8 or uint16")
    if not image.size:
        raise ImageError(f"image of camera {camera or '(no name)'}: {image.shape}, no pixels")
    histogram = _Histogram.of(image, settings)
    mask = cv2.compare(image, histogram.threshold, cv2.CMP_GT)
    count, labels = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    none = ImageBalls(stamp_ns, camera, np.zeros((0, 2)), np.zeros(0), np.zeros((0, 2, 2)), count - 1)
    if count == 1 or count > _MOST:
        return none
    regions, core, inside = _regions(image, labels.astype(np.uint16), count, histogram, settings)
    keep = inside & (core >= settings.least_area) & (core <= settings.most_area)
    keep[0] = False
    kept = np.flatnonzero(keep)
    kept = np.sort(kept[np.argsort(-core[kept], kind="stable")[: settings.most_balls]])
    if not len(kept):
        return none
    measured = _centroids(regions, settings)
    found, dropped = [], count - 1 - len(kept)
    for members in _groups(kept, measured):
        odd = measured.odd(members, settings)
        if len(members) == 1 and not odd[0]:
            label = members[0]
            found.append((measured.pixels[label], measured.areas[label], measured.covariance[label]))
            continue
        balls = _explained(regions, measured, members, settings)
        dropped += not balls
        found += balls
    if not found:
        return replace(none, dropped=dropped)
    pixels, areas, covariance = (np.stack(part) for part in zip(*found, strict=True))
    return ImageBalls(stamp_ns, camera, pixels, areas, covariance, dropped)


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
    margin, ring = (np.ones((2 * size + 1, 2 * size + 1), dtype=np.uint8) for size in (_MARGIN, _MARGIN + _RING))
    near = cv2.dilate(labels, margin).ravel()
    wide = cv2.dilate(labels, ring).ravel()
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
    # from here on what is a ball's
    at, value, label = at[in_near], value[in_near], near[at[in_near]].astype(np.intp)
    saturation = float(np.iinfo(image.dtype).max) if settings.saturation is None else settings.saturation
    above = value - background[label]
    variance = noise[label] + saturation / settings.full_well * np.maximum(above, 0.0)
    variance[value >= saturation] = 0.0
    row, column = np.divmod(at, image.shape[1])
    core = np.bincount(labels.ravel()[at], minlength=count).astype(np.float64)
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

    def odd(self, members: IntArray, settings: DetectionSettings) -> BoolArray:
        """Which regions (k,) are not the image of one whole ball."""
        areas = np.maximum(self.areas[members], 2.0 * _LOST)
        noise = np.sqrt(np.pi * np.trace(self.covariance[members], axis1=1, axis2=2) / areas)
        elongated = self.elongation[members] > settings.elongation + _ELONGATION_NOISE * noise
        return np.asarray(elongated | (self.fill[members] < settings.fill * (1.0 - _LOST / areas)))


def _centroids(regions: _Regions, settings: DetectionSettings) -> _Measured:
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
    # a window that is symmetrical about the centroid does not move it
    radius = 2.0 * np.sqrt(long) + _REACH + 0.5
    for _ in range(_PASSES):
        offset_x, offset_y = x - centre_x[label], y - centre_y[label]
        weight = np.clip(radius[label] - np.hypot(offset_x, offset_y), 0.0, 1.0)
        light = weight * value
        total = np.maximum(regions.sums(light), 1e-9)
        centre_x = centre_x + regions.sums(light * offset_x) / total
        centre_y = centre_y + regions.sums(light * offset_y) / total
    noise = weight**2 * regions.variance
    floor = np.where(peak >= regions.ceiling, settings.saturated_floor, settings.floor)
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


def _explained(
    regions: _Regions, measured: _Measured, members: IntArray, settings: DetectionSettings
) -> list[tuple[FloatArray, float, FloatArray]]:
    """Centres, areas and covariances of the balls in regions; none where they are no balls."""
    own = np.isin(regions.label, members)
    value, variance = regions.value[own], regions.variance[own]
    ceiling = float(regions.ceiling[members].min())
    discs = explain(regions.x[own], regions.y[own], value, variance, ceiling, measured.pixels[members])
    if discs.misfit > settings.misfit:
        return []
    areas = np.pi * discs.radii**2
    covariance = discs.covariance + settings.floor**2 * np.eye(2)
    return list(zip(discs.centres, areas.tolist(), covariance, strict=True))

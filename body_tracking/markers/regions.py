"""Bright regions of an image: their pixels, the background around them, centroids and shapes (Gaschler 2011, 3.1).

The components come from runs of bright pixels in one pass; all other loops are over the pixels near a component.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray

MARGIN: Final = 3
"""Pixels around the thresholded region whose light is the ball's."""
_RING: Final = 2
"""Pixels around the margin, of the background."""
_LEAST_RING: Final = 12
"""Pixels from which the background around a ball is known."""
_REACH: Final = 0.8
"""By which the window of a centroid is larger than the ball, widths of the edge."""
_LEAST_REACH: Final = 1.2
"""Pixels."""
_SATURATED_REACH: Final = 2.5
"""Pixels; what is left of the edge of a saturated ball is its long tail."""
_LOWER: Final = 0.2
_UPPER: Final = 0.8
_EDGE: Final = 1.3
_LEAST_EDGE: Final = 0.5
"""Pixels between 10 and 90 % of a ball's brightness."""
_PASSES: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Connected sets of bright pixels (8 neighbours), numbered from 1 in the order of their first pixels.

    Attributes:
        runs: (r, 4) row, first column, column after the last, and component of each run of bright pixels.
        areas: (count + 1,) pixels of each.
        inside: (count + 1,) which do not touch the border of the image.
    """

    runs: IntArray
    areas: IntArray
    inside: BoolArray

    @classmethod
    def of(cls, image: NDArray[Any], threshold: int) -> Components:
        """The components of the pixels above a threshold in an image (h, w), by union-find.

        Gaschler (2011): section 3.1.3.
        """
        runs, areas, inside = _components(np.flatnonzero(image.ravel() > threshold), *image.shape)
        return cls(runs, areas, inside)


@dataclass(frozen=True, slots=True, eq=False)
class Regions:
    """Pixels of n regions, one region after the other.

    Attributes:
        first: (n + 1,) first pixel of each region.
        pixels: (4, p) x, y, brightness above the background around the region, and its variance by noise.
        ceilings: (n,) brightness above the background at which the sensor saturates.
    """

    first: IntArray
    pixels: FloatArray
    ceilings: FloatArray

    def of(self, members: IntArray) -> tuple[FloatArray, float]:
        """(4, q) pixels of some regions together, and where they saturate."""
        parts = [self.pixels[:, self.first[member] : self.first[member + 1]] for member in members]
        return np.concatenate(parts, axis=1), float(self.ceilings[members].min())


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Centroids of n regions, and their shape.

    Attributes:
        pixels: (n, 2) centroids.
        areas: (n,) pixels over half of the region's brightness.
        covariance: (n, 2, 2) of the centroids, by noise.
        elongation: (n,) ratio of the axes.
        fill: (n,) ratio of the area to that of an ellipse with the region's moments.
    """

    pixels: FloatArray
    areas: FloatArray
    covariance: FloatArray
    elongation: FloatArray
    fill: FloatArray


def regions_of(
    image: NDArray[Any],
    components: Components,
    kept: IntArray,
    background: tuple[float, float],
    saturation: float,
    full_well: float,
) -> Regions:
    """The pixels of some components, with the margin around them.

    Args:
        image: (h, w) that they are in.
        components: all of them: the margin of one does not take the pixels of another.
        kept: (n,) components that are wanted.
        background: of the whole image, where that around a region is not known: brightness, and its variance.
        saturation: brightness at which the sensor saturates.
        full_well: electrons of a saturated pixel.
    """
    owner, wide = (np.zeros(image.shape, dtype=np.uint16) for _ in range(2))
    _spread(components.runs, owner, wide)
    boxes = _boxes(components.runs, kept, len(components.areas), image.shape[0], image.shape[1])
    room = int(((boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])).sum())
    pixels, first, ceilings = np.empty((4, room)), np.zeros(len(kept) + 1, dtype=np.int64), np.empty(len(kept))
    _gather(image, owner, wide, kept, boxes, background, saturation, full_well, pixels, first, ceilings)
    return Regions(first, pixels[:, : first[-1]], ceilings)


def shapes_of(regions: Regions, floor: float) -> Shapes:
    """Centroids weighted by brightness, and their covariances.

    Gaschler (2011): eq. 3.2.

    Args:
        regions: their pixels.
        floor: standard deviation of a centroid without noise where the edge is 1.3 pixels wide; see
            :class:`~body_tracking.markers.detection.DetectionSettings`.
    """
    found = np.empty((len(regions.ceilings), 8))
    _shapes(regions.first, regions.pixels, regions.ceilings, floor, found)
    return Shapes(found[:, :2], found[:, 2], found[:, [3, 4, 4, 5]].reshape(-1, 2, 2), found[:, 6], found[:, 7])


@compiled
def histogram(image: NDArray[Any], step: int, levels: int) -> IntArray:
    """(levels,) numbers of pixels of each brightness in every so many rows of an image (h, w) of whole numbers."""
    # two tables: neighbours are often equal, and need not wait for each other
    counts = np.zeros((2, levels), dtype=np.int64)
    for y in range(0, image.shape[0], step):
        for x in range(image.shape[1]):
            counts[x & 1, image[y, x]] += 1
    both: IntArray = counts[0] + counts[1]
    return both


@compiled
def _root(parent: IntArray, run: int) -> int:
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@compiled
def _components(bright: IntArray, height: int, width: int) -> tuple[IntArray, IntArray, BoolArray]:
    """Runs (r, 4), areas and which are off the border, of flat indices (b,) of bright pixels in their order."""
    runs = np.empty((len(bright), 4), dtype=np.int64)
    parent = np.empty(len(bright), dtype=np.int64)
    count, above, row_first, row = 0, 0, 0, -1
    at = 0
    while at < len(bright):
        y, x = bright[at] // width, bright[at] % width
        if y != row:
            # the runs of the row above, if it has any
            above, row_first = (row_first if y == row + 1 else count), count
            row = y
        row_last = row_first
        stop = x + 1
        at += 1
        while at < len(bright) and stop < width and bright[at] == y * width + stop:
            stop += 1
            at += 1
        runs[count, 0], runs[count, 1], runs[count, 2] = y, x, stop
        parent[count] = count
        for other in range(above, row_last):
            if runs[other, 1] > stop:
                break
            if runs[other, 2] >= x:
                one, two = _root(parent, other), _root(parent, count)
                parent[max(one, two)] = min(one, two)
        count += 1
    components = 0
    for run in range(count):
        root = _root(parent, run)
        if root == run:
            components += 1
            runs[run, 3] = components
        else:
            runs[run, 3] = runs[root, 3]
    areas, inside = np.zeros(components + 1, dtype=np.int64), np.ones(components + 1, dtype=np.bool_)
    for run in range(count):
        y, x, stop, component = runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3]
        areas[component] += stop - x
        if y == 0 or y == height - 1 or x == 0 or stop == width:
            inside[component] = False
    return runs[:count], areas, inside


@compiled
def _spread(runs: IntArray, owner: NDArray[np.uint16], wide: NDArray[np.uint16]) -> None:
    """Write the components of the pixels with their margin, and with the ring around it; 0 is none."""
    height, width = owner.shape
    for run in range(len(runs)):
        row, first, stop, component = runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3]
        for y in range(max(row - MARGIN - _RING, 0), min(row + MARGIN + _RING + 1, height)):
            for x in range(max(first - MARGIN - _RING, 0), min(stop + MARGIN + _RING, width)):
                wide[y, x] = max(wide[y, x], component)
        for y in range(max(row - MARGIN, 0), min(row + MARGIN + 1, height)):
            for x in range(max(first - MARGIN, 0), min(stop + MARGIN, width)):
                owner[y, x] = max(owner[y, x], component)
    # the margin of one does not take the core of another
    for run in range(len(runs)):
        for x in range(runs[run, 1], runs[run, 2]):
            owner[runs[run, 0], x] = runs[run, 3]


@compiled
def _boxes(runs: IntArray, kept: IntArray, count: int, height: int, width: int) -> IntArray:
    """(n, 4) first row, row after the last, first column, column after the last, with margin and ring."""
    index = np.full(count, -1, dtype=np.int64)
    boxes = np.empty((len(kept), 4), dtype=np.int64)
    for k in range(len(kept)):
        index[kept[k]] = k
        boxes[k, 0], boxes[k, 1], boxes[k, 2], boxes[k, 3] = height, 0, width, 0
    around = MARGIN + _RING
    for run in range(len(runs)):
        k = index[runs[run, 3]]
        if k >= 0:
            boxes[k, 0] = max(min(boxes[k, 0], runs[run, 0] - around), 0)
            boxes[k, 1] = min(max(boxes[k, 1], runs[run, 0] + around + 1), height)
            boxes[k, 2] = max(min(boxes[k, 2], runs[run, 1] - around), 0)
            boxes[k, 3] = min(max(boxes[k, 3], runs[run, 2] + around), width)
    return boxes


@compiled
def _gather(
    image: NDArray[Any],
    owner: NDArray[np.uint16],
    wide: NDArray[np.uint16],
    kept: IntArray,
    boxes: IntArray,
    background: tuple[float, float],
    saturation: float,
    full_well: float,
    pixels: FloatArray,
    first: IntArray,
    ceilings: FloatArray,
) -> None:
    """Write the fields of :class:`Regions`."""
    at = 0
    for k in range(len(kept)):
        ring, total = 0, 0.0
        for y in range(boxes[k, 0], boxes[k, 1]):
            for x in range(boxes[k, 2], boxes[k, 3]):
                if owner[y, x] == 0 and wide[y, x] == kept[k]:
                    ring += 1
                    total += image[y, x]
        level, noise = background
        if ring >= _LEAST_RING:
            level = total / ring
            squares = 0.0
            for y in range(boxes[k, 0], boxes[k, 1]):
                for x in range(boxes[k, 2], boxes[k, 3]):
                    if owner[y, x] == 0 and wide[y, x] == kept[k]:
                        squares += (image[y, x] - level) ** 2
            noise = max(squares / (ring - 1), noise)
        ceilings[k] = saturation - level
        for y in range(boxes[k, 0], boxes[k, 1]):
            for x in range(boxes[k, 2], boxes[k, 3]):
                if owner[y, x] == kept[k]:
                    above = image[y, x] - level
                    pixels[0, at], pixels[1, at], pixels[2, at] = x, y, above
                    shot = saturation / full_well * max(above, 0.0)
                    pixels[3, at] = noise + shot if image[y, x] < saturation else 0.0
                    at += 1
        first[k + 1] = at


@compiled
def _shapes(first: IntArray, pixels: FloatArray, ceilings: FloatArray, floor: float, found: FloatArray) -> None:
    """Write centroid x, y, area, covariance xx, xy, yy, elongation and fill of each region."""
    for k in range(len(ceilings)):
        peak = 1e-9
        for n in range(first[k], first[k + 1]):
            peak = max(peak, pixels[2, n])
        # the linear threshold (equation 3.1) by the region's own brightness; moments about any pixel of the region
        near_x, near_y = pixels[0, first[k]], pixels[1, first[k]]
        area, sx, sy, sxx, sxy, syy, slopes = 1e-9, 0.0, 0.0, 0.0, 0.0, 0.0, 0
        for n in range(first[k], first[k + 1]):
            share = pixels[2, n] / peak
            slopes += 0.1 < share < 0.9
            weight = min(max((share - _LOWER) / (_UPPER - _LOWER), 0.0), 1.0)
            dx, dy = pixels[0, n] - near_x, pixels[1, n] - near_y
            area += weight
            sx += weight * dx
            sy += weight * dy
            sxx += weight * dx * dx
            sxy += weight * dx * dy
            syy += weight * dy * dy
        sx, sy = sx / area, sy / area
        xx, xy, yy = sxx / area - sx * sx, sxy / area - sx * sy, syy / area - sy * sy
        middle, spread = 0.5 * (xx + yy), math.sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        long, short = max(middle + spread, 1e-3), max(middle - spread, 1e-3)
        edge = max(slopes / (2.0 * math.sqrt(math.pi * area)), _LEAST_EDGE)
        # a window that is symmetrical about the centroid does not move it; half a pixel is its own edge
        reach = min(max(_REACH * edge, _LEAST_REACH), float(MARGIN))
        if peak >= ceilings[k]:
            reach = _SATURATED_REACH
        radius = 2.0 * math.sqrt(long) + reach + 0.5
        centre_x, centre_y = near_x + sx, near_y + sy
        total = cxx = cxy = cyy = 0.0
        for _ in range(_PASSES):
            total, sx, sy, cxx, cxy, cyy = 1e-9, 0.0, 0.0, 0.0, 0.0, 0.0
            for n in range(first[k], first[k + 1]):
                dx, dy = pixels[0, n] - centre_x, pixels[1, n] - centre_y
                weight = min(max(radius - math.sqrt(dx * dx + dy * dy), 0.0), 1.0)
                light, noise = weight * pixels[2, n], weight * weight * pixels[3, n]
                total += light
                sx += light * dx
                sy += light * dy
                cxx += noise * dx * dx
                cxy += noise * dx * dy
                cyy += noise * dy * dy
            total = max(total, 1e-9)
            centre_x += sx / total
            centre_y += sy / total
        # the sharper an edge, the less can pixels tell where it is; saturation sharpens it
        least = (floor * (_EDGE / edge) ** 2) ** 2
        found[k, 0], found[k, 1], found[k, 2] = centre_x, centre_y, area
        found[k, 3] = cxx / total**2 + least
        found[k, 4] = cxy / total**2
        found[k, 5] = cyy / total**2 + least
        found[k, 6] = math.sqrt(long / short)
        found[k, 7] = area / (4.0 * math.pi * math.sqrt(long * short))

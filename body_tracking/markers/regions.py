"""Bright regions of an image: their pixels, the background around them, centroids and shapes (Gaschler 2011, 3.1).

Runs of bright pixels give the components in one pass; all other loops are over the pixels near a component.
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
"""Pixels around the thresholded region that still contain the ball's light."""
_RING: Final = 2
"""Width of the background ring around the margin, pixels."""
_LEAST_RING: Final = 12
"""Least number of pixels in the ring for a local estimate of the background."""
_REACH: Final = 0.8
"""Margin of the centroid's window beyond the ball, in widths of the edge."""
_LEAST_REACH: Final = 1.2
"""Lower bound of that margin, pixels."""
_SATURATED_REACH: Final = 2.5
"""That margin for a saturated ball, pixels: only the long tail of its edge remains unsaturated."""
_LOWER: Final = 0.2
_UPPER: Final = 0.8
_EDGE: Final = 1.3
_LEAST_EDGE: Final = 0.5
"""Width of a ball's edge from 10 to 90 % of its brightness, pixels: typical and least."""
_PASSES: Final = 2


@dataclass(frozen=True, slots=True, eq=False)
class Components:
    """Connected sets of bright pixels (8 neighbours), numbered from 1 in the order of their first pixels.

    Attributes:
        runs: (r, 4) row, first column, column after the last, and component of each run of bright pixels.
        areas: (count + 1,) number of pixels of each component.
        inside: (count + 1,) whether it does not touch the border of the image.
    """

    runs: IntArray
    areas: IntArray
    inside: BoolArray

    @classmethod
    def of(cls, image: NDArray[Any], threshold: int) -> Components:
        """The components of the pixels above a threshold in an image (h, w), by union-find.

        Gaschler (2011): section 3.1.3.
        """
        bright = image.ravel() > threshold
        words = np.flatnonzero(bright[: bright.size // 8 * 8].view(np.uint64))  # groups of 8 pixels; most are dark
        return cls(*_components(bright, words, *image.shape))


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
        """Pixels (4, q) of some regions together, and their lowest saturation level."""
        parts = [self.pixels[:, self.first[member] : self.first[member + 1]] for member in members]
        return np.concatenate(parts, axis=1), float(self.ceilings[members].min())


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Centroids of n regions, and their shape.

    Attributes:
        pixels: (n, 2) centroids.
        areas: (n,) soft-thresholded area about the region's half brightness, pixels.
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
    """The pixels of the kept components, with the margin around them.

    Args:
        image: (h, w).
        components: all components: the margin of one excludes the pixels of another.
        kept: (n,) indices of the components wanted.
        background: brightness and variance of the whole image's background, used where no local estimate exists.
        saturation: brightness at which the sensor saturates.
        full_well: electrons of a saturated pixel.
    """
    boxes = _boxes(components.runs, kept, len(components.areas), image.shape[0], image.shape[1])
    room = int(((boxes[:, 1] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 2])).sum())
    pixels, first, ceilings = np.empty((4, room)), np.zeros(len(kept) + 1, dtype=np.int64), np.empty(len(kept))
    _gather(image, components.runs, kept, boxes, background, saturation, full_well, pixels, first, ceilings)
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
    """(levels,) number of pixels of each brightness in every ``step``-th row of an integer image (h, w)."""
    # two tables, so that equal neighbours do not update one counter in sequence
    counts = np.zeros((2, levels), dtype=np.int64)
    for y in range(0, image.shape[0], step):
        for x in range(image.shape[1]):
            counts[x & 1, image[y, x]] += 1
    both: IntArray = counts[0] + counts[1]
    return both


@compiled
def background_of(counts: IntArray, dark: float, bright: float) -> tuple[int, int, float, float]:
    """Two quantiles of a histogram (levels,), and mean and variance of the levels up to the first."""
    total = 0
    for level in range(len(counts)):
        total += counts[level]
    first, second, passed = -1, -1, 0
    number = sum1 = sum2 = 0.0
    for level in range(len(counts)):
        passed += counts[level]
        if first < 0:
            number += counts[level]
            sum1 += level * counts[level]
            if passed >= dark * total:
                first = level
        if passed >= bright * total:
            second = level
            break
    mean = sum1 / number
    for level in range(first + 1):
        sum2 += (level - mean) ** 2 * counts[level]
    return first, second, mean, sum2 / number


@compiled
def _root(parent: IntArray, run: int) -> int:
    while parent[run] != run:
        parent[run] = parent[parent[run]]
        run = parent[run]
    return run


@compiled
def _components(bright: BoolArray, words: IntArray, height: int, width: int) -> tuple[IntArray, IntArray, BoolArray]:
    """Runs (r, 4), areas and inside masks from pixels (p,) and the indices of groups of eight with a bright one."""
    runs = np.empty((4 * len(words) + 4, 4), dtype=np.int64)
    count, row, stop = 0, -1, 0
    for index in range(len(words) + 1):
        start = 8 * words[index] if index < len(words) else len(bright) // 8 * 8
        for at in range(start, min(start + 8, len(bright))):
            if bright[at]:
                y, x = at // width, at % width
                if y != row or x != stop:
                    runs[count, 0], runs[count, 1] = y, x
                    row = y
                    count += 1
                stop = x + 1
                runs[count - 1, 2] = stop
    # above .. first: runs of the row above
    parent, above, first, row = np.empty(count, dtype=np.int64), 0, 0, -1
    for run in range(count):
        y, x, stop = runs[run, 0], runs[run, 1], runs[run, 2]
        parent[run] = run
        if y != row:
            above, first = (first if y == row + 1 else run), run
            row = y
        for other in range(above, first):
            if runs[other, 1] > stop:
                break
            if runs[other, 2] >= x:
                one, two = _root(parent, other), _root(parent, run)
                parent[max(one, two)] = min(one, two)
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
def _spread(
    runs: IntArray, first: int, last: int, box: IntArray, owner: NDArray[np.uint16], wide: NDArray[np.uint16]
) -> None:
    """Write the components of a box's pixels with their margin (owner) and with the ring (wide); 0 is none.

    Args:
        runs: of the image; those from first until before last are in rows near the box.
        first: index.
        last: index.
        box: (4,) see :func:`_boxes`.
        owner: zeros of the box's size.
        wide: zeros of the box's size.
    """
    top, bottom, left, right = box
    for run in range(first, last):
        row, start, stop, component = runs[run, 0], runs[run, 1], runs[run, 2], runs[run, 3]
        if start - MARGIN - _RING >= right or stop + MARGIN + _RING <= left:
            continue
        for y in range(max(row - MARGIN - _RING, top), min(row + MARGIN + _RING + 1, bottom)):
            for x in range(max(start - MARGIN - _RING, left), min(stop + MARGIN + _RING, right)):
                wide[y - top, x - left] = max(wide[y - top, x - left], component)
        for y in range(max(row - MARGIN, top), min(row + MARGIN + 1, bottom)):
            for x in range(max(start - MARGIN, left), min(stop + MARGIN, right)):
                owner[y - top, x - left] = max(owner[y - top, x - left], component)
    # the margin of one component excludes the core of another
    for run in range(first, last):
        if top <= runs[run, 0] < bottom:
            for x in range(max(runs[run, 1], left), min(runs[run, 2], right)):
                owner[runs[run, 0] - top, x - left] = runs[run, 3]


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
    runs: IntArray,
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
    starts = np.zeros(image.shape[0] + 1, dtype=np.int64)  # first run of each row
    for run in range(len(runs)):
        starts[runs[run, 0] + 1] += 1
    for y in range(image.shape[0]):
        starts[y + 1] += starts[y]
    at, around = 0, MARGIN + _RING
    for k in range(len(kept)):
        top, bottom, left, right = boxes[k]
        owner = np.zeros((bottom - top, right - left), dtype=np.uint16)
        wide = np.zeros((bottom - top, right - left), dtype=np.uint16)
        near = starts[max(top - around, 0)], starts[min(bottom + around, image.shape[0])]
        _spread(runs, near[0], near[1], boxes[k], owner, wide)
        ring, total = 0, 0.0
        for y in range(top, bottom):
            for x in range(left, right):
                if owner[y - top, x - left] == 0 and wide[y - top, x - left] == kept[k]:
                    ring += 1
                    total += image[y, x]
        level, noise = background
        if ring >= _LEAST_RING:
            level = total / ring
            squares = 0.0
            for y in range(top, bottom):
                for x in range(left, right):
                    if owner[y - top, x - left] == 0 and wide[y - top, x - left] == kept[k]:
                        squares += (image[y, x] - level) ** 2
            noise = max(squares / (ring - 1), noise)
        ceilings[k] = saturation - level
        for y in range(top, bottom):
            for x in range(left, right):
                if owner[y - top, x - left] == kept[k]:
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
        # linear threshold (equation 3.1) from the region's own brightness; moments about the region's first pixel
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
        # a window symmetric about the centroid does not bias it; its edge is one pixel wide
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
        # the sharper the edge, the worse pixels sample it; saturation sharpens it
        least = (floor * (_EDGE / edge) ** 2) ** 2
        found[k, 0], found[k, 1], found[k, 2] = centre_x, centre_y, area
        found[k, 3] = cxx / total**2 + least
        found[k, 4] = cxy / total**2
        found[k, 5] = cyy / total**2 + least
        found[k, 6] = math.sqrt(long / short)
        found[k, 7] = area / (4.0 * math.pi * math.sqrt(long * short))


@compiled
def groups_of(pixels: FloatArray, areas: FloatArray, apart: float) -> IntArray:
    """(n,) index of the first region of each region's group; edges in a group are nearer than ``apart``, pixels."""
    count = len(areas)
    parent = np.arange(count)
    for one in range(count):
        for other in range(one):
            reach = apart + math.sqrt(areas[one] / math.pi) + math.sqrt(areas[other] / math.pi)
            if math.hypot(pixels[one, 0] - pixels[other, 0], pixels[one, 1] - pixels[other, 1]) < reach:
                first, second = _root(parent, one), _root(parent, other)
                parent[max(first, second)] = min(first, second)
    for one in range(count):
        parent[one] = _root(parent, one)
    return parent

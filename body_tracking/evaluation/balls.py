"""Ball detection for the baseline tests: red balls in colour and depth, retro-reflective balls in infrared images.

Schlagenhauf 2017, section 4.1.1: a filter of red, a binary image, detection of circles, and the depth at the centroid
(figure 4.4). A retro-reflective ball (section 4.1.2) returns so much of the camera's own light that a time-of-flight
camera measures no depth there, which distinguishes it from other bright objects.
"""

from __future__ import annotations

from typing import Any, Final, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.markers.detection import detect
from body_tracking.markers.spheres import sphere_centre_correction

_HUE: Final = 8
"""Largest distance of a red pixel's hue from red, in OpenCV's 180 steps of the circle."""
_SATURATION, _VALUE = 110, 40
"""Least saturation and value of a red pixel, of 255; also in the ball's own shade. Chosen on rendered images."""
_LEAST_AREA: Final = 20.0
"""Least area of a red region, pixels."""
_ROUND: Final = 0.8
"""Least share of its smallest enclosing circle that a round region fills; an ellipse fills the ratio of its axes."""
_SIZES: Final = (0.7, 1.4)
"""Limits of the ratio of a ball's measured radius to its true one."""
_INNER: Final = 0.6
"""Share of the ball's radius within which depth is used: flying pixels and holes are at its outline."""
_LEAST_DEPTHS: Final = 6
"""Least number of pixels with depth on a ball."""
_LARGEST_HOLE: Final = 0.5
"""Share of a ball's pixels with depth, below which it is retro-reflective."""


class RedBalls(NamedTuple):
    """The red balls in an image.

    Attributes:
        centres: (k, 3) metres, in the camera's optical frame.
        without_depth: number of round red regions without depth.
    """

    centres: FloatArray
    without_depth: int


def red_balls(image: NDArray[np.uint8], depth: SingleArray, colour: Camera, view: Camera, radius: float) -> RedBalls:
    """Centres of red balls (Schlagenhauf 2017, section 4.1.1; figure 4.4): the median depth plus the radius.

    The radius is added along the ray through the ball's centroid: each pixel with depth gives the distance at which a
    sphere centred on that ray passes through its point. The median is over the pixels near the centroid.

    Args:
        image: (height, width, 3) red, green, blue.
        depth: metres, 0 where missing, registered to the colour image; of any size.
        colour: intrinsics of the colour image.
        view: intrinsics of the depth image, with the same optical centre.
        radius: of the balls, metres.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    low, high = (0, _SATURATION, _VALUE), (179, 255, 255)
    red = cv2.bitwise_or(cv2.inRange(hsv, low, (_HUE, 255, 255)), cv2.inRange(hsv, (179 - _HUE, *low[1:]), high))
    outlines, _ = cv2.findContours(red, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    focal = float(np.sqrt(colour.matrix[0, 0] * colour.matrix[1, 1]))
    centres, without_depth = [], 0
    for outline in outlines:
        moments = cv2.moments(outline)
        # the outline passes through pixel centres: by Pick's theorem this is the number of pixels on and inside it
        area = moments["m00"] + 0.5 * len(outline) + 1.0
        if area < _LEAST_AREA or not moments["m00"] > 0.0:
            continue
        _, reach = cv2.minEnclosingCircle(outline)
        if area < _ROUND * np.pi * (reach + 0.5) ** 2:
            continue
        middle = np.array([moments["m10"], moments["m01"]]) / moments["m00"]
        size = float(np.sqrt(area / np.pi)) / focal
        distance = _distance(depth, view, _ray(colour, middle), size, radius)
        if distance is None:
            without_depth += 1
            continue
        along = float(distance * _ray(colour, middle)[2])
        if _SIZES[0] * radius < size * along < _SIZES[1] * radius:
            shift = sphere_centre_correction(colour, middle[None], np.array([along]), radius)[0]
            centres.append(distance * _ray(colour, middle + shift))
    return RedBalls(np.array(centres).reshape(-1, 3), without_depth)


def _ray(camera: Camera, pixel: FloatArray) -> FloatArray:
    """(3,) unit vector through a pixel (2,)."""
    ray = np.append(camera.undistort(pixel), 1.0)
    return np.asarray(ray / np.linalg.norm(ray))


def _distance(depth: SingleArray, view: Camera, ray: FloatArray, size: float, radius: float) -> float | None:
    """Metres along a ray to the centre of a ball of angular radius ``size``; None without enough depth on it."""
    middle = view.project(ray)
    reach = size * float(view.matrix[0, 0])
    rows, columns = np.mgrid[
        max(0, round(middle[1] - reach)) : max(0, round(middle[1] + reach) + 1),
        max(0, round(middle[0] - reach)) : max(0, round(middle[0] + reach) + 1),
    ].reshape(2, -1)
    inside = (rows < depth.shape[0]) & (columns < depth.shape[1])
    rows, columns = rows[inside], columns[inside]
    near = (columns - middle[0]) ** 2 + (rows - middle[1]) ** 2 <= (_INNER * reach) ** 2
    near &= depth[rows, columns] > 0.0
    if np.count_nonzero(near) < _LEAST_DEPTHS:
        return None
    flat = view.undistort(np.column_stack([columns[near], rows[near]]).astype(np.float64))
    points = depth[rows[near], columns[near], None] * np.column_stack([flat, np.ones(len(flat))])
    passed = points @ ray
    aside = (points**2).sum(axis=1) - passed**2
    return float(np.nanmedian(passed + np.sqrt(np.maximum(radius**2 - aside, 0.0))))


class BrightBalls(NamedTuple):
    """Bright balls in an infrared image.

    Attributes:
        pixels: (k, 2) centroids of balls without depth.
        radii: (k,) pixels.
        with_depth: number of balls with depth, which are not retro-reflective.
    """

    pixels: FloatArray
    radii: FloatArray
    with_depth: int


def bright_balls(infrared: NDArray[Any], depth: SingleArray) -> BrightBalls:
    """Detect retro-reflective balls (Schlagenhauf 2017, section 4.1.2; figure 4.9): bright regions without depth.

    Args:
        infrared: (height, width) brightness of 8 or 16 bits.
        depth: (height, width) metres, from the same camera, 0 where missing.
    """
    found = detect(infrared)
    radii = np.sqrt(found.areas / np.pi)
    rows, columns = (np.arange(size) for size in depth.shape)
    kept = []
    for pixel, radius in zip(found.pixels, radii, strict=True):
        reach = int(np.ceil(radius))
        left, top = (max(int(place) - reach, 0) for place in pixel)
        down, across = slice(top, top + 2 * reach + 2), slice(left, left + 2 * reach + 2)
        part = depth[down, across]
        disc = (columns[across] - pixel[0]) ** 2 + (rows[down, None] - pixel[1]) ** 2 <= radius**2
        kept.append(bool((part[disc] > 0.0).mean() < _LARGEST_HOLE) if disc.any() else False)
    retro = np.array(kept, dtype=np.bool_)
    return BrightBalls(found.pixels[retro], radii[retro], int(np.count_nonzero(~retro)))

"""Rendered images of retro-reflective balls in an infrared camera, with ground truth.

A ball is the set of rays within the angle asin(radius / distance) of its centre. Rays are on a grid finer than the
pixels; rays at the edge are weighted by their distance from it, so that the rendered centroid matches the outline's
within a thousandth of a pixel. Brightness is relative to the sensor's saturation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, SingleArray
from body_tracking.markers.spheres import outlines, polygon_centroids

Image = NDArray[Any]

_PAD: Final = 8
"""Pixels of padding around the image, so that blur carries light across its border."""
_MOST_INSTANTS: Final = 32


class RenderingError(BodyTrackingError):
    """Raised for a scene that cannot be rendered."""


@dataclass(frozen=True, slots=True)
class Sensor:
    """A camera's sensor and light.

    Attributes:
        bits: per pixel; up to 8 give a uint8 image, 9 to 16 a uint16 one.
        brightness: of a ball at 1 m; falls with the square of the distance.
        background: brightness of everything else.
        blur: standard deviation of the Gaussian point spread, pixels.
        read_noise: standard deviation.
        full_well: electrons of a saturated pixel, for the shot noise.
        exposure: seconds.
        supersampling: rays across a pixel.
    """

    bits: int = 8
    brightness: float = 1.5
    background: float = 0.02
    blur: float = 0.7
    read_noise: float = 0.004
    full_well: float = 10_000.0
    exposure: float = 0.001
    supersampling: int = 4

    def __post_init__(self) -> None:
        if not (1 <= self.bits <= 16 and self.supersampling >= 1 and self.full_well > 0.0):
            raise RenderingError(
                f"{self.bits} bits, {self.supersampling} rays across a pixel, {self.full_well} electrons: expected "
                "1 to 16, 1 or more, more than none"
            )

    def expose(self, light: SingleArray, random: np.random.Generator) -> Image:
        """Image of the light (h, w) with noise, saturation and rounding."""
        most = 2**self.bits - 1
        counts = random.standard_normal(light.shape, dtype=np.float32)
        counts *= np.sqrt(np.maximum(light, 0.0) / self.full_well + self.read_noise**2)
        counts += light
        counts *= most
        counts += 0.5
        np.clip(counts, 0.0, most, out=counts)
        return counts.astype(np.uint8 if self.bits <= 8 else np.uint16)


@dataclass(frozen=True, slots=True, eq=False)
class Capsule:
    """An occluding limb: all points within a radius of a segment.

    Attributes:
        start: (3,) and
        end: (3,) metres, in the frame of the balls.
        radius: metres.
    """

    start: FloatArray
    end: FloatArray
    radius: float


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """An image and its ground truth.

    Attributes:
        image: (h, w) uint8 or uint16.
        centres: (n, 2) pixels, projections of the balls' centres at mid-exposure.
        centroids: (n, 2) pixels, centroids of the unoccluded outlines.
        visible: (n,) share of each ball's outline within the image and not hidden.
    """

    image: Image
    centres: FloatArray
    centroids: FloatArray
    visible: FloatArray


@lru_cache(maxsize=8)
def _ideal(camera: Camera) -> FloatArray:
    """(h + 2 _PAD, w + 2 _PAD, 2) undistorted coordinates of the pixels of the image and its padding.

    1e3 where the lens maps no direction to the pixel.
    """
    x, y = np.arange(-_PAD, camera.width + _PAD), np.arange(-_PAD, camera.height + _PAD)
    return np.nan_to_num(camera.undistort(np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)), nan=1e3)


def _between(first: int, last: int, size: int, supersampling: int) -> FloatArray:
    """Linear interpolation (pixels * supersampling, size) from pixels to the rays across pixels first to last."""
    at = np.repeat(np.arange(first, last), supersampling) + np.tile(
        (np.arange(supersampling) + 0.5) / supersampling - 0.5, last - first
    )
    left = np.clip(np.floor(at).astype(np.intp), 0, size - 2)
    weights = np.zeros((len(at), last - first + 2))
    rows = np.arange(len(at))
    weights[rows, left - first + 1] = 1.0 - (at - left)
    weights[rows, left - first + 2] = at - left
    return weights


@dataclass(slots=True, eq=False)
class _Scene:
    """Balls and limbs at one instant in the camera's frame."""

    camera: Camera
    centres: FloatArray
    radius: float
    limbs: Sequence[tuple[FloatArray, FloatArray, float]]
    distance: FloatArray = field(init=False)

    def __post_init__(self) -> None:
        self.distance = np.linalg.norm(self.centres, axis=1)

    def visible(self, index: int, rays: FloatArray, edge: float) -> FloatArray:
        """Share (...) of rays (..., 3) that hit a ball and nothing in front of it; edge: rays per radian."""
        shown = self._share(index, rays, edge)
        half_angle = self.radius / self.distance
        for other in np.flatnonzero(self.distance < self.distance[index]):
            between = self.centres[other] / self.distance[other] - self.centres[index] / self.distance[index]
            if np.linalg.norm(between) < 1.1 * (half_angle[other] + half_angle[index]):
                shown *= 1.0 - self._share(int(other), rays, edge)
        for start, end, radius in self.limbs:
            shown *= 1.0 - self._hidden(start, end, radius, rays, edge, self.distance[index])
        return shown

    def _share(self, index: int, rays: FloatArray, edge: float) -> FloatArray:
        axis = self.centres[index] / self.distance[index]
        angle = np.arccos(np.minimum(rays @ axis, 1.0))
        share: FloatArray = np.clip(0.5 + edge * (np.arcsin(self.radius / self.distance[index]) - angle), 0.0, 1.0)
        return share

    @staticmethod
    def _hidden(
        start: FloatArray, end: FloatArray, radius: float, rays: FloatArray, edge: float, before: float
    ) -> FloatArray:
        """Share (...) of rays that pass within the radius of a segment nearer than ``before``."""
        along = end - start
        length = float(along @ along)
        # closest points of the ray s u and of the segment start + t along
        u_along, u_start = rays @ along, rays @ start
        determinant = np.maximum(length - u_along**2, 1e-12)
        t = np.clip((u_along * u_start - float(along @ start)) / determinant, 0.0, 1.0)
        nearest = start + t[..., None] * along
        s = np.maximum((rays * nearest).sum(axis=-1), 1e-6)
        gap = np.linalg.norm(nearest - s[..., None] * rays, axis=-1)
        hidden: FloatArray = np.clip(0.5 + edge * (radius - gap) / s, 0.0, 1.0) * (s < before)
        return hidden


def render(
    camera: Camera,
    rotation: FloatArray,
    translation: FloatArray,
    balls: FloatArray,
    diameter: float,
    sensor: Sensor,
    seed: int,
    *,
    velocities: FloatArray | None = None,
    limbs: Sequence[Capsule] = (),
    glints: int = 0,
) -> Rendered:
    """Render an infrared image of balls.

    Args:
        camera: the camera.
        rotation: (3, 3) and
        translation: (3,) metres: a ball x is at ``rotation @ x + translation`` in the camera's frame.
        balls: (n, 3) centres, metres, at mid-exposure.
        diameter: of the balls, metres.
        sensor: of the camera.
        seed: of noise and glints; use a different one for each camera and image.
        velocities: (n, 3) metres per second, in the frame of the balls; None for balls at rest.
        limbs: occluders, in the frame of the balls.
        glints: number of bright spots at random places, independent of other cameras.

    Raises:
        RenderingError: other shapes, numbers that are not finite, a diameter that is not positive.
    """
    if balls.ndim != 2 or balls.shape[1] != 3 or (velocities is not None and velocities.shape != balls.shape):
        shape = None if velocities is None else velocities.shape
        raise RenderingError(f"balls {balls.shape} and velocities {shape}, expected both (n, 3)")
    if not (np.isfinite(balls).all() and np.isfinite(diameter) and diameter > 0.0):
        raise RenderingError(f"balls of {diameter} m: a place or the diameter is no number")
    random = np.random.default_rng(seed)
    radius, count = 0.5 * diameter, len(balls)
    centres = balls @ rotation.T + translation
    moved = np.zeros_like(centres) if velocities is None else sensor.exposure * velocities @ rotation.T
    outline = outlines(camera, centres, radius)
    centroids, areas = polygon_centroids(outline)
    placed = [(rotation @ limb.start + translation, rotation @ limb.end + translation, limb.radius) for limb in limbs]
    steps = camera.project(centres + 0.5 * moved) - camera.project(centres - 0.5 * moved)
    reach = np.nan_to_num(np.abs(steps).max(initial=0.0))
    instants = 1 if velocities is None else int(np.clip(np.ceil(2.0 * reach), 1, _MOST_INSTANTS))
    at = (np.arange(instants) + 0.5) / instants - 0.5
    scenes = [_Scene(camera, centres + moved * step, radius, placed) for step in at]
    size = camera.height + 2 * _PAD, camera.width + 2 * _PAD
    light, visible = np.full(size, sensor.background, dtype=np.float32), np.zeros(count)
    seen = np.flatnonzero(np.isfinite(outline).all(axis=(1, 2)) & (centres[:, 2] > radius))
    for index in seen:
        margin = 2.0 + 4.0 * sensor.blur + 0.5 * np.abs(steps[index])
        low = np.floor(outline[index].min(axis=0) - margin).astype(np.intp) + _PAD
        high = np.ceil(outline[index].max(axis=0) + margin).astype(np.intp) + _PAD + 1
        patch = _patch(camera, low, high, sensor.supersampling)
        if patch is None:
            continue
        rays, edge, (rows, columns) = patch
        shown = np.mean([scene.visible(int(index), rays, edge) for scene in scenes], axis=0)
        whole = _binned(shown, sensor.supersampling)
        y, x = np.arange(rows.start, rows.stop) - _PAD, np.arange(columns.start, columns.stop) - _PAD
        inside = ((y >= 0) & (y < camera.height))[:, None] & ((x >= 0) & (x < camera.width))
        visible[index] = whole[inside].sum() / areas[index]
        if sensor.blur > 0.0:
            spread = sensor.blur * sensor.supersampling
            shown = np.asarray(
                cv2.GaussianBlur(shown, (0, 0), spread, borderType=cv2.BORDER_CONSTANT), dtype=np.float64
            )
            whole = _binned(shown, sensor.supersampling)
        light[rows, columns] += sensor.brightness / float(centres[index] @ centres[index]) * whole
    light = light[_PAD:-_PAD, _PAD:-_PAD]
    _add_glints(light, glints, random)
    visible = np.minimum(visible, 1.0)
    return Rendered(sensor.expose(light, random), camera.project(centres), centroids, visible)


def _patch(
    camera: Camera, low: NDArray[np.intp], high: NDArray[np.intp], supersampling: int
) -> tuple[FloatArray, float, tuple[slice, slice]] | None:
    """Rays of a part of the padded image, rays per radian, and the part; None if it is outside."""
    ideal = _ideal(camera)
    height, width = ideal.shape[:2]
    left, top = np.maximum(low, 1).tolist()
    right, bottom = np.minimum(high, [width - 1, height - 1]).tolist()
    if right <= left or bottom <= top:
        return None
    down = _between(top, bottom, height, supersampling)
    across = _between(left, right, width, supersampling)
    part = np.moveaxis(ideal[top - 1 : bottom + 1, left - 1 : right + 1], -1, 0)
    x, y = down @ part @ across.T
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    rays /= np.sqrt(x * x + y * y + 1.0)[..., None]
    # pixels per radian: f / cos^2 radially, f / cos tangentially; only the width of an edge depends on it
    cosine = float(rays[rays.shape[0] // 2, rays.shape[1] // 2, 2])
    edge = supersampling * float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])) / cosine**1.5
    return rays, edge, (slice(top, bottom), slice(left, right))


def _binned(values: FloatArray, supersampling: int) -> FloatArray:
    """Means of blocks of supersampling x supersampling."""
    height, width = values.shape[0] // supersampling, values.shape[1] // supersampling
    means: FloatArray = values.reshape(height, supersampling, width, supersampling).mean(axis=(1, 3))
    return means


def _add_glints(light: SingleArray, count: int, random: np.random.Generator) -> None:
    """Add spots with axes of 0.4 to 4 pixels in random directions, up to twice as bright as saturation."""
    height, width = light.shape
    for _ in range(count):
        x, y = random.uniform(0, width), random.uniform(0, height)
        long, short = np.exp(random.uniform(np.log(0.4), np.log(4.0), 2))
        angle, peak = random.uniform(0.0, np.pi), random.uniform(0.2, 2.0)
        reach = int(np.ceil(4.0 * max(long, short)))
        rows = slice(max(0, int(y) - reach), min(height, int(y) + reach + 1))
        columns = slice(max(0, int(x) - reach), min(width, int(x) + reach + 1))
        across, down = np.meshgrid(np.arange(columns.start, columns.stop) - x, np.arange(rows.start, rows.stop) - y)
        u = (np.cos(angle) * across + np.sin(angle) * down) / long
        v = (np.cos(angle) * down - np.sin(angle) * across) / short
        light[rows, columns] += peak * np.exp(-0.5 * (u * u + v * v))


def render_chessboard(
    camera: Camera,
    rotation: FloatArray,
    translation: FloatArray,
    columns: int,
    rows: int,
    square: float,
    seed: int,
    sensor: Sensor | None = None,
    *,
    black: float = 0.08,
    white: float = 0.7,
) -> Image:
    """Render a chessboard.

    Args:
        camera: the camera.
        rotation: (3, 3) and
        translation: (3,) metres: a point x of the board is at ``rotation @ x + translation`` in the camera's frame.
        columns: and
        rows: of inner corners, as OpenCV counts; corner (i, j) is at (i square, j square, 0).
        square: its side, metres.
        seed: of the noise.
        sensor: of the camera; its brightness, that of balls, is not used.
        black: brightness of the dark squares.
        white: brightness of the other squares and of a margin of one square around the board.

    Raises:
        RenderingError: no corners, or squares without a size.
    """
    if columns < 1 or rows < 1 or not square > 0.0:
        raise RenderingError(f"{columns} x {rows} corners and squares of {square} m: expected some of some size")
    sensor = sensor or Sensor()
    ideal = _ideal(camera)
    # board coordinates in squares, homogeneous: the inverse of the plane's homography
    plane = np.linalg.inv(np.stack([rotation[:, 0] * square, rotation[:, 1] * square, translation], axis=1))
    flat = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1) @ plane.T
    right, down = 0.5 * (np.roll(flat, -1, 1) - np.roll(flat, 1, 1)), 0.5 * (np.roll(flat, -1, 0) - np.roll(flat, 1, 0))
    flat, right, down = (part[1:-1, 1:-1].reshape(-1, 3).T.copy() for part in (flat, right, down))
    shape = ideal.shape[0] - 2, ideal.shape[1] - 2
    light = np.zeros(flat.shape[1], dtype=np.float32)
    offsets = (np.arange(sensor.supersampling) + 0.5) / sensor.supersampling - 0.5
    for step_x in offsets:
        for step_y in offsets:
            x, y, w = flat + step_x * right + step_y * down
            with np.errstate(divide="ignore", invalid="ignore"):
                x, y = np.floor(x / w), np.floor(y / w)
            board = (x >= -1) & (x < columns) & (y >= -1) & (y < rows) & (w > 0.0)
            paper = (x >= -2) & (x <= columns) & (y >= -2) & (y <= rows) & (w > 0.0)
            dark = board & ((x + y) % 2 == 0)
            light += np.where(dark, black, np.where(paper, white, sensor.background))
    made: SingleArray = (light.reshape(shape) / len(offsets) ** 2).astype(np.float32)
    if sensor.blur > 0.0:
        made = np.asarray(
            cv2.GaussianBlur(made, (0, 0), sensor.blur, borderType=cv2.BORDER_REPLICATE), dtype=np.float32
        )
    return sensor.expose(made[_PAD - 1 : 1 - _PAD, _PAD - 1 : 1 - _PAD], np.random.default_rng(seed))

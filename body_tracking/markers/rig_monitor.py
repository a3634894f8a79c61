"""Watches a calibrated rig: tells a camera that was turned from cameras that are out of step.

Both leave balls beside the epipolar lines of their other images. A turned camera shows a constant pattern over the
image, also for balls at rest; cameras out of step show distances that are proportional to the velocity in the image.
The signed epipolar distances of one second are explained by either, or by what the calibration leaves open (with its
covariance as a prior), in a robust fit that bears balls matched with the wrong partner.

Two cameras cannot tell which of them turned about the line that joins them: the finding names both then.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.markers.observations import ImageBalls
from body_tracking.markers.rays import Rays, TriangulationError, make_rays, rig_rays
from body_tracking.markers.rig import Rig

_SCALES: Final = (4.0, 2.0, 1.0, 0.5)
"""Pixels beyond which a distance is an outlier, from the first fit to the last."""
_CUT: Final = 9.0
"""Squared standard deviations at which the cost of an outlier ends."""


class Fault(Enum):
    """What is wrong with a rig."""

    MOVED_CAMERA = "moved camera"
    OUT_OF_STEP = "cameras out of step"


@dataclass(frozen=True, slots=True)
class MonitorSettings:
    """When a fault is told.

    Attributes:
        window: seconds of images that are looked at.
        reach: pixels from an epipolar line within which a lone ball is taken for the partner.
        noise: standard deviation of an epipolar distance that does not average out over balls, pixels.
        jitter: standard deviation of the cameras' capture times, seconds.
        min_distances: fewest distances in the window.
        min_turn: least turn that is told, radians.
        min_delay: least delay that is told, seconds.
        significance: standard deviations that a turn or delay must exceed.
        explained: least share of the cost of the distances that it must explain.
        ahead: share of the cost by which an explanation must be better than another.
    """

    window: float = 0.9
    reach: float = 12.0
    noise: float = 0.25
    jitter: float = 3e-4
    min_distances: int = 60
    min_turn: float = 1e-3
    min_delay: float = 4e-3
    significance: float = 6.0
    explained: float = 0.5
    ahead: float = 0.03


_DEFAULT: Final = MonitorSettings()


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault of a rig.

    Attributes:
        fault: its kind.
        cameras: frames of the camera whose fault it is, or of two between which the images do not decide. Of two
            cameras out of step it is the one that is late.
        amount: of the turn in radians, or of the delay in seconds.
        deviation: its standard deviation.
    """

    fault: Fault
    cameras: tuple[str, ...]
    amount: float
    deviation: float

    def __str__(self) -> str:
        size = f"{np.degrees(self.amount):.2f} deg" if self.fault is Fault.MOVED_CAMERA else f"{self.amount * 1e3:.1f} ms"
        return f"{self.fault.value}: {' or '.join(self.cameras)} by {size}"


@dataclass(frozen=True, slots=True, eq=False)
class _Distances:
    """Epipolar distances of one time: (n,) pixels, their variance, and derivatives by what may be wrong."""

    stamp_ns: int
    distance: FloatArray
    variance: FloatArray
    by_turn: FloatArray
    by_delay: FloatArray
    by_calibration: FloatArray


class RigMonitor:
    """Collects epipolar distances, and answers what is wrong."""

    def __init__(self, rig: Rig, settings: MonitorSettings = _DEFAULT) -> None:
        """Watch a rig of two cameras or more."""
        self._rig, self._settings = rig, settings
        self._geometry = rig_rays(rig)
        self._window: deque[_Distances] = deque()
        self._last: dict[str, ImageBalls] = {}

    def reset(self) -> None:
        """Forget all images."""
        self._window.clear()
        self._last.clear()

    def take(self, balls: Sequence[ImageBalls]) -> None:
        """Take the balls of one time; velocities come from the images before.

        Raises:
            TriangulationError: as :func:`body_tracking.markers.triangulation.triangulate`.
        """
        rays = make_rays(self._geometry, balls)
        velocities = np.full((len(rays.balls), 2), np.nan)
        for image in balls:
            index = self._geometry.index[image.camera]
            last = self._last.get(image.camera)
            if last is not None:
                velocities[rays.first[index] : rays.first[index + 1]] = _velocities(last, image)
            self._last[image.camera] = image
        pixels = np.concatenate([np.zeros((0, 2)), *(b.pixels for b in self._in_order(balls))])
        count = len(self._rig.cameras)
        for a in range(count):
            for b in range(a + 1, count):
                first, second = self._lone_pairs(rays, a, b)
                self.add(
                    balls[0].stamp_ns,
                    (a, b),
                    (pixels[first], pixels[second]),
                    (velocities[first], velocities[second]),
                )

    def add(
        self,
        stamp_ns: int,
        cameras: tuple[int, int],
        pixels: tuple[FloatArray, FloatArray],
        velocities: tuple[FloatArray, FloatArray],
    ) -> None:
        """Add corresponding balls of two cameras.

        Args:
            stamp_ns: capture time; one before the last forgets all images.
            cameras: their indices in the rig.
            pixels: (n, 2) in each.
            velocities: (n, 2) in each, pixels per second; rows with NaN are left out.
        """
        if self._window and stamp_ns < self._window[-1].stamp_ns:
            self._window.clear()
        known = np.isfinite(velocities[0]).all(axis=-1) & np.isfinite(velocities[1]).all(axis=-1)
        made = self._distances(
            stamp_ns, cameras, [each[known] for each in pixels], [each[known] for each in velocities]
        )
        self._window.append(made)
        while stamp_ns - self._window[0].stamp_ns > self._settings.window * NANOSECONDS:
            self._window.popleft()

    def finding(self) -> Finding | None:
        """What is wrong, or None: nothing, or nothing that is sure yet."""
        settings, count = self._settings, len(self._rig.cameras)
        distance = np.concatenate([np.zeros(0), *(each.distance for each in self._window)])
        if len(distance) < settings.min_distances:
            return None
        variance = np.concatenate([each.variance for each in self._window])
        by_turn = np.concatenate([each.by_turn for each in self._window])
        by_delay = np.concatenate([each.by_delay for each in self._window])
        by_calibration = np.concatenate([each.by_calibration for each in self._window])
        nothing, _, _ = _explain(distance, variance, by_calibration, np.zeros((len(distance), 0)))
        fits: list[tuple[float, Fault, str, float, float]] = []
        for camera in range(count):
            frame = self._rig.cameras[camera].frame_id
            cost, turn, covariance = _explain(
                distance, variance, by_calibration, by_turn[:, 3 * camera : 3 * camera + 3]
            )
            angle = float(np.linalg.norm(turn))
            deviation = float(np.sqrt(turn @ covariance @ turn) / max(angle, 1e-12))
            fits.append((cost, Fault.MOVED_CAMERA, frame, angle, deviation))
            cost, delay, covariance = _explain(
                distance, variance, by_calibration, by_delay[:, camera : camera + 1]
            )
            if delay[0] > 0.0 or count > 2:
                fits.append((cost, Fault.OUT_OF_STEP, frame, float(delay[0]), float(np.sqrt(covariance[0, 0]))))
        fits.sort(key=lambda fit: fit[0])
        best, fault, frame, amount, deviation = fits[0]
        gain = nothing - best
        least = settings.min_turn if fault is Fault.MOVED_CAMERA else settings.min_delay
        if gain < settings.explained * nothing or abs(amount) < max(least, settings.significance * deviation):
            return None
        margin = settings.ahead * gain
        rivals = [fit for fit in fits[1:] if fit[0] - best < margin]
        if any(rival[1] is not fault for rival in rivals):
            return None  # not sure yet
        return Finding(fault, (frame, *(rival[2] for rival in rivals)), amount, deviation)

    def _in_order(self, balls: Sequence[ImageBalls]) -> list[ImageBalls]:
        return sorted(balls, key=lambda image: self._geometry.index[image.camera])

    def _lone_pairs(self, rays: Rays, a: int, b: int) -> tuple[IntArray, IntArray]:
        """Balls of two cameras that are within reach of each other's epipolar lines, and of no others'."""
        geometry = self._geometry
        of_a, of_b = slice(rays.first[a], rays.first[a + 1]), slice(rays.first[b], rays.first[b + 1])
        cross = so3.skew(geometry.positions[b] - geometry.positions[a])
        by_b = -rays.directions[of_a] @ cross
        by_a = rays.directions[of_b] @ cross
        volume = by_b @ rays.directions[of_b].T
        # a pixel's width in image coordinates, without distortion: this is a coarse gate
        a_size = np.linalg.norm(by_a @ geometry.rotations[a, :2].T / geometry.focal[a], axis=-1)
        b_size = np.linalg.norm(by_b @ geometry.rotations[b, :2].T / geometry.focal[b], axis=-1)
        near: BoolArray = np.abs(volume) < self._settings.reach * np.hypot(a_size[None, :], b_size[:, None])
        near &= (near.sum(axis=0) == 1)[None, :] & (near.sum(axis=1) == 1)[:, None]
        first, second = np.nonzero(near)
        return first + of_a.start, second + of_b.start

    def _distances(
        self, stamp_ns: int, cameras: tuple[int, int], pixels: list[FloatArray], velocities: list[FloatArray]
    ) -> _Distances:
        geometry, settings, count = self._geometry, self._settings, len(self._rig.cameras)
        n = len(pixels[0])
        if n and pixels[0].shape != pixels[1].shape:
            raise TriangulationError(f"{pixels[0].shape} and {pixels[1].shape} corresponding pixels")
        rays = make_rays(
            geometry,
            [
                ImageBalls(
                    stamp_ns, self._rig.cameras[c].frame_id, p, np.zeros(n), np.broadcast_to(np.eye(2), (n, 2, 2))
                )
                for c, p in sorted(zip(cameras, pixels, strict=True))
            ],
        )
        order = (slice(0, n), slice(n, 2 * n)) if cameras[0] < cameras[1] else (slice(n, 2 * n), slice(0, n))
        baseline = geometry.positions[cameras[1]] - geometry.positions[cameras[0]]
        cross = so3.skew(baseline)
        first, second = rays.directions[order[0]], rays.directions[order[1]]
        by_direction = (second @ cross, -first @ cross)
        volume = (by_direction[1] * second).sum(axis=-1)
        by_turn, by_delay = np.zeros((n, 3 * count)), np.zeros((n, count))
        by_calibration = np.zeros((n, geometry.translation_factor.shape[2]))
        square, blur = np.zeros(n), np.zeros(n)
        for side, camera in enumerate(cameras):
            rotation = geometry.rotations[camera]
            flat = rays.flat[order[side]]
            inside = np.concatenate([flat, np.ones((n, 1))], axis=-1)
            in_camera = by_direction[side] @ rotation.T
            # a camera turned by w about itself sees a ball elsewhere: its pixel's ray is off by -w x ray, seen as +w
            by_turn[:, 3 * camera : 3 * camera + 3] = np.cross(inside, in_camera)
            by_pixel = (in_camera[:, None, :2] @ rays.spread[order[side]])[:, 0]
            square += (by_pixel**2).sum(axis=-1)
            moved = (by_pixel * velocities[side]).sum(axis=-1)
            by_delay[:, camera] = moved
            blur += moved**2
            by_calibration -= (in_camera[:, None, :2] @ rays.flat_factor[order[side]])[:, 0]
        shift = geometry.rotations[cameras[0]].T @ geometry.translation_factor[cameras[0]]
        shift = shift - geometry.rotations[cameras[1]].T @ geometry.translation_factor[cameras[1]]
        by_calibration += np.cross(first, second) @ shift
        scale = 1.0 / np.sqrt(square)
        good = np.isfinite(volume * scale)
        return _Distances(
            stamp_ns,
            (volume * scale)[good],
            (settings.noise**2 + settings.jitter**2 * blur * scale**2)[good],
            (by_turn * scale[:, None])[good],
            (by_delay * scale[:, None])[good],
            (by_calibration * scale[:, None])[good],
        )


def _velocities(last: ImageBalls, image: ImageBalls) -> FloatArray:
    """(n, 2) pixels per second of balls whose nearest ball in the image before has none nearer; NaN for others."""
    velocities = np.full((len(image.pixels), 2), np.nan)
    passed = (image.stamp_ns - last.stamp_ns) / NANOSECONDS
    if not len(last.pixels) or not len(image.pixels) or passed <= 0.0:
        return velocities
    apart = np.linalg.norm(image.pixels[:, None] - last.pixels[None], axis=-1)
    nearest, back = apart.argmin(axis=1), apart.argmin(axis=0)
    rows = np.arange(len(image.pixels))
    mutual = back[nearest] == rows
    velocities[mutual] = (image.pixels[mutual] - last.pixels[nearest[mutual]]) / passed
    return velocities


def _explain(
    distance: FloatArray, variance: FloatArray, by_calibration: FloatArray, by_cause: FloatArray
) -> tuple[float, FloatArray, FloatArray]:
    """Cost of the distances when a cause explains them beside the calibration; the cause, and its covariance.

    Iteratively reweighted least squares with the weights of Geman and McClure (1987), its scale from wide to narrow.
    """
    r, k = by_calibration.shape[1], by_cause.shape[1]
    derivative = np.concatenate([by_calibration, by_cause], axis=1)
    prior = np.diag(np.concatenate([np.ones(r), np.full(k, 1e-9)]))
    unknown, information = np.zeros(r + k), prior
    for scale in _SCALES:
        for _ in range(3):
            left = distance - derivative @ unknown
            # of balls that move fast, more is no outlier yet
            limit = scale**2 * variance / variance.min() + _CUT * variance
            weight = 1.0 / variance / (1.0 + left**2 / limit) ** 2
            weighted = derivative * weight[:, None]
            information = prior + weighted.T @ derivative
            unknown = np.linalg.solve(information, weighted.T @ distance)
    left = distance - derivative @ unknown
    cost = float(np.minimum(left**2 / variance, _CUT).sum() + unknown[:r] @ unknown[:r])
    return cost, unknown[r:], np.linalg.inv(information)[r:, r:]

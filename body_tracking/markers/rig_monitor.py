"""Monitors a calibrated rig: distinguishes a camera that was turned from unsynchronised cameras.

Both faults move balls off their epipolar lines. A turned camera shows a constant pattern over the image, also for balls
at rest; unsynchronised cameras show distances proportional to the velocity in the image. A robust fit, which tolerates
wrong correspondences, explains the signed epipolar distances of one second by either fault or by the calibration error
alone (with its covariance as a prior).

Two cameras cannot tell which of them turned about the line between them: then the finding names both.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Sequence
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
"""Pixels at which residuals are down-weighted as outliers, from the first fit to the last."""
_PLACE: Final = 5.0
"""Pixels of motion after which a ball's epipolar distance counts as independent."""
_RATE: Final = 60.0
"""Approximate frame rate, Hz."""
_INFORMATIVE: Final = 1e-2
"""Information of the distances about a calibration parameter, in units of its prior, below which it is not fitted."""
_CUT: Final = 9.0
"""Largest cost of a residual, squared standard deviations."""
_WINDOW: Final = 0.9
"""Seconds of images examined."""
_REACH: Final = 6.0
"""Largest distance from an epipolar line of a possible partner at rest, pixels."""
_MAX_DELAY: Final = 0.02
"""Longest delay searched for, seconds; widens the reach for moving balls."""
_PARTNERS: Final = 5
"""Largest number of balls within reach; a ball with more is ignored."""
_NOISE, _JITTER = 0.15, 3e-4
"""Standard deviations of an epipolar distance, pixels, and of the cameras' capture times, seconds."""
_MIN_SECONDS, _MIN_DISTANCES = 0.4, 60
"""Least time span of the window, and least number of distances in it, for a report."""
_MIN_TURN, _MIN_DELAY = 1e-3, 4e-3
"""Smallest turn, radians, and smallest delay, seconds, that are reported."""
_SIGNIFICANCE: Final = 7.0
"""Least ratio of a turn or delay to its standard deviation."""
_COMPLETE: Final = 0.7
"""Least share of the balls on a partner's epipolar line after the correction."""
_AHEAD: Final = 6.0
"""Least advantage in log likelihood over another cause."""


class Fault(Enum):
    """Kind of fault of a rig."""

    MOVED_CAMERA = "moved camera"
    OUT_OF_STEP = "cameras out of step"


@dataclass(frozen=True, slots=True)
class Finding:
    """A fault of a rig.

    Attributes:
        fault: its kind.
        cameras: frame of the faulty camera, or frames of two between which the images do not decide. Of two
            unsynchronised cameras, the late one.
        amount: turn in radians, or delay in seconds; with three or more cameras a negative delay means an early one.
        deviation: its standard deviation.
    """

    fault: Fault
    cameras: tuple[str, ...]
    amount: float
    deviation: float

    def __str__(self) -> str:
        size = (
            f"{np.degrees(self.amount):.2f} deg"
            if self.fault is Fault.MOVED_CAMERA
            else f"{abs(self.amount) * 1e3:.1f} ms"
        )
        text = f"{self.fault.value}: {' or '.join(self.cameras)} by {size}"
        # two views show only the relative rotation
        return f"{text} (which of them, the images cannot tell)" if len(self.cameras) > 1 else text


@dataclass(frozen=True, slots=True, eq=False)
class _Distances:
    """Epipolar distances at one time: (n,) pixels, variances, weights by independence, and derivatives.

    A ball has a distance for each partner within reach. ``balls``: number of balls in the camera that sees fewer.
    """

    stamp_ns: int
    distance: FloatArray
    variance: FloatArray
    share: FloatArray
    by_turn: FloatArray
    by_delay: FloatArray
    by_calibration: FloatArray
    balls: int


@dataclass(frozen=True, slots=True, eq=False)
class _Explanation:
    """A cause fitted to distances: cost, number of distances that become inliers, cause (k,), covariance (k, k)."""

    cost: float
    on_line: int
    cause: FloatArray
    covariance: FloatArray

    @property
    def size(self) -> float:
        """Angle of a turn, absolute value of a delay."""
        return float(np.linalg.norm(self.cause))

    @property
    def significance(self) -> float:
        """Mahalanobis norm of the cause, in standard deviations."""
        return float(np.sqrt(self.cause @ np.linalg.solve(self.covariance, self.cause)))

    @property
    def deviation(self) -> float:
        """Standard deviation of the size."""
        direction = self.cause / max(float(np.linalg.norm(self.cause)), 1e-12)
        return float(np.sqrt(direction @ self.covariance @ direction))


class RigMonitor:
    """Collects epipolar distances and diagnoses faults of the rig."""

    def __init__(self, rig: Rig) -> None:
        """Monitor a rig of two or more cameras."""
        self._rig = rig
        self._geometry = rig_rays(rig)
        self._window: deque[_Distances] = deque()
        self._last: dict[str, ImageBalls] = {}

    def reset(self) -> None:
        """Forget all images."""
        self._window.clear()
        self._last.clear()

    def take(self, balls: Sequence[ImageBalls]) -> None:
        """Add the balls of one time; velocities come from the previous images.

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
        in_order = sorted(balls, key=lambda image: self._geometry.index[image.camera])
        pixels = np.concatenate([np.zeros((0, 2)), *(image.pixels for image in in_order)])
        count = len(self._rig.cameras)
        for a in range(count):
            for b in range(a + 1, count):
                first, second = self._pairs_in_reach(rays, velocities, a, b)
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
            stamp_ns: capture time, nanoseconds; a time before the last one clears the window.
            cameras: their indices in the rig.
            pixels: (n, 2) in each.
            velocities: (n, 2) in each, pixels per second; rows with NaN are ignored.
        """
        if self._window and stamp_ns < self._window[-1].stamp_ns:
            self._window.clear()
        known = np.isfinite(velocities[0]).all(axis=-1) & np.isfinite(velocities[1]).all(axis=-1)
        made = self._distances(
            stamp_ns, cameras, [each[known] for each in pixels], [each[known] for each in velocities]
        )
        self._window.append(made)
        while stamp_ns - self._window[0].stamp_ns > _WINDOW * NANOSECONDS:
            self._window.popleft()

    def finding(self) -> Finding | None:
        """The fault of the rig; None if there is none or it is not certain yet."""
        search = self.search()
        while True:
            try:
                next(search)
            except StopIteration as end:
                found: Finding | None = end.value
                return found

    def search(self) -> Generator[None, None, Finding | None]:
        """:meth:`finding` as a generator: yields after steps of about 2 ms, so that images can be processed between."""
        count = len(self._rig.cameras)
        distance = np.concatenate([np.zeros(0), *(each.distance for each in self._window)])
        if len(distance) < _MIN_DISTANCES:
            return None
        passed = self._window[-1].stamp_ns - self._window[0].stamp_ns
        if passed < _MIN_SECONDS * NANOSECONDS:
            return None
        balls = sum(each.balls for each in self._window)
        variance = np.concatenate([each.variance for each in self._window])
        share = np.concatenate([each.share for each in self._window])
        by_turn = np.concatenate([each.by_turn for each in self._window])
        by_delay = np.concatenate([each.by_delay for each in self._window])
        by_calibration = _determined(np.concatenate([each.by_calibration for each in self._window]), variance)
        limits = _REACH / float(self._geometry.focal.mean()), _MAX_DELAY
        nothing = _explain(distance, variance, share, by_calibration, np.zeros((len(distance), 0)), 1.0)
        yield
        fits: list[tuple[float, Fault, str, _Explanation]] = []
        for camera in range(count):
            frame = self._rig.cameras[camera].frame_id
            turn = by_turn[:, 3 * camera : 3 * camera + 3]
            turn_fit = _explain(distance, variance, share, by_calibration, turn, limits[0])
            fits.append((turn_fit.cost, Fault.MOVED_CAMERA, frame, turn_fit))
            yield
            delay_fit = _explain(distance, variance, share, by_calibration, by_delay[:, camera : camera + 1], limits[1])
            if delay_fit.cause[0] > 0.0 or count > 2:  # of two cameras, a negative delay is the other's positive one
                fits.append((delay_fit.cost, Fault.OUT_OF_STEP, frame, delay_fit))
            yield
        fits.sort(key=lambda fit: fit[0])
        cost, fault, frame, best = fits[0]
        least = _MIN_TURN if fault is Fault.MOVED_CAMERA else _MIN_DELAY
        if best.on_line < _COMPLETE * balls or best.size < least:
            return None
        if nothing.cost - cost < _SIGNIFICANCE**2 or best.significance < _SIGNIFICANCE:
            return None
        rivals = [fit for fit in fits[1:] if fit[0] - cost < 2.0 * _AHEAD]
        if any(rival[1] is not fault for rival in rivals):
            return None  # not sure yet
        amount = best.size if fault is Fault.MOVED_CAMERA else float(best.cause[0])
        return Finding(fault, (frame, *(rival[2] for rival in rivals)), amount, best.deviation)

    def _pairs_in_reach(self, rays: Rays, velocities: FloatArray, a: int, b: int) -> tuple[IntArray, IntArray]:
        """Balls of two cameras within reach of each other's epipolar lines; balls with many partners are excluded."""
        geometry = self._geometry
        of_a, of_b = slice(rays.first[a], rays.first[a + 1]), slice(rays.first[b], rays.first[b + 1])
        cross = so3.skew(geometry.positions[b] - geometry.positions[a])
        by_b = -rays.directions[of_a] @ cross
        by_a = rays.directions[of_b] @ cross
        volume = by_b @ rays.directions[of_b].T
        # size of a pixel in image coordinates, ignoring distortion: the gate is coarse
        a_size = np.linalg.norm(by_a @ geometry.rotations[a, :2].T / geometry.focal[a], axis=-1)
        b_size = np.linalg.norm(by_b @ geometry.rotations[b, :2].T / geometry.focal[b], axis=-1)
        speed = np.nan_to_num(np.linalg.norm(velocities, axis=-1))
        reach = _REACH + _MAX_DELAY * np.maximum(speed[of_a, None], speed[None, of_b])
        near: BoolArray = np.abs(volume) < reach * np.hypot(a_size[None, :], b_size[:, None])
        near &= (near.sum(axis=0) <= _PARTNERS)[None, :] & (near.sum(axis=1) <= _PARTNERS)[:, None]
        first, second = np.nonzero(near)
        return first + of_a.start, second + of_b.start

    def _distances(
        self, stamp_ns: int, cameras: tuple[int, int], pixels: list[FloatArray], velocities: list[FloatArray]
    ) -> _Distances:
        geometry, count = self._geometry, len(self._rig.cameras)
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
            # turning the camera by w moves a ball's ray by -w x ray in its frame; the assumed ray is off by +w
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
        # a ball at rest adds no information: its centroid's bias and wrong partners stay
        speed = np.minimum(*(np.linalg.norm(each, axis=-1) for each in velocities))
        repeats = 1.0 + _RATE * np.minimum(_WINDOW, _PLACE / np.maximum(speed, 1e-3))
        return _Distances(
            stamp_ns,
            (volume * scale)[good],
            (_NOISE**2 + _JITTER**2 * blur * scale**2)[good],
            1.0 / repeats[good],
            (by_turn * scale[:, None])[good],
            (by_delay * scale[:, None])[good],
            (by_calibration * scale[:, None])[good],
            min((len(np.unique(each[:, 0])) for each in pixels), default=0),
        )


def _velocities(last: ImageBalls, image: ImageBalls) -> FloatArray:
    """(n, 2) pixels per second, from mutually nearest balls in consecutive images; NaN for others."""
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


def _determined(by_calibration: FloatArray, variance: FloatArray) -> FloatArray:
    """(n, s) derivative by the combinations of the calibration's unknowns (n, r) that the distances determine."""
    values, vectors = np.linalg.eigh(by_calibration.T @ (by_calibration / variance[:, None]))
    return np.asarray(by_calibration @ vectors[:, values > _INFORMATIVE])


def _explain(
    distance: FloatArray,
    variance: FloatArray,
    share: FloatArray,
    by_calibration: FloatArray,
    by_cause: FloatArray,
    limit: float,
) -> _Explanation:
    """Fit distances (n,) by a cause with derivative (n, k) and the calibration's unknowns (n, r).

    The cause has a Gaussian prior about zero with the standard deviation ``limit``.

    Iteratively reweighted least squares with the weights of Geman and McClure (1987), scale decreasing.
    """
    r, k = by_calibration.shape[1], by_cause.shape[1]
    derivative = np.concatenate([by_calibration, by_cause], axis=1)
    prior = np.diag(np.concatenate([np.ones(r), np.full(k, limit**-2)]))
    unknown, information = np.zeros(r + k), prior
    for scale in _SCALES:
        for _ in range(3):
            left = distance - derivative @ unknown
            # fast balls have larger variance, so their outlier limit is wider
            width = scale**2 * variance / variance.min() + _CUT * variance
            weight = share / variance / (1.0 + left**2 / width) ** 2
            weighted = derivative * weight[:, None]
            information = prior + weighted.T @ derivative
            unknown = np.linalg.solve(information, weighted.T @ distance)
    left = distance - derivative @ unknown
    cost = float(share @ np.minimum(left**2 / variance, _CUT) + unknown[:r] @ unknown[:r])
    on_line = int((left**2 < _CUT * variance).sum())
    return _Explanation(cost, on_line, unknown[r:], np.linalg.inv(information)[r:, r:])

"""Single frames of calibrated sensors in ``world`` and the reference's clock, for a filter that updates with each.

As in :mod:`body_tracking.fusion.fusion`, but frame by frame: poses and clocks come into force at their times, every
joint gets a covariance, and left and right are swapped where the other sensors show the body reversed. No frame waits,
and late frames are passed on.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from body_tracking.core.clocks import jumped_back
from body_tracking.core.measurement import back_view_factor, joint_variance, viewing_angle
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.sides import heading_weights, headings_of, reversed_halves, swap_left_right
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton
from body_tracking.fusion.placement import WORLD, PlacedSensors, Placement
from body_tracking.fusion.sides import Sides

FRESH = 0.1
"""Largest time to another sensor's frame that helps to decide left and right, seconds."""

_DIAGONAL = np.arange(3)
_KEEP = 5 * NANOSECONDS
"""Poses and clocks are kept for frames that are late by no more than this, nanoseconds."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frame:
    """A frame in world."""

    stamp_ns: int
    positions: FloatArray
    variance: FloatArray
    states: np.ndarray
    angle: float
    headings: list[float]
    weights: list[float]
    body: int


class _Sensor(Placement):
    """Pose, clock and newest frame of a sensor."""

    def clear(self) -> None:
        super().clear()
        self.last_ns: int | None = None  # in its own clock
        self.newest: _Frame | None = None


class SensorAlignment(PlacedSensors[_Sensor]):
    """Brings frames of calibrated sensors into one frame and one clock, one by one.

    Args:
        sensors: their names.
        reference: the sensor whose clock is that of ``world``; the first one when None.
        world: the frame of the output.

    Raises:
        FusionError: the reference is not among the sensors.
    """

    def __init__(self, sensors: Sequence[str], reference: str | None = None, world: str = WORLD) -> None:
        super().__init__(sensors, reference, _Sensor)
        self.world = world
        self._sides = Sides()

    def forget(self) -> None:
        """Forget all frames, because the next ones are of another person."""
        super().forget()
        self._sides.reset()

    def push(self, sensor: str, skeleton: Skeleton) -> Skeleton | None:
        """One frame of one sensor, in ``world``.

        Args:
            sensor: its name.
            skeleton: in the sensor's optical frame and clock.

        Returns:
            The same body at its capture time in the reference's clock, with isotropic covariances
            (:func:`~body_tracking.core.measurement.joint_variance`); joints that are not valid, and those of a body
            half whose axis is across the accepted one, are NaN and NOT_TRACKED. None while the sensor is not
            calibrated.
        """
        source = self._known(sensor)
        if source is None:
            return None
        if jumped_back(skeleton.stamp_ns, source.last_ns):
            self._clock_jumped_back(sensor)
        if source.last_ns is None or skeleton.stamp_ns > source.last_ns:
            source.last_ns = skeleton.stamp_ns
        else:
            self.counters["late"] += 1
        stamp = source.stamp(skeleton.stamp_ns)
        if stamp is None:
            self.counters["other_clock"] += 1
            return None
        pose = source.pose(stamp)
        if pose is None:
            self.counters["uncalibrated"] += 1
            return None
        if not self._in_step(sensor, stamp):
            self.counters["other_clock"] += 1
            return None
        source.forget_before(stamp - _KEEP)
        if skeleton.covariances is not None:  # not a Kinect, which states none
            self._sides.reliable.add(sensor)
        seen = _in_world(skeleton, stamp, pose)
        if source.newest is None or stamp > source.newest.stamp_ns:
            source.newest = seen
        self.counters["aligned"] += 1
        return self._corrected(sensor, seen)

    def _in_step(self, sensor: str, stamp_ns: int) -> bool:
        in_step = super()._in_step(sensor, stamp_ns)
        for other in self._sensors.values():
            if other.ahead:
                other.newest = None
        return in_step

    def _corrected(self, sensor: str, seen: _Frame) -> Skeleton:
        """The frame with left and right corrected by all sensors' frames near that time."""
        newest = {name: seen if name == sensor else source.newest for name, source in self._sensors.items()}
        fresh = {
            name: frame
            for name, frame in newest.items()
            if frame is not None and abs(seen.stamp_ns - frame.stamp_ns) <= FRESH * NANOSECONDS
        }
        frames = list(fresh.values())
        angles, headings = [frame.angle for frame in frames], [frame.headings for frame in frames]
        weights = [frame.weights for frame in frames]
        accepted = self._sides.accepted_headings(seen.stamp_ns, tuple(fresh), angles, headings, weights, self.counters)
        points, variance, states = seen.positions, seen.variance, seen.states
        if halves := reversed_halves(seen.headings, accepted):
            points, variance, states = points.copy(), variance.copy(), states.copy()
            swap_left_right(halves, points, variance, states, back_view_factor(seen.angle))
        known = np.isfinite(variance)
        self.counters["repaired"] += any(opposite for _, opposite in halves)
        if not all(opposite for _, opposite in halves):
            self.counters["turned_joints"] += int(np.count_nonzero(np.isfinite(seen.variance) & ~known))
        covariances = np.zeros((N_JOINTS, 3, 3))
        covariances[:, _DIAGONAL, _DIAGONAL] = variance[:, None]
        return Skeleton(
            seen.stamp_ns,
            self.world,
            np.where(known[:, None], points, np.nan),
            np.where(known, states, 0).astype(np.uint8),
            frames[0].body,
            covariances,
        )


def _in_world(skeleton: Skeleton, stamp_ns: int, pose: SensorPose) -> _Frame:
    known = skeleton.valid
    positions = np.where(known[:, None], skeleton.positions, np.nan)
    states = np.where(known, skeleton.states, 0)
    angle = viewing_angle(positions)
    variance = joint_variance(positions, states, skeleton.covariances, angle)
    placed = pose.apply(positions)
    headings, weights = headings_of(placed), heading_weights(placed, variance)
    return _Frame(stamp_ns, placed, variance, states, float(angle), headings, weights, skeleton.body)

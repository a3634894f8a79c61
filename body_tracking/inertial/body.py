"""The skeleton of a body whose segments carry inertial sensors, with covariances and tracking states.

Orientations alone do not place a body. Its base is at the camera's last measurement, with a variance that grows with
time, and the camera measures the segment lengths. Without a camera the body stands at the origin.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.inertial.posture import OrientationKinematics
from body_tracking.kinematics.lengths import SkeletonLengths
from body_tracking.kinematics.upper_body import PARENTS, UpperBody

_BASE_STDDEV, _BASE_UNKNOWN = 0.05, 1.0
"""Metres: standard deviation of the base where a camera measures it, and where it is unknown."""
_BASE_WALK = 0.3
"""Metres per root second: random walk of the base between the camera's measurements."""
_STANDING: Final = np.array([0.0, 0.0, 1.0])
_EYE3: Final = np.eye(3)
_SMALL: Final = 1e-4 * _EYE3
_LITTLE_MOVED: Final = ("lower_trunk", "clavicle_left", "clavicle_right")
_TRUNK: Final = ("pelvis", "upper_trunk")


class WornBody:
    """Makes skeletons from the orientations of segments.

    Args:
        model: of the body.
        stature: metres; used until a camera has measured the segments.
        world: name of the frame of the skeletons.
    """

    def __init__(self, model: UpperBody, stature: float, world: str) -> None:
        self._model, self._stature, self._world = model, stature, world
        self._kinematics: dict[tuple[str, ...], tuple[OrientationKinematics, BoolArray]] = {}
        self._base: tuple[int, FloatArray] | None = None
        self._lengths = SkeletonLengths()
        self._posture: FloatArray | None = None

    def take_skeleton(self, skeleton: Skeleton) -> None:
        """Take the position of the base and the segment lengths from a camera's skeleton in ``world``."""
        if skeleton.valid[Joint.SPINE_BASE]:
            self._base = skeleton.stamp_ns, skeleton.positions[Joint.SPINE_BASE]
        known = skeleton.valid[self._model.joints]
        points = np.where(known[:, None], skeleton.positions[self._model.joints], np.nan)
        variance = np.where(known, joint_variances(skeleton)[self._model.joints], np.inf)
        self._lengths.update(skeleton.stamp_ns, points, variance)

    def skeleton(
        self, stamp_ns: int, segments: Sequence[str], rotations: FloatArray, covariances: FloatArray
    ) -> Skeleton:
        """The skeleton of the body model that best fits the orientations.

        Args:
            stamp_ns: nanoseconds.
            segments: k names, of those that carry a sensor.
            rotations: (k, 3, 3) segments to world.
            covariances: (k, 3, 3) radians squared, in the segments' own frames.

        Returns:
            Points whose position relative to the trunk the sensors determine are TRACKED, the others INFERRED, each
            with its covariance. Points that the model does not have are NOT_TRACKED.
        """
        names = tuple(segments)
        if names not in self._kinematics:
            self._kinematics[names] = OrientationKinematics(self._model, names), _placed_by(self._model, names)
        kinematics, placed = self._kinematics[names]
        self._posture, covariance = kinematics.solve(rotations, covariances, self._posture)
        return self._points(stamp_ns, placed, self._posture.copy(), covariance)

    def _points(self, stamp_ns: int, placed: BoolArray, q: FloatArray, covariance: FloatArray) -> Skeleton:
        model = self._model
        base, variance = _STANDING, _BASE_UNKNOWN**2
        if self._base is not None:
            base = self._base[1]
            unseen = abs(stamp_ns - self._base[0]) / NANOSECONDS
            variance = min(_BASE_STDDEV**2 + _BASE_WALK**2 * unseen, _BASE_UNKNOWN**2)
        q[:3] = base
        lengths = self._lengths.lengths if self._base is not None else model.default_lengths(self._stature)
        lines = model.linearise(q, lengths)
        spread = covariance.copy()
        spread[:3] = spread[:, :3] = 0.0
        own = lines.jacobian @ spread @ lines.jacobian.swapaxes(-1, -2) + variance * _EYE3 + _SMALL
        positions = np.full((N_JOINTS, 3), np.nan)
        covariances = np.tile(np.diag([np.inf] * 3), (N_JOINTS, 1, 1))
        states = np.zeros(N_JOINTS, dtype=np.uint8)
        positions[model.joints], covariances[model.joints] = lines.posture.positions, own
        states[model.joints] = np.where(placed, TrackingState.TRACKED, TrackingState.INFERRED)
        return Skeleton(stamp_ns, self._world, positions, states, 0, covariances)


def joint_variances(skeleton: Skeleton) -> FloatArray:
    """(25,) variances of a camera's joints, square metres per axis."""
    if skeleton.covariances is None:
        return BASE_STDDEV**2
    traces: FloatArray = np.trace(skeleton.covariances, axis1=1, axis2=2) / 3.0
    return np.where(np.isfinite(traces), traces, 1.0)


def _placed_by(model: UpperBody, sensed: Sequence[str]) -> BoolArray:
    """(19,) points whose position relative to the trunk the sensors determine: every segment from there on has one.

    Lower trunk and clavicles, which move little, need no sensor, and one end of the trunk is enough.
    """
    trunk = any(name in sensed for name in _TRUNK)
    determined = np.zeros(len(model.segment_names), dtype=np.bool_)
    for number, name in enumerate(model.segment_names):
        above = PARENTS[number] < 0 or determined[PARENTS[number]]
        determined[number] = above and (name in sensed or name in _LITTLE_MOVED or (trunk and name in _TRUNK))
    return determined[model.point_segments]

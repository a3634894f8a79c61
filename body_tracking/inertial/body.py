"""The skeleton of a body whose segments carry inertial sensors: where its points are, how sure, and which are told.

Orientations alone do not place a body: its base is where a camera last saw it, less surely with every second since,
and its segments are as long as the camera has measured them; without one it stands at the origin.
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
"""Metres: of the base where a camera sees it, and where nobody knows."""
_BASE_WALK = 0.3
"""Metres per root second that the base is known less well when the camera does not see it."""
_STANDING: Final = np.array([0.0, 0.0, 1.0])
_EYE3: Final = np.eye(3)
_SMALL: Final = 1e-4 * _EYE3
_CARRIERS: Final = {
    "SPINE_BASE": "pelvis",
    "HIP": "pelvis",
    "SPINE_MID": "lower_trunk",
    "SPINE_SHOULDER": "upper_trunk",
    "NECK": "upper_trunk",
    "HEAD": "head",
    "SHOULDER": "clavicle",
    "ELBOW": "upper_arm",
    "WRIST": "forearm",
    "HAND": "hand",
    "HAND_TIP": "hand",
    "THUMB": "hand",
}
"""Of each kind of joint the segment that it is a point of."""
_LITTLE_MOVED: Final = ("lower_trunk", "clavicle_left", "clavicle_right")
_TRUNK: Final = ("pelvis", "upper_trunk")


class WornBody:
    """Makes skeletons of segments' orientations.

    Args:
        model: of the body.
        stature: metres, of the person, until a camera has measured the segments.
        world: name of the frame of the skeletons.
    """

    def __init__(self, model: UpperBody, stature: float, world: str) -> None:
        self._model, self._stature, self._world = model, stature, world
        self._kinematics: dict[tuple[str, ...], tuple[OrientationKinematics, BoolArray]] = {}
        self._base: tuple[int, FloatArray] | None = None
        self._lengths = SkeletonLengths()
        self._posture: FloatArray | None = None

    def see(self, skeleton: Skeleton) -> None:
        """Take where the base is, and how long segments are, from a camera's skeleton in ``world``."""
        if skeleton.valid[Joint.SPINE_BASE]:
            self._base = skeleton.stamp_ns, skeleton.positions[Joint.SPINE_BASE]
        known = skeleton.valid[self._model.joints]
        points = np.where(known[:, None], skeleton.positions[self._model.joints], np.nan)
        variance = np.where(known, joint_variances(skeleton)[self._model.joints], np.inf)
        self._lengths.update(skeleton.stamp_ns, points, variance)

    def skeleton(
        self, stamp_ns: int, segments: Sequence[str], rotations: FloatArray, covariances: FloatArray
    ) -> Skeleton:
        """The body that fits orientations.

        Args:
            stamp_ns: nanoseconds.
            segments: k names, of those that carry a sensor.
            rotations: (k, 3, 3) segments to world.
            covariances: (k, 3, 3) radians squared, in the segments' own frames.

        Returns:
            Tracked are the points whose place against the trunk sensors tell; the others are inferred. Each with its
            covariance; points that the model does not have are unknown.

        Raises:
            AlignmentError: as of :meth:`OrientationKinematics.solve`.
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
    """(25,) square metres per axis, of a camera's joints."""
    if skeleton.covariances is None:
        return BASE_STDDEV**2
    traces: FloatArray = np.trace(skeleton.covariances, axis1=1, axis2=2) / 3.0
    return np.where(np.isfinite(traces), traces, 1.0)


def _placed_by(model: UpperBody, sensed: Sequence[str]) -> BoolArray:
    """(19,) points whose place against the trunk sensors tell: every segment from there on carries one.

    None is asked for on the spine and on the girdle, which move little, nor on more than one end of the trunk.
    """
    trunk = any(name in sensed for name in _TRUNK)
    sure: dict[str, bool] = {}
    for number, name in enumerate(model.segment_names):
        above = PARENTS[number] < 0 or sure[model.segment_names[PARENTS[number]]]
        sure[name] = above and (name in sensed or name in _LITTLE_MOVED or (trunk and name in _TRUNK))
    carriers = []
    for joint in model.joints.tolist():
        kind, _, side = Joint(joint).name.rpartition("_")
        if side in ("LEFT", "RIGHT"):
            carrier = _CARRIERS[kind]
            carriers.append(carrier if carrier == "pelvis" else f"{carrier}_{side.lower()}")
        else:
            carriers.append(_CARRIERS[Joint(joint).name])
    return np.array([sure[carrier] for carrier in carriers])

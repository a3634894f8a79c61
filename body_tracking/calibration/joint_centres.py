"""Systematic offsets between a sensor's joints and the anatomical ones, estimated while the person holds a T-pose.

A skeleton camera places joints some centimetres off the anatomical ones, nearly constant in the body's axes: a real
Kinect v2 against Vicon (UI-PRMD, five clips of a stretched right arm) has the elbow straighter by 13 to 15 degrees in
four of them, +- 4 between hanging and level. Two such sensors have the same error, so that fusion does not remove it. A
known pose does: in a T-pose upper arms and forearms point sideways, perpendicular to the thorax, and left and right are
symmetric, up to the person's own deviation from it.

With measured joints ``m = p + b + e`` in the axes of the measured thorax, ``p`` the anatomical ones, ``b ~ N(0, P)``
the constant offsets and ``e ~ N(0, T)`` the transient error, and a pose with ``H p = c + w``, ``w ~ N(0, R)``, in the
body's own axes, which are rotated by some small ``a ~ N(0, A)`` against those, so that ``H (p + a x p) = c + w``, the
offsets are (``G a = -H (a x m)``)

    r = H m - c,  N = H T H^T + G A G^T + R,  S = H D H^T + N,  K = D H^T S^-1                                     (1)
    b = K r,  Cov(b) = (I - K H) P (I - K H)^T + K N K^T                                                           (2)

``D`` is the diagonal of ``P``. Neighbouring joints' offsets are correlated (``core.measurement.offset_correlation``).
The covariance (2) accounts for that; the gain does not: with ``P`` in place of ``D`` elbows err by 7.8 instead of 7.2
degrees (16 simulated people), and are covered in 93 instead of 96 % of the frames.

Only combinations that the pose determines become observable; the place of the whole arm does not. For a T-pose,
``r^T S^-1 r`` is chi-square with as many degrees of freedom as (1) has rows.

From then on the offsets are subtracted, each in the frame of the segment that ends in the joint (these turn as in
:mod:`body_tracking.evaluation.segments`), in part: the joints do not show how a bone is rotated about itself, so the
farther it points from its direction in the T-pose, the less is known of its offset,

    b' = d b + sqrt(1 - d^2) n,  n ~ N(0, P),  d = E[cos(roll)] = exp(-sigma^2 / 2)                                (3)

and from the elbow on ``d`` is multiplied, with the elbow bent by ``beta``, by

    1 - (1 - cos(beta))^2  up to a right angle, 0 beyond                                                           (4)

because the error differs at a bent elbow: in the same person the same Kinect overstates 67 degrees of flexion by 7
degrees, but understates that of the stretched arm by 13.

Over 500 lines: one estimator with its derivation; its steps share their notation.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from body_tracking.calibration.still_pose import is_t_pose
from body_tracking.core.chi_square import gate
from body_tracking.core.measurement import BASE_STDDEV, offset_correlation
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, BoolArray, FloatArray, IntArray, Joint, Skeleton

_J = Joint
_TRUNK = (_J.SPINE_BASE, _J.SPINE_MID, _J.SPINE_SHOULDER)
_LEFT = (_J.SHOULDER_LEFT, _J.ELBOW_LEFT, _J.WRIST_LEFT, _J.HAND_LEFT)
_RIGHT = (_J.SHOULDER_RIGHT, _J.ELBOW_RIGHT, _J.WRIST_RIGHT, _J.HAND_RIGHT)
_ARMS: Final[IntArray] = np.array([_LEFT, _RIGHT], dtype=np.intp)
LEARNT: Final[IntArray] = np.array([*_TRUNK, *_LEFT, *_RIGHT], dtype=np.intp)
"""(11,) joints whose offsets are learnt."""
_PLACE = {Joint(joint): place for place, joint in enumerate(LEARNT)}
_NEEDED = np.array([_PLACE[joint] for joint in (*_TRUNK[2:], *_LEFT[:3], *_RIGHT[:3])], dtype=np.intp)
_FOLLOWERS = {
    _J.SPINE_BASE: (_J.HIP_LEFT, _J.HIP_RIGHT),
    _J.SPINE_SHOULDER: (_J.NECK, _J.HEAD),
    _J.HAND_LEFT: (_J.HAND_TIP_LEFT, _J.THUMB_LEFT),
    _J.HAND_RIGHT: (_J.HAND_TIP_RIGHT, _J.THUMB_RIGHT),
}
"""Joints that get the offset of another one, by the latter."""
_MOVED = np.array([*LEARNT, *(each for joint in _FOLLOWERS for each in _FOLLOWERS[joint])], dtype=np.intp)
_MOVED_AS = np.array(
    [*range(len(LEARNT)), *(_PLACE[joint] for joint in _FOLLOWERS for _ in _FOLLOWERS[joint])], dtype=np.intp
)
_CHAINS = len(_TRUNK) + np.arange(8).reshape(2, 4)
"""(2, 4) indices of shoulder, elbow, wrist and hand in ``LEARNT``."""
_THORAX = np.array([_J.SPINE_SHOULDER, _J.SPINE_MID, _J.SHOULDER_LEFT, _J.SHOULDER_RIGHT], dtype=np.intp)
_THIRD = math.sqrt(1.0 / 3.0)
_MIN_LENGTH = 1e-6
"""Metres: least length of a bone with a direction."""

HOLD = 0.7
"""Seconds for which a pose has to be held."""
_MIN_FRAMES = 5
"""Least number of frames of a held pose."""
_MAX_MOTION = 0.025
"""Metres (root mean square): largest motion of elbows and wrists against the shoulders in a held pose."""
_CHECK_NS, _CHECK_AGAIN_NS = NANOSECONDS // 5, 2 * NANOSECONDS
"""Time to the next check of a sensor's frames for a T-pose: without one, and after one that was used."""
_BREAK_NS, _LATE_NS = NANOSECONDS // 3, NANOSECONDS // 2
"""Longest interval between frames of one pose; delay of a stamp from which it is a backward jump of time."""
_ANOTHER_NS = 2 * _CHECK_AGAIN_NS
"""Interval from which held poses count as two."""
_FADE_IN = 0.3
"""Seconds: time constant with which new offsets come into force, so that the output does not jump."""
_GATE_QUANTILE = 0.999
"""Quantile of chi-square of the gate."""
POSE_STDDEV = math.radians(6.0)
"""Radians: standard deviation of a person's T-pose, per axis of a joint."""
_STRAIGHT_ELBOW = math.radians(4.0)
"""Radians: mean and standard deviation of the forward flexion of elbows in a T-pose with palms down. The limit of
extension is 0.6 +- 3.1 degrees (Boone and Azen 1979)."""
_SYMMETRY_STDDEV = 0.01
"""Metres: standard deviation of the difference between left and right of bones and of their joints."""
_ROLL_STDDEV = math.radians(40.0)
"""Radians: standard deviation of a bone's rotation about itself at 90 degrees or more from its direction in the T-pose:
of a uniform distribution over the +-70 degrees that a shoulder allows."""
_TRANSIENT_SHARE = 0.3
"""Share of a joint's stated variance that is transient (``slow_scale`` of the extended filter)."""
_ARM_CORRELATION = 0.8
"""Correlation of the transient errors between the joints of an arm. With these two an arm's elevation varies by 6
degrees and the elbow's flexion by 5; the errors of that real Kinect vary by 3 to 8 and by 3 to 6.5 about their means in
each of six clips."""
_AXES_STDDEV = 0.3
"""Radians: standard deviation of the measured thorax's axes against the body's, an upper bound."""
_UNSEEN = 1.0
"""Square metres: variance of a joint that is not seen."""

_SPINE_UNSEEN = (0.0, 0.0, -0.3)
"""Metres from SpineShoulder, forward, left and up: where an unseen joint counts as seen with ``_UNSEEN``."""

_PRIOR: FloatArray = np.kron(offset_correlation() * BASE_STDDEV * BASE_STDDEV[:, None], np.eye(3)).astype(np.float64)
"""(75, 75) square metres: covariance of the offsets of all joints before a T-pose."""
_ROWS = (3 * LEARNT[:, None] + np.arange(3)).reshape(-1)
_FRAMES = np.full(N_JOINTS, _PLACE[_J.SPINE_BASE])
"""(25,) place in ``LEARNT`` of the joint whose segment's frame a joint's offset is in."""
_FRAMES[_MOVED] = _MOVED_AS
_CORRELATION = np.eye(len(LEARNT))
for _arm in _CHAINS:
    _CORRELATION[np.ix_(_arm, _arm)] += _ARM_CORRELATION * (1.0 - np.eye(len(_arm)))


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Offsets estimated from a T-pose.

    Attributes:
        local: (11, 3) metres from the anatomical to the measured joints, in the frames of the segments.
        covariance: (75, 75) of the offsets of all joints.
        distance: ``r^T S^-1 r``.
        dimension: its expectation for a T-pose.
    """

    local: FloatArray
    covariance: FloatArray
    distance: float
    dimension: int


_Vector = tuple[float, float, float]


def trunk_axes(
    top: Sequence[float], middle: Sequence[float], left: Sequence[float], right: Sequence[float]
) -> tuple[_Vector, _Vector, _Vector]:
    """Unit vectors of a part of the trunk; in scalars, because it runs for each frame of each camera.

    Args:
        top: (3,) of the thorax SpineShoulder, of the pelvis SpineMid.
        middle: (3,) SpineMid, or SpineBase.
        left: (3,) the left shoulder, or hip.
        right: (3,) the right one.

    Returns:
        Forward, left and up; NaN where a joint is unknown or two are in one place.
    """
    ux, uy, uz = _unit(top[0] - middle[0], top[1] - middle[1], top[2] - middle[2])
    ax, ay, az = left[0] - right[0], left[1] - right[1], left[2] - right[2]
    along = ax * ux + ay * uy + az * uz
    lx, ly, lz = _unit(ax - along * ux, ay - along * uy, az - along * uz)
    return (ly * uz - lz * uy, lz * ux - lx * uz, lx * uy - ly * ux), (lx, ly, lz), (ux, uy, uz)


def _unit(x: float, y: float, z: float) -> _Vector:
    length = math.sqrt(x * x + y * y + z * z)
    if not length > _MIN_LENGTH:
        return math.nan, math.nan, math.nan
    return x / length, y / length, z / length


def thorax_axes(
    top: Sequence[float], middle: Sequence[float], left: Sequence[float], right: Sequence[float]
) -> tuple[_Vector, _Vector, _Vector]:
    """:func:`trunk_axes` of the thorax, in a frame with z up; it counts as upright where SpineMid is unknown."""
    if math.isnan(middle[2]):
        middle = top[0], top[1], top[2] - 1.0
    return trunk_axes(top, middle, left, right)


def body_axes(positions: FloatArray) -> FloatArray:
    """(3, 3) rotation from forward, left and up of the thorax to the axes of (25, 3) positions; NaN where unknown.

    Without SpineMid the positions' z has to be up: see :func:`thorax_axes`.
    """
    return np.array(thorax_axes(*positions.take(_THORAX, axis=0).tolist())).T


def posed(positions: FloatArray, local: FloatArray) -> FloatArray:
    """Rotate vectors from the frames of the segments into the axes of the positions.

    In scalars, because it runs for each frame of each camera and is three times as fast as with such small arrays.

    Args:
        positions: (25, 3) metres, any frame (z up without SpineMid), NaN where unknown.
        local: (11, k, 3) vectors in the frame of the segment that ends in each of the joints ``LEARNT``.

    Returns:
        (11, k, 3) vectors in the axes of the positions; NaN without shoulders. An unknown bone is replaced by
        the one before it.
    """
    points = positions.take(LEARNT, axis=0).tolist()
    _, middle, top, *arms = points
    (fx, fy, fz), (lx, ly, lz), (ux, uy, uz) = thorax_axes(top, middle, arms[0], arms[4])
    result = [
        [(fx * x + lx * y + ux * z, fy * x + ly * y + uy * z, fz * x + lz * y + uz * z) for x, y, z in own]
        for own in local.tolist()
    ]
    for first, side in ((len(_TRUNK), _THIRD), (len(_TRUNK) + 4, -_THIRD)):
        # from a direction whose opposite no arm reaches: forward, to the arm's side, and down
        sx, sy, sz = (fx - ux) * _THIRD + lx * side, (fy - uy) * _THIRD + ly * side, (fz - uz) * _THIRD + lz * side
        for bone in range(first, first + 3):
            px, py, pz = points[bone]
            qx, qy, qz = points[bone + 1]
            ex, ey, ez = _unit(qx - px, qy - py, qz - pz)
            if ex != ex:  # unknown
                continue
            # the smallest rotation that brings one unit vector s along another one e, as two reflections:
            # v - (s + e) ((s + e) . v) / (1 + s . e) + 2 e (s . v)
            hx, hy, hz = sx + ex, sy + ey, sz + ez
            scale = 1.0 / max(1.0 + sx * ex + sy * ey + sz * ez, 1e-9)
            for joint in range(bone + 1, first + 4):
                own = result[joint]
                for number, (x, y, z) in enumerate(own):
                    a, b = (hx * x + hy * y + hz * z) * scale, 2.0 * (sx * x + sy * y + sz * z)
                    own[number] = x - hx * a + ex * b, y - hy * a + ey * b, z - hz * a + ez * b
            sx, sy, sz = ex, ey, ez
    return np.array(result)


def retained(positions: FloatArray) -> FloatArray:
    """(11,) ``d`` of eq. (3) and (4): 1 for the trunk and for bones that point as in a T-pose.

    Args:
        positions: (25, 3) metres, any frame (z up without SpineMid), NaN where unknown. An unknown bone is replaced by
            the one before it.
    """
    points = positions.take(LEARNT, axis=0).tolist()
    _, (lx, ly, lz), _ = thorax_axes(points[2], points[1], points[3], points[7])
    result = [1.0] * len(points)
    for first, side in ((len(_TRUNK), 1.0), (len(_TRUNK) + 4, -1.0)):
        ux, uy, uz = math.nan, math.nan, math.nan
        stretched = 1.0  # eq. (4)
        for bone in range(first, first + 3):
            (px, py, pz), (qx, qy, qz) = points[bone], points[bone + 1]
            ex, ey, ez = _unit(qx - px, qy - py, qz - pz)
            away = 1.0 - side * (ex * lx + ey * ly + ez * lz)
            known = away == away
            result[bone + 1] = math.exp(-0.5 * _ROLL_STDDEV**2 * min(1.0, away)) if known else result[bone]
            if bone == first:
                ux, uy, uz = ex, ey, ez
            elif bone == first + 1:
                straight = ux * ex + uy * ey + uz * ez
                stretched = 1.0 if straight != straight else 1.0 - (1.0 - max(0.0, straight)) ** 2
        for joint in range(first + 1, first + 4):
            result[joint] *= stretched
    return np.array(result)


def t_pose_offsets(positions: FloatArray, transient: FloatArray) -> Offsets:
    """The offsets of joints by a measured T-pose (eq. 1-2).

    Args:
        positions: (25, 3) metres, forward, left and up in the axes of the thorax; any value where unknown.
        transient: (11,) square metres per axis: variance of the transient error of the joints ``LEARNT``.
    """
    points = positions[LEARNT]
    rows, wanted, stddev = _t_pose(points)  # H, c, square root of R
    prior = np.repeat(BASE_STDDEV[LEARNT] ** 2, 3)
    residual = rows @ points.reshape(-1) - wanted
    passing = np.kron(_CORRELATION * np.sqrt(np.outer(transient, transient)), np.eye(3))
    # h . (a x m) = a . (m x h), summed over the joints
    turning = np.cross(points, rows.reshape(len(rows), -1, 3)).sum(axis=1)
    axes = _AXES_STDDEV**2 * turning @ turning.T
    noise = rows @ passing @ rows.T + axes + np.diag(stddev**2)
    innovation = (rows * prior) @ rows.T + noise
    gain = np.linalg.solve(innovation, rows * prior).T  # K
    offsets = (gain @ residual).reshape(-1, 3)
    of_all = np.zeros((N_JOINTS, 3, len(rows)))
    of_all[_MOVED] = gain.reshape(len(LEARNT), 3, -1)[_MOVED_AS]
    gains = of_all.reshape(3 * N_JOINTS, -1)
    kept = np.eye(3 * N_JOINTS)
    kept[:, _ROWS] -= gains @ rows
    covariance = kept @ _PRIOR @ kept.T + gains @ noise @ gains.T
    # from the axes of the thorax into those of the segments
    frames = posed(positions, np.broadcast_to(np.eye(3), (len(LEARNT), 3, 3)).copy())  # rows: the frames' axes
    local = np.einsum("jab,jb->ja", frames, offsets)
    distance = float(residual @ np.linalg.solve(innovation, residual))
    return Offsets(local, _rotated(covariance, frames[_FRAMES]), distance, len(rows))


def _rotated(covariance: FloatArray, rotations: FloatArray) -> FloatArray:
    """(75, 75) covariance of the joints after a rotation of each, (25, 3, 3)."""
    blocks = np.zeros((N_JOINTS, 3, N_JOINTS, 3))
    each = np.arange(N_JOINTS)
    blocks[each, :, each] = rotations
    whole = blocks.reshape(covariance.shape)  # einsum with three factors takes seven times as long
    return whole @ covariance @ whole.T


def _t_pose(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The constraints of a T-pose on (11, 3) points: rows H (n, 33), c and sqrt(R) (n,)."""
    rows: list[FloatArray] = []
    values: list[float] = []
    stddev: list[float] = []
    forward, left, up = range(3)

    def add_row(axis: int, value: float, deviation: float, *terms: tuple[Joint, float]) -> None:
        row = np.zeros(points.shape)
        for joint, factor in terms:
            row[_PLACE[joint], axis] += factor
        rows.append(row)
        values.append(value)
        stddev.append(deviation)

    def length(start: Joint, end: Joint) -> float:
        return float(np.linalg.norm(points[_PLACE[end]] - points[_PLACE[start]]))

    base, middle, top = _TRUNK
    width = length(_LEFT[0], _RIGHT[0])
    for arm, other in ((_LEFT, _RIGHT), (_RIGHT, _LEFT)):
        shoulder, elbow, wrist, hand = arm
        upper, fore, palm = length(shoulder, elbow), length(elbow, wrist), length(wrist, hand)
        # plane of elevation: the upper arm continues the line of the shoulders
        ratio = upper / width
        terms = (elbow, 1.0), (shoulder, -1.0 - ratio), (other[0], ratio)
        add_row(forward, 0.0, upper * POSE_STDDEV, *terms)
        # elevation: perpendicular to the thorax
        add_row(up, 0.0, upper * POSE_STDDEV, (elbow, 1.0), (shoulder, -1.0))
        for axis, bend, deviation in ((forward, _STRAIGHT_ELBOW, _STRAIGHT_ELBOW), (up, 0.0, POSE_STDDEV)):
            ratio = fore / upper
            terms = (wrist, 1.0), (elbow, -1.0 - ratio), (shoulder, ratio)
            add_row(axis, fore * bend, fore * deviation, *terms)
            ratio = palm / fore
            add_row(axis, 0.0, 2.0 * palm * POSE_STDDEV, (hand, 1.0), (wrist, -1.0 - ratio), (elbow, ratio))
    for start, end in zip(range(3), range(1, 4), strict=True):
        terms_of_both = ((arm[end], 1.0) for arm in (_LEFT, _RIGHT)), ((arm[start], -1.0) for arm in (_LEFT, _RIGHT))
        add_row(left, 0.0, _SYMMETRY_STDDEV, *terms_of_both[0], *terms_of_both[1])
    shoulders = _LEFT[0], _RIGHT[0]
    for axis in (forward, up):
        add_row(axis, 0.0, _SYMMETRY_STDDEV, (shoulders[0], 1.0), (shoulders[1], -1.0))
    for joint in (base, middle, top):
        add_row(left, 0.0, _SYMMETRY_STDDEV, (shoulders[0], 0.5), (shoulders[1], 0.5), (joint, -1.0))
    return np.array(rows).reshape(len(rows), -1), np.array(values), np.array(stddev)


_LONG_AGO_NS = -(2**62)


@dataclass(slots=True, eq=False)
class _Evidence:
    """One sensor's frames of the person's T-poses; arrays are immutable."""

    recent: deque[Skeleton] = field(default_factory=deque)
    check_ns: int = _LONG_AGO_NS
    taken_ns: int = _LONG_AGO_NS
    sum: FloatArray = field(default_factory=lambda: np.zeros((len(LEARNT), 3)))
    counts: FloatArray = field(default_factory=lambda: np.zeros(len(LEARNT)))
    variance: FloatArray = field(default_factory=lambda: np.zeros(len(LEARNT)))


class JointCentres:
    """Estimates the offsets of one person's joints, and subtracts them.

    Only skeletons with covariances are used.

    Args:
        counters: counts ``t_poses`` that were used, ``t_poses_refused``, which failed the gate, and
            ``t_poses_forgotten``, people with an estimate who were forgotten.

    Attributes:
        offsets: the estimate; None before the first T-pose.
    """

    def __init__(self, counters: dict[str, int]) -> None:
        self._counters = counters
        counters |= {"t_poses": 0, "t_poses_refused": 0, "t_poses_forgotten": 0}
        self._gates: dict[int, float] = {}
        self.offsets: Offsets | None = None
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._counters["t_poses_forgotten"] += self.offsets is not None
        self._sensors: dict[str, _Evidence] = {}
        self.offsets = None
        self._before: FloatArray = np.zeros((len(LEARNT), 3))
        self._since_ns = self._first_ns = 0
        self._held_ns = self._refused_ns = _LONG_AGO_NS

    def update(self, skeleton: Skeleton, sensor: str = "") -> bool:
        """Check a frame for a T-pose, and update the offsets with it.

        Args:
            skeleton: in a fixed frame, left and right not swapped.
            sensor: name of its sensor.

        Returns:
            Whether there is an estimate for the first time.
        """
        if skeleton.covariances is None:
            return False
        seen = self._sensors.setdefault(sensor, _Evidence())
        recent, stamp_ns = seen.recent, skeleton.stamp_ns
        after_ns = stamp_ns - recent[-1].stamp_ns if recent else 1
        if -_LATE_NS < after_ns <= 0:
            return False
        if not 0 < after_ns < _BREAK_NS:
            recent.clear()
        if after_ns <= 0:
            seen.taken_ns = seen.check_ns = _LONG_AGO_NS
        recent.append(skeleton)
        while len(recent) > 2 and stamp_ns - recent[1].stamp_ns >= HOLD * NANOSECONDS:
            recent.popleft()
        if stamp_ns < seen.check_ns:
            return False
        # at fixed times, so that lost frames do not shift the later checks
        seen.check_ns = (stamp_ns // _CHECK_NS + 1) * _CHECK_NS
        if not is_t_pose(_known([skeleton])) or not self._is_held(recent):
            return False
        return self._learn(seen, stamp_ns)

    def _is_held(self, recent: deque[Skeleton]) -> bool:
        """Whether a T-pose is held still over these frames."""
        if recent[-1].stamp_ns - recent[0].stamp_ns < HOLD * NANOSECONDS or len(recent) < _MIN_FRAMES:
            return False
        positions = _known(recent)
        if not is_t_pose(positions):
            return False
        arms = positions[:, _ARMS]
        moving = arms[:, :, 1:3] - arms[:, :, :1]
        moving = moving[np.isfinite(moving).all(axis=(1, 2, 3))]
        return len(moving) >= _MIN_FRAMES and bool((moving.var(axis=0).sum(axis=-1) < _MAX_MOTION**2).all())

    def _learn(self, seen: _Evidence, stamp_ns: int) -> bool:
        """Add a sensor's new frames, and estimate from all sensors together."""
        new = [each for each in seen.recent if each.stamp_ns > seen.taken_ns]
        if not new:
            return False
        points, variance = _in_body_axes(new)
        candidate = _Evidence()
        there = np.isfinite(points).all(axis=-1) & np.isfinite(variance)
        candidate.sum = np.where(there[..., None], points, 0.0).sum(axis=0)
        candidate.variance = np.where(there, variance, 0.0).sum(axis=0)
        candidate.counts = there.sum(axis=0).astype(np.float64)
        own = _offsets([candidate])
        if own is None:
            return False
        if own.distance > self._gate(own.dimension):
            self._counters["t_poses_refused"] += not 0 <= stamp_ns - self._refused_ns < _ANOTHER_NS
            self._refused_ns = stamp_ns
            return False
        self._counters["t_poses"] += not 0 <= stamp_ns - self._held_ns < _ANOTHER_NS
        self._held_ns = seen.taken_ns = stamp_ns
        seen.check_ns = stamp_ns + _CHECK_AGAIN_NS
        seen.sum = seen.sum + candidate.sum
        seen.variance = seen.variance + candidate.variance
        seen.counts = seen.counts + candidate.counts
        known = self.offsets is not None
        if not known:
            self._first_ns = stamp_ns
        self._before = self._in_force(stamp_ns)
        self.offsets, self._since_ns = _offsets(list(self._sensors.values())), stamp_ns
        return not known

    def _gate(self, dimension: int) -> float:
        if dimension not in self._gates:
            self._gates[dimension] = gate(dimension, 1.0 - _GATE_QUANTILE)
        return self._gates[dimension]

    @staticmethod
    def _progress(since_ns: int, stamp_ns: int) -> float:
        """From 0 at the time of an estimate to 1 when it is in force."""
        return 1.0 - math.exp(min(0.0, (since_ns - stamp_ns) / (_FADE_IN * NANOSECONDS)))

    def _in_force(self, stamp_ns: int) -> FloatArray:
        """(11, 3) metres: the offsets to subtract, in the frames of the segments."""
        if self.offsets is None:
            return self._before
        return self._before + self._progress(self._since_ns, stamp_ns) * (self.offsets.local - self._before)

    def corrected(self, positions: FloatArray, measured: BoolArray, stamp_ns: int) -> FloatArray:
        """Subtract the offsets.

        Args:
            positions: (25, 3) metres, as measured.
            measured: (25,) whether each joint is measured.
            stamp_ns: capture time.

        Returns:
            (25, 3) without the offsets; unchanged before the first estimate, or where the shoulders are not seen.
        """
        if self.offsets is None:
            return positions
        known = positions if measured.all() else np.where(measured[:, None], positions, np.nan)
        offsets = posed(known, self._in_force(stamp_ns)[:, None])[:, 0]
        if not math.isfinite(offsets.sum()):
            return positions
        # by the corrected pose: an arm that is measured bent may be straight
        without = known.copy()
        without[LEARNT] -= offsets
        offsets *= retained(without)[:, None]
        result = positions.copy()
        result[_MOVED] -= offsets[_MOVED_AS]
        return result

    def spread(self, positions: FloatArray, stamp_ns: int) -> FloatArray:
        """(75, 75) covariance of the remaining offsets, in the axes of (25, 3) positions."""
        if self.offsets is None:
            return _PRIOR
        frames = posed(positions, np.broadcast_to(np.eye(3), (len(LEARNT), 3, 3)).copy())[_FRAMES]
        if not np.isfinite(frames).all():
            return _PRIOR
        blocks = _rotated(self.offsets.covariance, frames.swapaxes(1, 2))
        share = np.ones(N_JOINTS)
        share[_MOVED] = retained(positions)[_MOVED_AS]
        progress = self._progress(self._first_ns, stamp_ns) * share**2
        old, new = (np.sqrt(each).repeat(3) for each in (progress, 1.0 - progress))
        result: FloatArray = old * old[:, None] * blocks + new * new[:, None] * _PRIOR  # eq. (3)
        return result


def _known(skeletons: Iterable[Skeleton]) -> FloatArray:
    """(n, 25, 3) positions, NaN where not valid."""
    return np.stack([np.where(each.valid[:, None], each.positions, np.nan) for each in skeletons])


def _in_body_axes(skeletons: list[Skeleton]) -> tuple[FloatArray, FloatArray]:
    """(n, 11, 3) joints from the middle of the shoulders, forward, left and up; (n, 11) their stated variances."""
    points, variances = [], []
    for each in skeletons:
        assert each.covariances is not None
        known = np.where(each.valid[:, None], each.positions, np.nan)
        points.append((known[LEARNT] - known[_J.SPINE_SHOULDER]) @ body_axes(known))
        variances.append(each.covariances[LEARNT].trace(axis1=1, axis2=2) / 3.0)
    return np.stack(points), np.stack(variances)


def _offsets(sensors: list[_Evidence]) -> Offsets | None:
    """Offsets from all sensors' frames, weighted by stated precision; None if a joint of trunk or arms is missing."""
    precision, total = np.zeros(len(LEARNT)), np.zeros((len(LEARNT), 3))
    for each in sensors:
        seen = each.counts > 0.0
        counts = np.where(seen, each.counts, 1.0)
        own = np.where(seen, counts / np.maximum(each.variance, 1e-12), 0.0)
        precision += own
        total += own[:, None] * each.sum / counts[:, None]
    if not (precision[_NEEDED] > 0.0).all():
        return None
    seen = precision > 0.0
    points = np.where(seen[:, None], total / np.where(seen, precision, 1.0)[:, None], _SPINE_UNSEEN)
    transient = np.where(seen, _TRANSIENT_SHARE / np.where(seen, precision, 1.0), _UNSEEN)
    positions = np.full((N_JOINTS, 3), np.nan)
    positions[LEARNT] = points
    return t_pose_offsets(positions, transient)

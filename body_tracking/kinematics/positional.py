"""Joint angles from joint positions alone, with their uncertainty.

Every angle is one of two elementary ones, so that the Jacobian is analytic and everything runs as arrays: the angle
between two vectors, and the angle between two vectors seen along a third (a dihedral angle).

========================== ======================================================================== ============
angle                      0, and what is positive                                                  range (deg)
========================== ======================================================================== ============
trunk_flexion              upright; bent forwards                                                   -180 .. 180
trunk_lateral_flexion      upright; bent to the person's right                                       -90 .. 90
trunk_axial_rotation       shoulder line above hip line; chest turned to the person's left          -180 .. 180
shoulder_elevation_*       upper arm along the trunk, downwards; raised                                0 .. 180
shoulder_plane_*           abduction (arm raised sideways); +90 flexion (forwards), -90 extension   -180 .. 180
humeral_rotation_*         bent forearm perpendicular to the plane of trunk axis and upper arm, in
                           front of it (arm raised sideways: pointing forward); internal rotation   -180 .. 180
elbow_flexion_*            straight; bent                                                              0 .. 180
clavicle_elevation_*       shoulder on the level of SpineShoulder along the trunk; raised            -90 .. 90
========================== ======================================================================== ============

The trunk axis runs from SpineBase to SpineShoulder; its flexion and lateral flexion are those of the Cardan sequence
flexion, lateral, axial (ISB: Wu 2005, thorax), relative to the vertical and to the person's heading, the horizontal
direction of the hip line: turning the whole person changes nothing. Signs are right-handed rotations about the person's
left, forward and upward axes. Thorax axes for the arms: up from SpineMid to SpineShoulder; left
along the shoulder line. Elevation, plane and humeral rotation are the three angles of the ISB's Y-X-Y sequence (Wu
2005, glenohumeral): plane of elevation, elevation (there negative), axial rotation; internal rotation is positive.

Kinect's SpineShoulder lies a little above the shoulders: a relaxed clavicle reads some -10 deg.

The signed angles are cut at +-180 deg, where no joint of a person can be (such as an upper arm that points straight at
the other shoulder); within a person's range of motion they are continuous, but for the singularities below.

Uncertainty: first order in the joint covariances, with the joints' errors correlated as in
:func:`~body_tracking.core.measurement.joint_correlation` (a skeleton has covariances of single joints only). Where an
angle is the length of a deflection (elbow flexion near 0: it cannot be negative) the error across the fold is added,
which is of second order. A plane of elevation with the arm at the side and the rotation of a straight or vertical arm
are about an axis that the positions do not determine: the standard deviation grows like 1/sin, and is infinity where
the deflection that gives the direction (the elevation, the elbow flexion) is not significant: less than 3.7 of its own
standard deviations, which noise alone exceeds once in a thousand frames.

The skeleton of a camera has a straight spine: SpineMid lies between its ends, however the person is bent. A Kinect v2
shows the thorax tilted forward too far by 3 to 13 deg in five people beside Vicon. So SpineMid has an error across the
thorax, which all angles of arms and clavicles contain, since they are against the thorax: between upright people as by
Vicon, more where the trunk is tilted, as the posture prior (``kinematics.posture``) shares a bend.

A person can twist the shoulders against the hips by at most 70 deg. The excess of a larger angle is added to its error.

Velocities are the Jacobian times the joint velocities. A skeleton has no covariance of its velocities; the stated
deviation is a bound. For a point driven by white acceleration of density q, the velocity variance of a Kalman filter in
its steady state is (2 q^2 p)^(1/3) with p its position variance, and (3 q^2 p)^(1/3) after a long prediction without
measurements; the bound is the second, with the densities of human movement in ``kinematics.motion``.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final

import numpy as np

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import BONE_CORRELATION, joint_correlation
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint, Skeleton
from body_tracking.kinematics.motion import joint_densities

ANGLE_NAMES: tuple[str, ...] = (
    "trunk_flexion",
    "trunk_lateral_flexion",
    "trunk_axial_rotation",
    "shoulder_elevation_left",
    "shoulder_elevation_right",
    "shoulder_plane_left",
    "shoulder_plane_right",
    "humeral_rotation_left",
    "humeral_rotation_right",
    "elbow_flexion_left",
    "elbow_flexion_right",
    "clavicle_elevation_left",
    "clavicle_elevation_right",
)
"""The angles of :func:`positional_angles`, in order; the module's text defines them."""

_J = Joint
_VECTORS: dict[str, tuple[Joint, Joint]] = {
    "trunk": (_J.SPINE_BASE, _J.SPINE_SHOULDER),
    "thorax": (_J.SPINE_MID, _J.SPINE_SHOULDER),
    "hips": (_J.HIP_RIGHT, _J.HIP_LEFT),
    "shoulders": (_J.SHOULDER_RIGHT, _J.SHOULDER_LEFT),
    "upper_arm_left": (_J.SHOULDER_LEFT, _J.ELBOW_LEFT),
    "upper_arm_right": (_J.SHOULDER_RIGHT, _J.ELBOW_RIGHT),
    "forearm_left": (_J.ELBOW_LEFT, _J.WRIST_LEFT),
    "forearm_right": (_J.ELBOW_RIGHT, _J.WRIST_RIGHT),
    "clavicle_left": (_J.SPINE_SHOULDER, _J.SHOULDER_LEFT),
    "clavicle_right": (_J.SPINE_SHOULDER, _J.SHOULDER_RIGHT),
}
"""(from, to) of the vectors that the angles are made of."""

# Two more vectors follow those of the table: the heading (the hip line's horizontal part) and the vertical.
_NAMES = (*_VECTORS, "heading", "vertical")
_N_VECTORS = len(_VECTORS)

# (angle, vector a, vector b, sign of the angle between them, radians to add)
_BETWEEN = (
    ("trunk_lateral_flexion", "trunk", "heading", 1.0, -np.pi / 2),
    ("shoulder_elevation_left", "upper_arm_left", "thorax", -1.0, np.pi),
    ("shoulder_elevation_right", "upper_arm_right", "thorax", -1.0, np.pi),
    ("elbow_flexion_left", "upper_arm_left", "forearm_left", 1.0, 0.0),
    ("elbow_flexion_right", "upper_arm_right", "forearm_right", 1.0, 0.0),
    ("clavicle_elevation_left", "clavicle_left", "thorax", -1.0, np.pi / 2),
    ("clavicle_elevation_right", "clavicle_right", "thorax", -1.0, np.pi / 2),
)

# (angle, axis, sign of the axis, from vector, sign, to vector, quarter turns to add): from "from" to "to" about "axis"
_DIHEDRAL = (
    ("trunk_flexion", "heading", 1.0, "vertical", 1.0, "trunk", 0),
    ("trunk_axial_rotation", "trunk", 1.0, "hips", 1.0, "shoulders", 0),
    ("shoulder_plane_left", "thorax", -1.0, "shoulders", 1.0, "upper_arm_left", 0),
    ("shoulder_plane_right", "thorax", 1.0, "shoulders", -1.0, "upper_arm_right", 0),
    ("humeral_rotation_left", "upper_arm_left", 1.0, "thorax", 1.0, "forearm_left", -1),
    ("humeral_rotation_right", "upper_arm_right", -1.0, "thorax", 1.0, "forearm_right", -1),
)


def _indices(names: list[str]) -> IntArray:
    return np.array([_NAMES.index(name) for name in names], dtype=np.intp)


_FROM, _TO = (np.array([pair[end] for pair in _VECTORS.values()], dtype=np.intp) for end in (0, 1))
_HIPS = _NAMES.index("hips")

_B_A, _B_B = _indices([row[1] for row in _BETWEEN]), _indices([row[2] for row in _BETWEEN])
_B_SIGN, _B_OFFSET = np.array([row[3] for row in _BETWEEN]), np.array([row[4] for row in _BETWEEN])

_D_AXIS, _D_P, _D_Q = (_indices([str(row[column]) for row in _DIHEDRAL]) for column in (1, 3, 5))
_D_AXIS_SIGN, _D_P_SIGN = np.array([row[2] for row in _DIHEDRAL]), np.array([row[4] for row in _DIHEDRAL])
_D_TURNED = np.array([row[6] != 0 for row in _DIHEDRAL])

_ROWS = [row[0] for row in (*_BETWEEN, *_DIHEDRAL)]
_ORDER: IntArray = np.array([_ROWS.index(name) for name in ANGLE_NAMES], dtype=np.intp)
"""Row of the two tables, one after the other, for each name; all below is in the order of the rows."""
_N_BETWEEN, _N_ANGLES = len(_BETWEEN), len(ANGLE_NAMES)
_TWIST: Final = _ROWS.index("trunk_axial_rotation")
_MOST_TWIST: Final = math.radians(70.0)
"""Largest twist of shoulders against hips: 50 degrees of the spine (``kinematics.ranges``), the rest of the clavicles.
Where a sensor swaps left and right of one girdle it is larger for some frames; the excess is an error."""
_BEND_STDDEV: Final = math.radians(3.0)
"""Standard deviation of the thorax's direction about a vertical trunk's: five people beside Vicon (UI-PRMD) have 3.7
degrees forwards and 1.7 sideways, the posture prior leaves 3.7 and 4.4."""
_BEND_SHARE: Final = 0.15
"""Share of the trunk's tilt by which the thorax tilts farther: 0.07 forwards, 0.15 sideways by the posture prior."""

_JOINTS: IntArray = np.unique(np.concatenate([_FROM, _TO]))
"""The joints that any angle uses."""
_MIDDLE = int(np.searchsorted(_JOINTS, _J.SPINE_MID))


def _incidence() -> FloatArray:
    """(joints, vectors + 2): the derivative of each vector by each used joint, as a factor; the vertical has none."""
    incidence = np.zeros((len(_JOINTS), _N_VECTORS + 2))
    for column, (start, end) in enumerate(_VECTORS.values()):
        incidence[np.searchsorted(_JOINTS, start), column] = -1.0
        incidence[np.searchsorted(_JOINTS, end), column] = 1.0
    incidence[:, _N_VECTORS] = incidence[:, _HIPS]
    return incidence


def _slots() -> tuple[FloatArray, FloatArray]:
    """Incidence of the gradients' slots: (7, joints, 2) of the angles between, (6, joints, 3) of the dihedral ones."""
    incidence = _incidence()
    return (
        np.stack([incidence[:, _B_A], incidence[:, _B_B]], axis=-1).transpose(1, 0, 2),
        np.stack([incidence[:, _D_AXIS], incidence[:, _D_P], incidence[:, _D_Q]], axis=-1).transpose(1, 0, 2),
    )


_B_SLOTS, _D_SLOTS = _slots()
_USED = np.concatenate([(slots != 0).any(axis=2) for slots in (_B_SLOTS, _D_SLOTS, _B_SLOTS)]).T
"""(joints, rows) which joint takes part in which row of the Jacobian."""
_B_HEADING, _D_HEADING = (int(np.flatnonzero(column == _N_VECTORS)[0]) for column in (_B_B, _D_AXIS))
_DENSITIES_SQUARED = 3.0 * joint_densities()[_JOINTS, None] ** 2

_EYE3 = np.eye(3)
_TINY = 1e-18
"""Square metres: a smaller squared length counts as zero."""
_YZX, _ZXY = np.array([1, 2, 0]), np.array([2, 0, 1])
_AT_ONCE: Final = 256
"""Bodies of which the Jacobians, 8 KB each, are in memory at the same time."""
_SINGULAR = 1e-6
"""Sine below which a vector lies along the axis that it should turn about."""
_MAX_STDDEV: FloatArray = np.where(np.arange(_N_ANGLES) < _N_BETWEEN, np.pi / np.sqrt(12.0), np.pi / np.sqrt(3.0))
"""(13,) radians from which an angle is unknown: the standard deviation of a uniform one, over 180 or 360 deg."""
_SIGNIFICANT = math.sqrt(-2.0 * math.log(1.0 - 0.999))  # sqrt of the chi-square quantile for 2 degrees of freedom
"""Standard deviations that a deflection must be long to show a direction."""


def _deflections() -> IntArray:
    """(2, 6) rows of the angles between a dihedral angle's axis and its two vectors; -1 where there is none."""
    rows = {frozenset(pair): row for row, pair in enumerate(zip(_B_A.tolist(), _B_B.tolist(), strict=True))}
    pairs = ([frozenset(pair) for pair in zip(_D_AXIS.tolist(), end.tolist(), strict=True)] for end in (_D_P, _D_Q))
    return np.array([[rows.get(pair, -1) for pair in column] for column in pairs], dtype=np.intp)


_DEFLECTIONS = _deflections()


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of (..., 3, n) arrays; numpy's own takes three times as long on so few."""
    return a.take(_YZX, axis=-2) * b.take(_ZXY, axis=-2) - a.take(_ZXY, axis=-2) * b.take(_YZX, axis=-2)


def _vectors(positions: FloatArray) -> FloatArray:
    """(..., 3, 12) the vectors of the table, the heading and the vertical; NaN where a joint is NaN."""
    vectors = np.empty((*positions.shape[:-2], 3, _N_VECTORS + 2))
    vectors[..., :_N_VECTORS] = (positions[..., _TO, :] - positions[..., _FROM, :]).swapaxes(-1, -2)
    vectors[..., :2, _N_VECTORS] = vectors[..., :2, _HIPS]
    vectors[..., 2, _N_VECTORS] = 0.0
    vectors[..., _N_VECTORS + 1] = 0.0, 0.0, 1.0
    return vectors


def _between(
    a: FloatArray, b: FloatArray, aa: FloatArray, bb: FloatArray, ab: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Angles between the columns of two (..., 3, n) arrays, given with their dot products.

    Returns:
        (..., n) angles from 0 to pi, (..., n) their sines, (..., 2, 3, n) gradients by a and b, (..., 2, 3, n)
        gradients of the deflection across the plane of a and b, by which the angle changes to first order only where it
        is 0 or pi.
    """
    scale = np.sqrt(aa * bb)
    normal = _cross(a, b)
    area = np.sqrt((normal * normal).sum(axis=-2))
    angle, sine = np.arctan2(area, ab), area / scale
    gradient = np.stack([a * (ab / aa)[..., None, :] - b, b * (ab / bb)[..., None, :] - a], axis=-3)
    flat = sine < _SINGULAR
    if flat.any():  # every direction across a is as good
        along, other = (np.moveaxis(each, -2, 0)[:, flat] for each in (a, b))
        least = np.eye(3)[:, np.abs(along).argmin(axis=0)]
        aside = _cross(along, least)
        np.moveaxis(normal, -2, 0)[:, flat] = aside
        area[flat] = np.sqrt((aside**2).sum(axis=0))
        by_a, by_b = (np.moveaxis(gradient[..., k, :, :], -2, 0) for k in (0, 1))
        by_a[:, flat] = _cross(along, aside) / aa[flat]
        by_b[:, flat] = _cross(aside, other) / bb[flat]
    across = np.stack(
        [normal * (-ab / (scale * np.sqrt(aa)))[..., None, :], normal / np.sqrt(bb)[..., None, :]], axis=-3
    )
    area = area[..., None, None, :]
    return angle, sine, gradient / area, across / area


def _dihedral(
    n: FloatArray, p: FloatArray, q: FloatArray, nn: FloatArray, np_: FloatArray, nq: FloatArray, pq: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Angles from p to q about n, columns of (..., 3, m) arrays, given with dot products (Blondel and Karplus 1996).

    Returns:
        (..., m) sines and (..., m) cosines, scaled alike; (..., 3, 3, m) gradients by n, p and q; (..., m) and (..., m)
        the squared areas of (n, p) and (n, q), one of which is 0 where the angle is not defined.
    """
    length = np.sqrt(nn)
    a, b = _cross(n, p), _cross(n, q)
    aa, bb = (a * a).sum(axis=-2), (b * b).sum(axis=-2)
    # the floor keeps the gradient finite, and huge, at the singularity
    by_p, by_q = (each / np.maximum(square, _TINY)[..., None, :] for each, square in ((a, aa), (b, bb)))
    gradient = np.stack(
        [
            by_p * np_[..., None, :] - by_q * nq[..., None, :],
            by_p * -nn[..., None, :],
            by_q * nn[..., None, :],
        ],
        axis=-3,
    )
    gradient /= length[..., None, None, :]
    return length * (a * q).sum(axis=-2), nn * pq - np_ * nq, gradient, aa, bb


@lru_cache
def _correlation(of_bones: float) -> FloatArray:
    """(joints, joints) correlation of the errors of the used joints."""
    return joint_correlation(of_bones)[np.ix_(_JOINTS, _JOINTS)]


def _roots(covariances: FloatArray) -> FloatArray:
    """(..., joints, 3, 3) Cholesky factors; NaN where a covariance is not finite or not positive definite."""
    known = np.asarray(np.isfinite(covariances).all(axis=(-2, -1)))
    if not known.all():
        covariances = np.where(known[..., None, None], covariances, _EYE3)
    try:
        roots = np.linalg.cholesky(covariances)
    except np.linalg.LinAlgError:  # symmetric roots exist for semidefinite ones, too
        if covariances.ndim > 3:  # of these bodies only
            return np.where(known[..., None, None], np.stack([_roots(each) for each in covariances]), np.nan)
        values, axes = np.linalg.eigh(covariances)
        roots = axes * np.sqrt(values)[:, None, :]
    return np.where(known[..., None, None], roots, np.nan)


def positional_angles(skeleton: Skeleton, of_bones: float = BONE_CORRELATION) -> JointAngles:
    """The angles of ``ANGLE_NAMES`` of one body; see the module's text for their definitions.

    The elbow's is that of Schlagenhauf (2017), section 4.3.2: between upper arm and forearm.

    Args:
        skeleton: in a frame with z up, usually ``/filtered/skeleton``.
        of_bones: correlation of the errors of the two joints of a bone; 0 for independent joints.

    Returns:
        Angles in radians. An angle that needs an unknown joint, or two joints at the same place, is NaN with an
        infinite standard deviation. Without covariances in the skeleton every standard deviation is infinite, without
        velocities every velocity is NaN.
    """
    n = _N_ANGLES
    with np.errstate(all="ignore"):  # NaN and infinity mark unknown values
        positions = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)
        angles, jacobian, stddev, variances = _stated(positions, skeleton.covariances, of_bones)
        rates, rate_stddev = np.full(n, np.nan), np.full(n, np.inf)
        if skeleton.velocities is not None:
            parts = (jacobian[:, :n] * skeleton.velocities[_JOINTS, None, :]).sum(axis=2)
            rates = np.where(_USED[:, :n], parts, 0.0).sum(axis=0)
            if variances is not None:
                unknown = np.isinf(stddev)
                steepness = (jacobian[:, :n] ** 2).sum(axis=2)
                bounds = np.cbrt(_DENSITIES_SQUARED * steepness**2 * variances[:, :n])
                rate_stddev = np.sqrt(np.where(_USED[:, :n], bounds, 0.0).sum(axis=0))
                rate_stddev[unknown | np.isnan(rates)] = np.inf
    return JointAngles(
        skeleton.stamp_ns, ANGLE_NAMES, angles[_ORDER], rates[_ORDER], stddev[_ORDER], rate_stddev[_ORDER]
    )


def angles_over_time(positions: FloatArray, covariances: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
    """Positions and standard deviations of :func:`positional_angles` of many bodies at once.

    Args:
        positions: (n, 25, 3) metres, z up, NaN where unknown.
        covariances: (n, 25, 3, 3) square metres; None if not stated.

    Returns:
        (n, 13) radians, NaN where unknown, and their standard deviations, infinite where unknown.
    """
    known = np.isfinite(positions).all(axis=-1, keepdims=True)
    positions = np.where(known, positions, np.nan)
    angles, stddev = np.empty((2, len(positions), _N_ANGLES))
    with np.errstate(all="ignore"):
        for begin in range(0, len(positions), _AT_ONCE):
            part = slice(begin, begin + _AT_ONCE)
            stated = None if covariances is None else covariances[part]
            angles[part], _, stddev[part], _ = _stated(positions[part], stated, BONE_CORRELATION)
    return angles[:, _ORDER], stddev[:, _ORDER]


def _stated(
    positions: FloatArray, covariances: FloatArray | None, of_bones: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray | None]:
    """All angles, their Jacobian and standard deviations, in the order of the tables; shapes as for one body.

    Returns:
        (13,) angles, (joints, 20, 3) their Jacobian as in :func:`_angles_and_jacobian`, (13,) standard deviations, and
        (joints, 20) the variances that each joint adds; None without covariances.
    """
    n = _N_ANGLES
    angles, jacobian, sine, singular = _angles_and_jacobian(positions)
    if covariances is None:
        return angles, jacobian, np.full_like(angles, np.inf), None
    unknown = np.isnan(angles)
    unknown[..., _N_BETWEEN:] |= singular
    errors = np.where(_USED[:, :, None], jacobian @ _roots(covariances[..., _JOINTS, :, :]), 0.0)
    variances = (errors * errors).sum(axis=-1)
    flat = errors.reshape(*errors.shape[:-2], -1)
    together = (_correlation(of_bones) @ flat).reshape(errors.shape)
    variance = np.maximum((errors * together).sum(axis=(-3, -1)), 0.0)
    by_bend = np.asarray(_bend_variance(positions))[..., None] * (jacobian[..., _MIDDLE, :, :] ** 2).sum(axis=-1)
    variance += np.where(_USED[_MIDDLE], by_bend, 0.0)
    # Near the fold of an angle that cannot be negative the deflection across is an error of its own size, far from it
    # none; in between it is of second order. With the factor 2 the 95 % band of a straight elbow holds.
    across = variance[..., n:]
    unknown[..., _N_BETWEEN:] |= _insignificant(angles[..., :_N_BETWEEN], variance[..., :_N_BETWEEN])
    variance[..., :_N_BETWEEN] += across * np.minimum(1.0, 2.0 * across / sine**2)
    variance[..., _TWIST] += np.maximum(np.abs(angles[..., _TWIST]) - _MOST_TWIST, 0.0) ** 2
    stddev = np.sqrt(variance[..., :n])
    unknown |= ~(stddev <= _MAX_STDDEV)
    stddev[unknown] = np.inf
    return angles, jacobian, stddev, variances


def _bend_variance(positions: FloatArray) -> FloatArray:
    """(...,) square metres: variance of SpineMid across the thorax by the spine's bend; NaN where it is unknown."""
    thorax = positions[..., _J.SPINE_SHOULDER, :] - positions[..., _J.SPINE_MID, :]
    tilt = np.arctan2(np.hypot(thorax[..., 0], thorax[..., 1]), thorax[..., 2])
    variance: FloatArray = (_BEND_STDDEV**2 + (_BEND_SHARE * tilt) ** 2) * (thorax * thorax).sum(axis=-1)
    return variance


def _insignificant(angles: FloatArray, variance: FloatArray) -> BoolArray:
    """(..., 6) dihedral angles of which a vector may as well lie along the axis, from the (..., 7) between vectors."""
    between = _B_SIGN * (angles - _B_OFFSET)
    deflection = np.minimum(between, np.pi - between)
    shown = np.ones((*angles.shape[:-1], _N_BETWEEN + 1), dtype=bool)  # the last is for -1
    shown[..., :-1] = deflection > _SIGNIFICANT * np.sqrt(variance)
    return np.logical_not(shown[..., _DEFLECTIONS].all(axis=-2))


def _angles_and_jacobian(positions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """All angles and their derivatives, in the order of the two tables; of several bodies with one more axis in front.

    Args:
        positions: (25, 3) metres, NaN where unknown.

    Returns:
        (13,) angles; (joints, 20, 3) their Jacobian by the used joints and, in the last 7 rows, that of the deflections
        across the folds of the angles between vectors; (7,) sines of these angles; (6,) dihedral angles that turn
        about an axis along one of their vectors.
    """
    vectors = _vectors(positions)
    dots = vectors.swapaxes(-1, -2) @ vectors
    squares = dots.diagonal(axis1=-2, axis2=-1).copy()
    squares[squares < _TINY] = np.nan  # two joints at one place have no direction

    between, sine, gradient, across = _between(
        *(vectors[..., _B_A], vectors[..., _B_B]),
        *(squares[..., _B_A], squares[..., _B_B], dots[..., _B_A, _B_B]),
    )
    y, x, turn_gradient, area_p, area_q = _dihedral(
        vectors[..., _D_AXIS] * _D_AXIS_SIGN,
        vectors[..., _D_P] * _D_P_SIGN,
        vectors[..., _D_Q],
        squares[..., _D_AXIS],
        dots[..., _D_AXIS, _D_P] * (_D_AXIS_SIGN * _D_P_SIGN),
        dots[..., _D_AXIS, _D_Q] * _D_AXIS_SIGN,
        dots[..., _D_P, _D_Q] * _D_P_SIGN,
    )
    smaller = np.minimum(area_p / squares[..., _D_P], area_q / squares[..., _D_Q]) / squares[..., _D_AXIS]
    dihedral = np.where(_D_TURNED, np.arctan2(-x, y), np.arctan2(y, x))  # a quarter turn back
    # propagate the NaN of a vector without length to its angles, which would be finite otherwise
    angles = np.concatenate([_B_SIGN * between + _B_OFFSET + 0.0 * sine, dihedral + 0.0 * smaller], axis=-1)

    gradient *= _B_SIGN
    turn_gradient[..., 0, :, :] *= _D_AXIS_SIGN
    turn_gradient[..., 1, :, :] *= _D_P_SIGN
    # the heading is the horizontal part of the hip line
    gradient[..., 1, 2, _B_HEADING] = across[..., 1, 2, _B_HEADING] = 0.0
    turn_gradient[..., 0, 2, _D_HEADING] = 0.0
    jacobian = np.concatenate(
        [
            _B_SLOTS @ np.moveaxis(gradient, -1, -3),
            _D_SLOTS @ np.moveaxis(turn_gradient, -1, -3),
            _B_SLOTS @ np.moveaxis(across, -1, -3),
        ],
        axis=-3,
    )
    return angles, jacobian.swapaxes(-3, -2), sine, ~(smaller > _SINGULAR**2)

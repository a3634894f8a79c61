"""Alignment of inertial sensors with their segments by a held pose.

A known pose gives R_world_segment = R_pose in eq. 1. Sensors that each have a heading of their own leave four unknowns
for its three equations; the intended mounting, or headings known from elsewhere, determine the fourth. The most
probable alignment A = A_0 exp(delta) and heading psi minimise, weighted by their covariances,

    log(R_pose^T Rz(psi) R_es A),  log(A_intended^T A),  psi - psi_known                                            (4)

People hold a pose to within 5-10 degrees per axis of a segment (static calibrations of the upper limb, compared by
Bouvier et al., Sensors 15 (2015) 18813). One person repeats a pose to 2 degrees, people differ by far more (Donaldson
et al., ISBS 39 (2021) 58): longer averaging does not reduce this error. See :func:`pose_covariance`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.core.so3 import wrapped
from body_tracking.kinematics.upper_body import UpperBody

Pose = Literal["t", "n"]

POSE_STDDEV: Final = float(np.radians(6.0))
"""Radians per axis: standard deviation of a joint from the requested pose; that of a segment becomes 6-10 degrees."""
TISSUE_STDDEV: Final = float(np.radians(3.0))
"""Radians per axis: standard deviation of a sensor's rotation by soft tissue."""
MOUNTING_STDDEV: Final = float(np.radians(10.0))
"""Radians per axis: standard deviation of a sensor from its intended mounting."""
CLAVICLE_IN_T: Final = float(np.radians(20.0))
"""Radians of a clavicle's elevation with the arm at 90 degrees: a third of that beyond 30 (Inman et al. 1944)."""

STILL_RATE: Final = 0.25
"""rad/s, root mean square over a tenth of a second: above the sway in a pose and a gyroscope's bias. Slow rotation
exceeds :data:`STILL_TURN`."""
STILL_TIME: Final = 1.0
"""Seconds that a pose must be held."""
STILL_TURN: Final = float(np.radians(10.0))
"""Greatest rotation of a sensor from the beginning of a pose to its end, radians."""
_BIN = 0.1
POSE_CONE: Final = float(np.radians(35.0))
"""Radians within which an arm counts as hanging or horizontal."""

_Z: Final = np.array([0.0, 0.0, 1.0])
_STEPS = 12


class AlignmentError(BodyTrackingError):
    """Sensors, poses or movements that cannot be aligned."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """The readings of one oriented sensor.

    Attributes:
        segment: of ``UpperBody.segment_names``, its stated place.
        stamps: (n,) seconds, strictly ascending, in a clock common to all streams.
        rotations: (n, 3, 3) sensor to its earth.
        rates: (n, 3) rad/s in the sensor's frame.
    """

    segment: str
    stamps: FloatArray
    rotations: FloatArray
    rates: FloatArray

    def between(self, begin: float, end: float) -> Stream:
        """The samples from begin to end, end excluded."""
        part = slice(*np.searchsorted(self.stamps, [begin, end]))
        return Stream(self.segment, self.stamps[part], self.rotations[part], self.rates[part])


@dataclass(frozen=True, slots=True)
class StillPeriod:
    """A period in which no sensor moved.

    Attributes:
        begin, end: seconds.
    """

    begin: float
    end: float


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """The rotations of k sensors against their segments, and the headings of their earth frames.

    Attributes:
        segments: k names.
        rotations: (k, 3, 3) segment to sensor.
        headings: (k,) radians, earth to world about z.
        covariance: (4 k, 4 k) radians squared: for each sensor the error of its rotation (a small rotation vector in
            the segment's frame), then that of its heading.
    """

    segments: tuple[str, ...]
    rotations: FloatArray
    headings: FloatArray
    covariance: FloatArray

    @property
    def stddev(self) -> FloatArray:
        """(k, 4) radians."""
        result: FloatArray = np.sqrt(self.covariance.diagonal()).reshape(-1, 4)
        return result

    def oriented(self, number: int, rotations: FloatArray) -> FloatArray:
        """(n, 3, 3) orientations of a segment in world from those (n, 3, 3) of its sensor in its earth (eq. 1)."""
        result: FloatArray = yaw(self.headings[number]) @ rotations @ self.rotations[number]
        return result

    def replaced(self, part: Alignment) -> Alignment:
        """A copy with another alignment of some sensors, uncorrelated with the others.

        Raises:
            AlignmentError: a segment without a sensor here.
        """
        numbers = numbers_of(self, *part.segments)
        rotations, headings, covariance = self.rotations.copy(), self.headings.copy(), self.covariance.copy()
        rotations[numbers], headings[numbers] = part.rotations, wrapped(part.headings)
        rows = (4 * numbers[:, None] + np.arange(4)).reshape(-1)
        covariance[rows], covariance[:, rows] = 0.0, 0.0
        covariance[np.ix_(rows, rows)] = part.covariance
        return Alignment(self.segments, rotations, headings, covariance)

    def moved(self, error: FloatArray, covariance: FloatArray) -> Alignment:
        """A copy corrected by (4 k,) errors in the coordinates of the covariance."""
        parts = error.reshape(-1, 4)
        turned = self.rotations @ so3.quat_to_matrix(so3.exp(parts[:, :3]))
        return Alignment(self.segments, turned, wrapped(self.headings + parts[:, 3]), 0.5 * (covariance + covariance.T))


def yaw(angle: FloatArray | float) -> FloatArray:
    """(..., 3, 3) rotations about z by (...) radians."""
    return so3.quat_to_matrix(so3.exp(np.asarray(angle, float)[..., None] * _Z))


# ---------------------------------------------------------------------------------------------------------------------
# the pose


def pose_rotations(model: UpperBody, pose: Pose) -> FloatArray:
    """(12, 3, 3) orientations of all segments in a pose of a person who faces x.

    ``n`` is the model's neutral pose: arms hanging, thumbs forward. ``t`` has the arms out to the sides, thumbs forward
    and palms down, with raised clavicles.

    Raises:
        AlignmentError: another pose.
    """
    return model.forward(_pose(model, pose), model.default_lengths()).rotations


def _pose(model: UpperBody, pose: Pose) -> FloatArray:
    q = model.neutral()
    if pose == "t":
        v = np.zeros(model.nv)
        for side, sign in (("left", 1.0), ("right", -1.0)):
            v[model.coordinate_names.index(f"clavicle_elevation_{side}")] = CLAVICLE_IN_T
            v[model.coordinate_names.index(f"shoulder_x_{side}")] = sign * (0.5 * np.pi - CLAVICLE_IN_T)
        q = model.integrate(q, v)
    elif pose != "n":
        raise AlignmentError(f"pose {pose!r}: expected 't' or 'n'")
    return q


def pose_covariance(
    model: UpperBody, pose: Pose, segments: Sequence[str], joint_stddev: float = POSE_STDDEV
) -> FloatArray:
    """(3 k, 3 k) radians squared: covariance of people's segments about a pose, each in its own frame.

    Joints have a standard deviation of ``joint_stddev`` radians per axis; the error of a proximal joint moves all
    distal segments. Soft tissue adds :data:`TISSUE_STDDEV` for each sensor.

    Raises:
        AlignmentError: a segment that the model does not have.
    """
    unknown = [name for name in segments if name not in model.segment_names]
    if unknown:
        raise AlignmentError(f"no segment {', '.join(unknown)}")
    stddev = np.full(model.nv, joint_stddev)
    stddev[:3] = 0.0
    for number, name in enumerate(model.coordinate_names):
        if name.startswith(("lumbar", "thoracic")):  # both joints together have the trunk's deviation
            stddev[number] *= np.sqrt(0.5)
    lines = model.linearise(_pose(model, pose), model.default_lengths())
    numbers = [model.segment_names.index(name) for name in segments]
    own = lines.posture.rotations[numbers].swapaxes(-1, -2) @ lines.rotation_jacobian[numbers]
    spread = own.reshape(-1, model.nv) * stddev
    result: FloatArray = spread @ spread.T + TISSUE_STDDEV**2 * np.eye(len(spread))
    return result


def still_periods(streams: Sequence[Stream]) -> tuple[StillPeriod, ...]:
    """Periods in which all sensors were still for at least :data:`STILL_TIME`."""
    if not all(len(stream.stamps) for stream in streams):
        return ()
    begin = max(stream.stamps[0] for stream in streams)
    count = int((min(stream.stamps[-1] for stream in streams) - begin) / _BIN)
    if count < 1:
        return ()
    still = np.ones(count, dtype=np.bool_)
    for stream in streams:
        place = np.floor((stream.stamps - begin) / _BIN).astype(np.intp)
        inside = (place >= 0) & (place < count)
        squares = np.bincount(place[inside], (stream.rates[inside] ** 2).sum(axis=1), count)
        samples = np.bincount(place[inside], minlength=count)
        # a bin without a sample counts as still: no movement begins and ends within a tenth of a second
        with np.errstate(invalid="ignore"):
            still &= (samples == 0) | (squares / samples < STILL_RATE**2)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    found = []
    for first, last in edges.reshape(-1, 2):
        start, stop = begin + _BIN * first, begin + _BIN * last
        if stop - start >= STILL_TIME - 1e-9 and all(
            _turned(stream.between(start, stop)) < STILL_TURN for stream in streams
        ):
            found.append(StillPeriod(float(start), float(stop)))
    return tuple(found)


def _turned(stream: Stream) -> float:
    """Radians between the first and the last orientation; infinite without samples."""
    if len(stream.stamps) < 2:
        return np.inf
    return float(np.linalg.norm(so3.rotation_vectors(stream.rotations[0].T @ stream.rotations[-1])))


def pose_of(streams: Sequence[Stream], mountings: FloatArray, period: StillPeriod) -> Pose | None:
    """The pose by the inclination of the arms; None if neither pose is held, or no arm carries a sensor.

    Args:
        streams: k sensors.
        mountings: (k, 3, 3) segment to sensor, as intended.
        period: of the pose.
    """
    slopes = []
    for stream, mounting in zip(streams, mountings, strict=True):
        if stream.segment.startswith(("upper_arm", "forearm")):
            part = stream.between(period.begin, period.end)
            if len(part.stamps):
                slopes.append(float((so3.mean_rotation(part.rotations) @ -mounting[:, 2])[2]))
    if not slopes:
        return None
    angles = np.arcsin(np.clip(slopes, -1.0, 1.0))
    if (angles < POSE_CONE - 0.5 * np.pi).all():
        return "n"
    return "t" if (np.abs(angles) < POSE_CONE).all() else None


def align_in_pose(
    segments: Sequence[str],
    measured: FloatArray,
    pose: FloatArray,
    covariance: FloatArray,
    *,
    mountings: FloatArray | None = None,
    mounting_stddev: float = MOUNTING_STDDEV,
    headings: FloatArray | None = None,
    heading_covariance: FloatArray | None = None,
    facing: float = 0.0,
) -> Alignment:
    """The alignment of k sensors in a known pose (eq. 4).

    Args:
        segments: k names.
        measured: (k, 3, 3) sensor to earth, the mean over the pose.
        pose: (k, 3, 3) the segments of a person who faces x, such as of :func:`pose_rotations`.
        covariance: (3 k, 3 k) of people about the pose, such as :func:`pose_covariance`.
        mountings: (k, 3, 3) segment to sensor, as intended; None if unknown.
        mounting_stddev: radians per axis, of sensors from their intended mounting.
        headings: (k,) radians, earth to world, known from elsewhere, or None.
        heading_covariance: (k, k) of these. Sensors with magnetometers share a heading: a large common variance and a
            small own one.
        facing: radians, the person's heading in world.

    Returns:
        The alignment; without mountings and headings its headings have the deviation of unknown ones.
    """
    k = len(segments)
    posed = yaw(facing) @ pose
    # an unknown heading is uniform over a turn
    known = np.diag(np.full(k, np.pi**2 / 3.0)) if heading_covariance is None else heading_covariance
    if mountings is not None:
        turn = posed @ mountings.swapaxes(-1, -2) @ measured.swapaxes(-1, -2)
        psi = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    else:
        psi = np.zeros(k)
    prior = psi if headings is None else headings
    if headings is not None and mountings is None:
        psi = prior.copy()
    elif headings is not None:
        # a common unknown part of the given headings is their mean difference from those by the mountings
        common = np.angle(np.exp(1j * (psi - prior)).mean())
        prior = prior + (common if known[0, 0] > (0.5 * np.pi) ** 2 else 0.0)
        psi = prior.copy()
    rotations: FloatArray = measured.swapaxes(-1, -2) @ yaw(psi).swapaxes(-1, -2) @ posed

    pose_information, heading_information = np.linalg.inv(covariance), np.linalg.inv(known)
    rows = np.arange(4 * k).reshape(k, 4)
    information = np.eye(4 * k)
    for _ in range(_STEPS):
        world = yaw(psi) @ measured @ rotations
        off = so3.rotation_vectors(posed.swapaxes(-1, -2) @ world)
        away = None if mountings is None else so3.rotation_vectors(mountings.swapaxes(-1, -2) @ rotations)
        back = so3.right_jacobian_inverse(off)
        jacobian = np.zeros((3 * k, 4 * k))
        information, gradient = np.zeros((4 * k, 4 * k)), np.zeros(4 * k)
        for i in range(k):
            jacobian[3 * i : 3 * i + 3, rows[i, :3]] = back[i]
            jacobian[3 * i : 3 * i + 3, rows[i, 3]] = back[i] @ world[i, 2]
            if away is not None:
                by = so3.right_jacobian_inverse(away[i]) / mounting_stddev
                information[np.ix_(rows[i, :3], rows[i, :3])] += by.T @ by
                gradient[rows[i, :3]] += by.T @ away[i] / mounting_stddev
        information += jacobian.T @ pose_information @ jacobian
        gradient += jacobian.T @ pose_information @ off.reshape(-1)
        information[np.ix_(rows[:, 3], rows[:, 3])] += heading_information
        gradient[rows[:, 3]] += heading_information @ wrapped(psi - prior)
        step: FloatArray = np.asarray(np.linalg.solve(information, -gradient), dtype=np.float64)
        found = Alignment(tuple(segments), rotations, psi, information).moved(step, information)
        rotations, psi = found.rotations, found.headings
        if np.abs(step).max() < 1e-9:
            break
    return Alignment(tuple(segments), rotations, psi, np.asarray(np.linalg.inv(information), dtype=np.float64))


# ---------------------------------------------------------------------------------------------------------------------
# the axes


def across(axis: FloatArray) -> FloatArray:
    """(3, 2) two unit vectors normal to a unit vector and to each other."""
    least = np.eye(3)[int(np.abs(axis).argmin())]
    one = np.cross(axis, least)
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(axis, one)], axis=-1)


def elbow_segment_axes(side: str) -> tuple[FloatArray, FloatArray]:
    """(3,) flexion axis in the upper arm's frame and (3,) pronation axis in the forearm's, as in ``UpperBody``.

    Raises:
        AlignmentError: neither ``left`` nor ``right``.
    """
    if side not in ("left", "right"):
        raise AlignmentError(f"side {side!r}: expected 'left' or 'right'")
    return np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0 if side == "left" else 1.0])


def numbers_of(alignment: Alignment, *segments: str) -> IntArray:
    """Indices of segments in an alignment.

    Raises:
        AlignmentError: a segment without a sensor.
    """
    missing = [name for name in segments if name not in alignment.segments]
    if missing:
        raise AlignmentError(f"no sensor on {', '.join(missing)}")
    return np.array([alignment.segments.index(name) for name in segments], dtype=np.intp)

"""How inertial sensors are turned against their segments: from a held pose, and from the axes of the elbow.

**Pose.** In a pose that the model knows, R_pose of eq. 1 is given. Sensors that each have a heading of their own leave
four unknowns for its three equations; how the sensor was meant to be put on, or headings known from elsewhere, tell
the fourth. The most probable alignment A = A_0 exp(delta) and heading psi minimise, weighted by their covariances,

    log(R_pose^T Rz(psi) R_es A),  log(A_meant^T A),  psi - psi_known                                               (4)

People hold a pose to within 5-10 degrees per axis of a segment; static calibrations of the upper limb compared by
Bouvier et al., Sensors 15 (2015) 18813. One person repeats a pose to 2 degrees, people differ by far more (Donaldson
et al., ISBS 39 (2021) 58): it is no noise that more time averages out. See :func:`pose_covariance`.

**Elbow.** Flexion turns about an axis j1 that is fixed in the upper arm, pronation about j2 fixed in the forearm, so
that the relative angular rate has no part square to both (Mueller et al. 2016; with the heading between the two sensors
Delta unknown besides, Laidig, Weygers and Seel, Sensors 22 (2022) 9850):

    (R1 w1 - Rz(Delta) R2 w2) . n / |n| = 0,  n = R1 j1 x Rz(Delta) R2 j2                                           (5)

It is weighted by what an angular rate is worth at that speed (as Olsson et al., Sensors 20 (2020) 3534, weigh
samples by their motion), and robust. A sample counts as often as what it leaves is independent of the one before; and
no movement knows an axis better than the flesh and the person's own joint let it.

Over 500 lines: the inertial issue rewrites headings and alignment.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation, Slerp

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.kinematics.upper_body import UpperBody

Pose = Literal["t", "n"]

POSE_STDDEV: Final = float(np.radians(6.0))
"""Radians by which a person's joint is off the pose that was asked for, about each of its axes: makes 6-10 degrees of a
segment."""
TISSUE_STDDEV: Final = float(np.radians(3.0))
"""Radians per axis by which the flesh turns a sensor."""
MOUNTING_STDDEV: Final = float(np.radians(10.0))
"""Radians per axis by which a sensor is off how it was meant to be put on."""
CLAVICLE_IN_T: Final = float(np.radians(20.0))
"""Radians of a clavicle's elevation with the arm at 90 degrees: a third of what is beyond 30 (Inman et al. 1944)."""

STILL_RATE: Final = 0.25
"""rad/s, root mean square of a tenth of a second: who holds a pose sways by less, and no gyroscope's bias is as much.
What turns slowly all the while turns further than :data:`STILL_TURN`."""
STILL_TIME: Final = 1.0
"""Seconds that a pose must be held."""
STILL_TURN: Final = float(np.radians(10.0))
"""Radians by which a sensor may have turned from the beginning of a pose to its end."""
_BIN = 0.1
POSE_CONE: Final = float(np.radians(35.0))
"""Radians from hanging, or from horizontal, within which an arm is taken to be."""

AXIS_FLOOR: Final = float(np.radians(5.0))
"""Radians per direction below which no fit knows an axis: the skin follows a forearm's twist only in part."""
AXIS_OFF: Final = float(np.radians(4.0))
"""Radians per direction by which a person's axes are off the model's: carrying angle, varus and valgus."""
FLESH_TURN: Final = float(np.radians(15.0))
"""Radians by which the movement of an elbow tells the heading between its sensors wrongly, as skin lags a twist by a
fifth; simulated."""
_RATE_NOISE = 0.03
_RATE_SHARE = 0.1
"""rad/s and share of itself that a relative rate is off: noise and bias, and the flesh that swings."""
_TWIST_SHARE = 0.2
_REPETITIONS = 15.0
"""Share of a segment's twist that the skin does not follow; and how many independent samples there are at most: the
flesh errs alike in each repetition of a movement."""
_LEAST_TURNING = 0.3
"""rad/s: less motion than that at an elbow says nothing."""
_Z: Final = np.array([0.0, 0.0, 1.0])
_STEPS = 12


class AlignmentError(BodyTrackingError):
    """Sensors, poses or movements that cannot be aligned."""


@dataclass(frozen=True, slots=True, eq=False)
class Stream:
    """What one oriented sensor said.

    Attributes:
        segment: of ``UpperBody.segment_names``, that it is supposed to be on.
        stamps: (n,) seconds, strictly ascending, in a clock that all streams share.
        rotations: (n, 3, 3) sensor to its earth.
        rates: (n, 3) rad/s in the sensor's frame.

    Raises:
        AlignmentError: shapes that do not belong together, stamps that do not ascend, numbers that are not finite.
    """

    segment: str
    stamps: FloatArray
    rotations: FloatArray
    rates: FloatArray

    def __post_init__(self) -> None:
        n = len(self.stamps)
        if self.stamps.shape != (n,) or self.rotations.shape != (n, 3, 3) or self.rates.shape != (n, 3):
            shapes = f"{self.stamps.shape}, {self.rotations.shape}, {self.rates.shape}"
            raise AlignmentError(f"{self.segment}: stamps, rotations and rates of shapes {shapes}")
        if not np.isfinite(self.stamps).all() or (np.diff(self.stamps) <= 0.0).any():
            raise AlignmentError(f"{self.segment}: stamps must be finite and ascend")
        if not (np.isfinite(self.rotations).all() and np.isfinite(self.rates).all()):
            raise AlignmentError(f"{self.segment}: rotations and rates must be finite")

    def between(self, begin: float, end: float) -> Stream:
        """The samples from a time on, up to another."""
        part = slice(*np.searchsorted(self.stamps, [begin, end]))
        return Stream(self.segment, self.stamps[part], self.rotations[part], self.rates[part])

    def thinned(self, rate: float) -> Stream:
        """At most about so many samples per second."""
        if len(self.stamps) < 2:
            return self
        every = max(1, round(float(len(self.stamps) - 1) / float(np.ptp(self.stamps)) / rate))
        part = slice(None, None, every)
        return Stream(self.segment, self.stamps[part], self.rotations[part], self.rates[part])

    def at(self, times: FloatArray, gap: float = 0.1) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Rotations and rates between samples, and where samples no further apart than a gap surround the time."""
        if len(self.stamps) < 2:
            nowhere = np.zeros(len(times), dtype=np.bool_)
            return np.tile(np.eye(3), (len(times), 1, 1)), np.zeros((len(times), 3)), nowhere
        index = np.clip(np.searchsorted(self.stamps, times), 1, len(self.stamps) - 1)
        inside = (times >= self.stamps[0]) & (times <= self.stamps[-1])
        known: BoolArray = inside & (self.stamps[index] - self.stamps[index - 1] <= gap)
        clipped = np.clip(times, self.stamps[0], self.stamps[-1])
        rotations = Slerp(self.stamps, Rotation.from_matrix(self.rotations))(clipped).as_matrix()
        rates = np.stack([np.interp(clipped, self.stamps, column) for column in self.rates.T], axis=-1)
        return rotations, rates, known


@dataclass(frozen=True, slots=True)
class StillPeriod:
    """A time in which nothing moved.

    Attributes:
        begin, end: seconds.
    """

    begin: float
    end: float


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """How k sensors are turned against their segments, and which way their earths face.

    Attributes:
        segments: k names.
        rotations: (k, 3, 3) segment to sensor.
        headings: (k,) radians, earth to world about z.
        covariance: (4 k, 4 k) radians squared: of sensor after sensor the error of its rotation (three numbers, a small
            rotation vector in the segment's frame), then that of its heading.
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
        """(n, 3, 3) orientations of a segment in world, of those (n, 3, 3) of its sensor in its earth (eq. 1)."""
        result: FloatArray = yaw(self.headings[number]) @ rotations @ self.rotations[number]
        return result

    def replaced(self, part: Alignment) -> Alignment:
        """With other knowledge of some of its sensors, that has nothing in common with what is known of the others.

        Raises:
            AlignmentError: one of a segment that carries no sensor here.
        """
        numbers = numbers_of(self, *part.segments)
        rotations, headings, covariance = self.rotations.copy(), self.headings.copy(), self.covariance.copy()
        rotations[numbers], headings[numbers] = part.rotations, wrapped(part.headings)
        rows = (4 * numbers[:, None] + np.arange(4)).reshape(-1)
        covariance[rows], covariance[:, rows] = 0.0, 0.0
        covariance[np.ix_(rows, rows)] = part.covariance
        return Alignment(self.segments, rotations, headings, covariance)

    def moved(self, error: FloatArray, covariance: FloatArray) -> Alignment:
        """Corrected by (4 k,) as of the covariance's coordinates."""
        parts = error.reshape(-1, 4)
        turned = self.rotations @ so3.quat_to_matrix(so3.exp(parts[:, :3]))
        return Alignment(self.segments, turned, wrapped(self.headings + parts[:, 3]), 0.5 * (covariance + covariance.T))


def yaw(angle: FloatArray | float) -> FloatArray:
    """(..., 3, 3) rotations about z by (...) radians."""
    return so3.quat_to_matrix(so3.exp(np.asarray(angle, float)[..., None] * _Z))


def wrapped(angle: FloatArray) -> FloatArray:
    """The same angles from -pi to pi."""
    result: FloatArray = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    return result


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """(..., 3) radians of (..., 3, 3) rotations."""
    return so3.log(so3.matrix_to_quat(rotations))


def mean_rotation(rotations: FloatArray) -> FloatArray:
    """(3, 3) the mean of (n, 3, 3): the rotation nearest to the sum of all (Moakher 2002, eq. 3.9)."""
    u, _, vt = np.linalg.svd(rotations.sum(axis=0))
    result: FloatArray = (u * np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])) @ vt
    return result


# ---------------------------------------------------------------------------------------------------------------------
# the pose


def pose_rotations(model: UpperBody, pose: Pose) -> FloatArray:
    """(12, 3, 3) orientations of all segments in a pose of somebody who faces x.

    ``n`` is the model's neutral pose: arms hanging, thumbs forward. ``t`` has the arms out to the sides, thumbs forward
    and palms down, raised by the clavicles in part.

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
    """(3 k, 3 k) radians squared by which people's segments are off a pose, each in its own frame.

    Joints are held to within ``joint_stddev`` radians per axis; what is off in a proximal joint moves all that hangs on
    it. The flesh turns each sensor besides by :data:`TISSUE_STDDEV`.

    Raises:
        AlignmentError: a segment that the model does not have.
    """
    unknown = [name for name in segments if name not in model.segment_names]
    if unknown:
        raise AlignmentError(f"no segment {', '.join(unknown)}")
    stddev = np.full(model.nv, joint_stddev)
    stddev[:3] = 0.0
    for number, name in enumerate(model.coordinate_names):
        if name.startswith(("lumbar", "thoracic")):  # of a trunk that is held as a whole
            stddev[number] *= np.sqrt(0.5)
    lines = model.linearise(_pose(model, pose), model.default_lengths())
    numbers = [model.segment_names.index(name) for name in segments]
    own = lines.posture.rotations[numbers].swapaxes(-1, -2) @ lines.rotation_jacobian[numbers]
    spread = own.reshape(-1, model.nv) * stddev
    result: FloatArray = spread @ spread.T + TISSUE_STDDEV**2 * np.eye(len(spread))
    return result


def still_periods(streams: Sequence[Stream], least: float = STILL_TIME) -> tuple[StillPeriod, ...]:
    """When all sensors were still for at least so many seconds."""
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
        # a bin without a sample says nothing, and nobody moves and stops within a tenth of a second
        with np.errstate(invalid="ignore"):
            still &= (samples == 0) | (squares / samples < STILL_RATE**2)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(np.int8)))
    found = []
    for first, last in edges.reshape(-1, 2):
        start, stop = begin + _BIN * first, begin + _BIN * last
        if stop - start >= least - 1e-9 and all(
            _turned(stream.between(start, stop)) < STILL_TURN for stream in streams
        ):
            found.append(StillPeriod(float(start), float(stop)))
    return tuple(found)


def _turned(stream: Stream) -> float:
    """Radians from the beginning to the end; infinite without samples."""
    if len(stream.stamps) < 2:
        return np.inf
    return float(np.linalg.norm(rotation_vectors(stream.rotations[0].T @ stream.rotations[-1])))


def pose_of(streams: Sequence[Stream], mountings: FloatArray, period: StillPeriod) -> Pose | None:
    """Which pose it was, by how steep the arms were; None if neither, or no arm carries a sensor.

    Args:
        streams: k sensors.
        mountings: (k, 3, 3) segment to sensor, as the sensors were meant to be put on.
        period: in which to look.
    """
    slopes = []
    for stream, mounting in zip(streams, mountings, strict=True):
        if stream.segment.startswith(("upper_arm", "forearm")):
            part = stream.between(period.begin, period.end)
            if len(part.stamps):
                slopes.append(float((mean_rotation(part.rotations) @ -mounting[:, 2])[2]))
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
        pose: (k, 3, 3) the segments of somebody who faces x, such as of :func:`pose_rotations`.
        covariance: (3 k, 3 k) by which people are off it, such as :func:`pose_covariance`.
        mountings: (k, 3, 3) segment to sensor, as the sensors were meant to be put on; None if anyhow.
        mounting_stddev: radians per axis by which they are off that.
        headings: (k,) radians, earth to world, where something else knows them, or None.
        heading_covariance: (k, k) of them. Sensors with magnetometers share a heading: a large common variance and a
            small own one.
        facing: radians, the person's heading in world.

    Returns:
        Without mountings and headings each heading is as good as any other, and its deviation says so.

    Raises:
        AlignmentError: shapes that do not belong together, or numbers that are not finite.
    """
    k = len(segments)
    for name, value, shape in (
        ("measured", measured, (k, 3, 3)),
        ("pose", pose, (k, 3, 3)),
        ("covariance", covariance, (3 * k, 3 * k)),
        ("mountings", mountings, (k, 3, 3)),
        ("headings", headings, (k,)),
        ("heading_covariance", heading_covariance, (k, k)),
    ):
        if value is not None and (value.shape != shape or not np.isfinite(value).all()):
            raise AlignmentError(f"alignment in a pose: {name} of shape {value.shape}, expected {shape} finite numbers")
    posed = yaw(facing) @ pose
    # nothing is known of a heading: uniform over a turn
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
        # as near to the known headings as what they share lets them be
        common = np.angle(np.exp(1j * (psi - prior)).mean())
        prior = prior + (common if known[0, 0] > (0.5 * np.pi) ** 2 else 0.0)
        psi = prior.copy()
    rotations: FloatArray = measured.swapaxes(-1, -2) @ yaw(psi).swapaxes(-1, -2) @ posed

    pose_information, heading_information = np.linalg.inv(covariance), np.linalg.inv(known)
    rows = np.arange(4 * k).reshape(k, 4)
    information = np.eye(4 * k)
    for _ in range(_STEPS):
        world = yaw(psi) @ measured @ rotations
        off = rotation_vectors(posed.swapaxes(-1, -2) @ world)
        away = None if mountings is None else rotation_vectors(mountings.swapaxes(-1, -2) @ rotations)
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
    """(3, 2) two directions square to a unit vector and to each other."""
    least = np.eye(3)[int(np.abs(axis).argmin())]
    one = np.cross(axis, least)
    one /= np.linalg.norm(one)
    return np.stack([one, np.cross(axis, one)], axis=-1)


def _tilted(axis: FloatArray, by: FloatArray) -> FloatArray:
    turned = axis + across(axis) @ by
    result: FloatArray = turned / np.linalg.norm(turned)
    return result


def _common(first: Stream, second: Stream) -> tuple[FloatArray, ...]:
    """Times; rotations and rates of both at the times of the slower one, where both are known."""
    ends = [one.stamps[[0, -1]] if len(one.stamps) else np.array([np.inf, -np.inf]) for one in (first, second)]
    begin, end = max(ends[0][0], ends[1][0]), min(ends[0][1], ends[1][1])
    slower = min((first, second), key=lambda one: len(one.between(begin, end).stamps))
    times = slower.stamps[(slower.stamps >= begin) & (slower.stamps <= end)]
    (r1, w1, known), (r2, w2, known2) = first.at(times), second.at(times)
    both = known & known2
    return times[both], r1[both], w1[both], r2[both], w2[both]


@dataclass(frozen=True, slots=True, eq=False)
class ElbowFit:
    """What the movement of an elbow told.

    Attributes:
        alignment: corrected.
        before: (5,) radians, standard deviations before: of two directions of the flexion axis in the upper arm's
            sensor, two of the pronation axis in the forearm's, and of the heading between both.
        after: (5,) the same with what the movement told.
        information: the movement's own, nats: half the logarithm of how much smaller the covariance became.
    """

    alignment: Alignment
    before: FloatArray
    after: FloatArray
    information: float


def align_by_elbow(alignment: Alignment, side: str, upper: Stream, lower: Stream) -> ElbowFit | None:
    """Correct two alignments and headings by any movement of the elbow between them (eq. 5).

    The most probable errors of both, starting from the alignment as the prior; the person's axes are off the model's by
    unknown constants of :data:`AXIS_OFF` besides. Where the movement tells little, little changes.

    Args:
        alignment: so far, such as of a pose.
        side: ``left`` or ``right``.
        upper: of the upper arm's sensor.
        lower: of the forearm's.

    Returns:
        None where the two did not move against each other, or were not seen together for a second.

    Raises:
        AlignmentError: no sensor on one of the segments.
    """
    numbers = numbers_of(alignment, f"upper_arm_{side}", f"forearm_{side}")
    axes = elbow_segment_axes(side)
    times, r1, w1, r2, w2 = _common(upper, lower)
    rows = (4 * numbers[:, None] + np.arange(4)).reshape(-1)
    prior = alignment.covariance[np.ix_(rows, rows)]
    if len(times) < 50 or np.ptp(times) < 1.0:
        return None
    rates = [(r @ w[..., None])[..., 0] for r, w in ((r1, w1), (r2, w2))]
    apart = float(alignment.headings[numbers[1]] - alignment.headings[numbers[0]])
    relative = np.linalg.norm(rates[0] - rates[1] @ yaw(apart).T, axis=1)
    if np.sqrt((relative**2).mean()) < _LEAST_TURNING:
        return None
    # the skin follows the bone's twist only in part
    twists = [
        np.abs(w @ alignment.rotations[number][:, 2]) for w, number in zip((w1, w2), numbers.tolist(), strict=True)
    ]
    scale = np.sqrt(
        _RATE_NOISE**2 + (_RATE_SHARE * relative) ** 2 + _TWIST_SHARE**2 * (twists[0] ** 2 + twists[1] ** 2)
    )

    def off_plane(y: FloatArray) -> FloatArray:
        """(n,) eq. 5, y: errors of both sensors (4 each), of the model's axes (2 each), and the flesh's turn."""
        worlds, turned = [], []
        for place, rotations in enumerate((r1, r2)):
            number, error = int(numbers[place]), y[4 * place : 4 * place + 4]
            turn = yaw(alignment.headings[number] + error[3] + place * y[12])
            held = alignment.rotations[number] @ so3.quat_to_matrix(so3.exp(error[:3]))
            axis = held @ _tilted(axes[place], y[8 + 2 * place : 10 + 2 * place])
            worlds.append(rotations @ axis @ turn.T)
            turned.append(rates[place] @ turn.T)
        normal = np.cross(*worlds)
        size = np.maximum(np.linalg.norm(normal, axis=1), 0.3)
        result: FloatArray = ((turned[0] - turned[1]) * normal).sum(axis=1) / size / scale
        return result

    whole = np.zeros((13, 13))
    whole[:8, :8] = prior
    whole[8:12, 8:12] = (AXIS_OFF**2 + AXIS_FLOOR**2) * np.eye(4)
    whole[12, 12] = FLESH_TURN**2
    white = np.linalg.inv(np.linalg.cholesky(whole))
    y, worth = np.zeros(13), np.sqrt(_REPETITIONS / len(times))
    found = None
    for _ in range(3):
        # a sample counts as often as what it leaves is independent of the one before, and as its size says

        def residuals(y: FloatArray, worth: float = worth) -> FloatArray:
            return np.concatenate([worth * _huber(off_plane(y)), white @ y])

        starts = [y]
        if found is None:  # the valley between the heading and the axes can be long
            starts = [y + np.eye(13)[7] * turn for turn in (0.0, -0.4, 0.4)]
        found = min((least_squares(residuals, start) for start in starts), key=lambda each: float(each.cost))
        y = found.x
        left = off_plane(y)
        spread = max(1.4826 * float(np.median(np.abs(left))), 0.3)
        worth = 1.0 / (spread * np.sqrt(max(_correlated(_huber(left)), len(left) / _REPETITIONS)))
    assert found is not None
    posterior = np.linalg.inv(found.jac.T @ found.jac)[:8, :8]
    gain = alignment.covariance[:, rows] @ np.linalg.inv(prior)
    covariance = alignment.covariance - gain @ (prior - posterior) @ gain.T
    corrected = alignment.moved(np.asarray(gain @ y[:8]), np.asarray(covariance))
    before, after = (_axes_stddev(a, numbers, axes) for a in (alignment, corrected))
    information = 0.5 * float(np.linalg.slogdet(prior)[1] - np.linalg.slogdet(posterior)[1])
    return ElbowFit(corrected, before, after, information)


def _huber(values: FloatArray, bound: float = 2.0) -> FloatArray:
    """Signed square roots of twice Huber's loss."""
    size = np.abs(values)
    result: FloatArray = np.sign(values) * np.where(
        size <= bound, size, np.sqrt(np.maximum(2.0 * bound * size - bound**2, 0.0))
    )
    return result


def _correlated(values: FloatArray) -> float:
    """How many samples make an independent one: the integral of the autocorrelation up to where it vanishes."""
    centred = values - values.mean()
    power = np.correlate(centred, centred, "full")[len(values) - 1 :]
    power = power / max(float(power[0]), 1e-12)
    gone = np.flatnonzero(power <= 0.0)
    return float(1.0 + 2.0 * power[1 : gone[0] if len(gone) else len(power)].sum())


def _axes_stddev(alignment: Alignment, numbers: IntArray, axes: tuple[FloatArray, FloatArray]) -> FloatArray:
    by = np.zeros((5, len(alignment.covariance)))
    for place, number in enumerate(numbers):
        by[2 * place : 2 * place + 2, 4 * number : 4 * number + 3] = -across(axes[place]).T @ so3.skew(axes[place])
        by[4, 4 * number + 3] = 2.0 * place - 1.0
    result: FloatArray = np.sqrt((by @ alignment.covariance * by).sum(axis=1))
    return result


def elbow_segment_axes(side: str) -> tuple[FloatArray, FloatArray]:
    """(3,) flexion in the upper arm's frame and (3,) pronation in the forearm's, of a side, as ``UpperBody`` has them.

    Raises:
        AlignmentError: neither ``left`` nor ``right``.
    """
    if side not in ("left", "right"):
        raise AlignmentError(f"side {side!r}: expected 'left' or 'right'")
    return np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, -1.0 if side == "left" else 1.0])


def numbers_of(alignment: Alignment, *segments: str) -> IntArray:
    """Where an alignment has segments.

    Raises:
        AlignmentError: one of them carries no sensor.
    """
    missing = [name for name in segments if name not in alignment.segments]
    if missing:
        raise AlignmentError(f"no sensor on {', '.join(missing)}")
    return np.array([alignment.segments.index(name) for name in segments], dtype=np.intp)

"""Compares a recorded person with the truth by the metrics of ``metrics``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from body_tracking.calibration.clock import correlate_clocks
from body_tracking.core.skeleton import (
    JOINT_NAMES,
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    Joint,
)
from body_tracking.evaluation.metrics import (
    Alignment,
    AngleErrors,
    Curve,
    JointErrors,
    LengthErrors,
    MetricsError,
    PoseErrors,
    Trajectory,
    align,
    angle_errors,
    find_delay,
    grid,
    jitter,
    joint_errors,
    known,
    length_errors,
    off_track,
    pose_errors,
)
from body_tracking.evaluation.reading import AngleSeries, EvaluationError, Recorded, true_angles
from body_tracking.kinematics.positional import ANGLE_NAMES, angles_over_time

AS_IT_IS, ALIGNED = "as it is", "aligned"
MAX_GAP = 0.15
"""Seconds between samples above which there is a gap."""
BEYOND = 0.15
"""Distance from the truth above which a joint is off track, metres."""
WINDOW = 0.5
"""Half width of the search for the delay, seconds."""

_SHOWN = np.broadcast_to(0.01**2 * np.eye(3), (N_JOINTS, 3, 3))
"""True angles that 10 mm of noise in every joint would make unknown, e.g. the plane of a hanging arm, are ignored."""
_COARSE_RATE, _COARSE_WINDOW = 30.0, 1.5


@dataclass(frozen=True, slots=True, eq=False)
class AngleComparison:
    """Angles at the same instants.

    Attributes:
        names: m names.
        times: (n,) s on the truth's clock.
        found: (n, m) radians.
        true: (n, m) radians; NaN where the true pose does not determine the angle.
        stddev: (n, m) radians, infinity if not stated.
        errors: of ``found``.
    """

    names: tuple[str, ...]
    times: FloatArray
    found: FloatArray
    true: FloatArray
    stddev: FloatArray
    errors: AngleErrors


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Estimate and truth under one alignment.

    Attributes:
        name: :data:`AS_IT_IS` or :data:`ALIGNED`.
        alignment: applied to the estimate.
        times: (n,) s on the truth's clock.
        found: (n, 25, 3) metres.
        true: (n, 25, 3) metres.
        joints: errors of ``found``.
        off_track: (25,) share of the truth's frames after the first estimate; NaN for joints without estimates.
        positional: the angles of ``kinematics.positional`` of both skeletons.
        named: the estimate's own angles that the truth also has; None if there are none.
    """

    name: str
    alignment: Alignment
    times: FloatArray
    found: FloatArray
    true: FloatArray
    joints: JointErrors
    off_track: FloatArray
    positional: AngleComparison
    named: AngleComparison | None


@dataclass(frozen=True, slots=True, eq=False)
class SensorErrors:
    """A sensor's calibration against the truth over time.

    Attributes:
        sensor: its name.
        times: (n,) s at which poses were published.
        poses: errors of these poses.
        clock_times: (c,) s.
        clock: (c,) s, estimated minus true offset.
    """

    sensor: str
    times: FloatArray
    poses: PoseErrors
    clock_times: FloatArray
    clock: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Result of an evaluation.

    Attributes:
        estimate: the evaluated recording.
        truth: its reference.
        span: (first, last) s on the truth's clock, covered by both.
        delay: s by which the estimate lags the truth; NaN if unobservable.
        comparisons: as it is (if clock and frame are shared), and aligned.
        jitter: (25,) metres.
        lengths: of the bones.
        calibration: of each sensor except the one that defines the world frame.
        notes: omissions, one per line.
    """

    estimate: Recorded
    truth: Recorded
    span: tuple[float, float]
    delay: float
    comparisons: tuple[Comparison, ...]
    jitter: FloatArray
    lengths: LengthErrors
    calibration: tuple[SensorErrors, ...]
    notes: tuple[str, ...]


def evaluate(
    estimate: Recorded,
    truth: Recorded,
    own_clock: bool = False,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Compare an estimate with the truth.

    Args:
        estimate: of one person.
        truth: of the same person.
        own_clock: whether the truth has a clock and a frame of its own: then compare aligned only.
        progress: called with the completed share, from 0 to 1.

    Raises:
        EvaluationError: no joint is known in both, no overlap in time, or too little to compare.
    """
    done = progress or (lambda share: None)
    notes = _notes(estimate, truth)
    if estimate.frame_id != truth.frame_id and not own_clock:
        notes.append(f"{AS_IT_IS!r} compares {estimate.frame_id!r} with {truth.frame_id!r}, which may be other frames")
    zero_ns = int(truth.stamps_ns[0])
    whole = Trajectory(
        estimate.seconds(int(estimate.stamps_ns[0]) if own_clock else zero_ns),
        estimate.positions,
        estimate.covariances,
    )
    curve = Curve(truth.seconds(zero_ns), truth.positions, MAX_GAP)
    if np.isnan(curve.span).any():
        raise EvaluationError(f"{truth.source}: no joint is known twice within {MAX_GAP:g} s")
    around = _own_clock_offset(whole, curve, estimate, truth) if own_clock else 0.0
    span = _span(whole.times - around, curve.span, estimate, truth)
    done(0.1)
    delay = find_delay(whole, curve, WINDOW, around)
    if np.isnan(delay) and own_clock:
        raise EvaluationError(
            f"{estimate.source} and {truth.source} do not show the same movement, or hardly any: their frames cannot "
            "be matched"
        )
    if np.isnan(delay):
        notes.append(f"no delay within {WINDOW:g} s could be found (still, or another clock?): aligned in space only")
    done(0.3)
    alignments = {} if own_clock else {AS_IT_IS: Alignment(0.0, np.eye(3), np.zeros(3))}
    try:
        alignments[ALIGNED] = align(whole, curve, 0.0 if np.isnan(delay) else delay)
    except MetricsError as error:
        if own_clock:
            raise EvaluationError(f"{estimate.source} and {truth.source}: {error}") from error
        notes.append(f"not aligned: {error}")
    mine = estimate.angles
    truly = truth.angles if mine is None else true_angles(mine.names, truth.angles, truth.coordinates)
    if mine is not None and truly is not None and mine.names != truly.names:
        notes.append("estimate and truth have different sets of angles: those with common names are compared")
    comparisons = []
    for number, (name, alignment) in enumerate(alignments.items()):
        comparisons.append(_compare(name, alignment, whole, curve, estimate, truth, truly, own_clock))
        done(0.3 + 0.7 * (number + 1) / len(alignments))
    last = comparisons[-1]
    moved = last.alignment.apply(whole)
    true = curve.at(moved.times)
    return Evaluation(
        estimate,
        truth,
        span,
        float("nan") if own_clock else delay,
        tuple(comparisons),
        jitter(moved.times, moved.positions, true),
        length_errors(moved.positions, true),
        () if own_clock else _calibration(estimate, truth, zero_ns),
        tuple(notes),
    )


def _notes(estimate: Recorded, truth: Recorded) -> list[str]:
    """Notes on data that cannot be compared.

    Raises:
        EvaluationError: no joint is known in both.
    """
    mine, theirs = estimate.joints, truth.joints
    if not (mine & theirs).any():
        raise EvaluationError(
            f"no joint is known in both: {estimate.source} knows {_joints(mine)}, {truth.source} {_joints(theirs)}"
        )
    notes = list(dict.fromkeys((*estimate.warnings, *truth.warnings)))
    for only, where in ((mine & ~theirs, "estimate"), (theirs & ~mine, "truth")):
        if only.any():
            notes.append(f"not compared, since only the {where} has these joints: {_joints(only)}")
    for each in (estimate, truth):
        missing = ~known(each.positions[:, mine & theirs])
        if missing.any():
            frames = f"{missing.any(axis=1).sum()} of {len(missing)} frames"
            notes.append(f"{each.source}: {missing.mean():.1%} of the joints' positions are unknown, in {frames}")
    return notes


def _joints(which: BoolArray) -> str:
    return ", ".join(JOINT_NAMES[joint] for joint in np.flatnonzero(which)) or "none"


def _span(times: FloatArray, truth: tuple[float, float], estimate: Recorded, true: Recorded) -> tuple[float, float]:
    """The common time span, s on the truth's clock."""
    first, last = max(float(times[0]), truth[0]), min(float(times[-1]), truth[1])
    if not last > first:
        spans = (
            f"{each.source} from {each.stamps_ns[0] / NANOSECONDS:.3f} to {each.stamps_ns[-1] / NANOSECONDS:.3f} s"
            for each in (estimate, true)
        )
        raise EvaluationError(
            f"estimate and truth do not overlap in time: {', '.join(spans)}; is it another recording, or another "
            "clock (--own-clock)?"
        )
    return first, last


def _own_clock_offset(whole: Trajectory, curve: Curve, estimate: Recorded, truth: Recorded) -> float:
    """Estimate's time minus truth's, each from its first frame, by correlation of the joints' speeds.

    Speeds need no common frame. At least half of the shorter recording must overlap.
    """
    first, last = curve.span
    times = grid(first, last, _COARSE_RATE)
    length = float(whole.times[-1] - whole.times[0])
    least = 0.5 * min(length, last - first)
    guesses = np.arange(first - last + least, length - least + _COARSE_WINDOW, _COARSE_WINDOW)
    true = (times, curve.at(times))
    found = [
        each
        for guess in guesses
        if (each := correlate_clocks(true, (whole.times, whole.positions), float(guess), _COARSE_WINDOW)) is not None
    ]
    best = max(found, key=lambda each: each.correlation, default=None)
    if best is None or best.correlation < 0.5:
        found_best = "none" if best is None else f"{best.correlation:.2f}"
        raise EvaluationError(
            f"{estimate.source} and {truth.source} do not show the same movement: best correlation of their joints' "
            f"speeds at any shift in time {found_best}, expected at least 0.5 over at least 2 s"
        )
    return best.offset


def _compare(
    name: str,
    alignment: Alignment,
    whole: Trajectory,
    curve: Curve,
    estimate: Recorded,
    truth: Recorded,
    true_angles: AngleSeries | None,
    own_clock: bool,
) -> Comparison:
    moved = alignment.apply(whole)
    first, last = max(moved.times[0], curve.span[0]), min(moved.times[-1], curve.span[1])
    inside = (moved.times >= first) & (moved.times <= last)
    if inside.sum() < 2:
        raise EvaluationError(
            f"{estimate.source} has {inside.sum()} frames from {first:.3f} to {last:.3f} s after the truth of "
            f"{truth.source} begins, which is what both cover; at least 2 are needed"
        )
    own = Trajectory(
        moved.times[inside],
        moved.positions[inside],
        None if moved.covariances is None else moved.covariances[inside],
    )
    compared = own if name == AS_IT_IS else moved.at(grid(first, last), MAX_GAP)
    true = curve.at(compared.times)
    errors = joint_errors(compared.positions, true, compared.covariances)
    if not errors.frames.any():
        raise EvaluationError(
            f"no joint is known in both at any time from {first:.3f} to {last:.3f} s after the truth begins: "
            f"{estimate.source} knows {known(own.positions).mean():.0%} of the positions there, "
            f"{truth.source} {known(curve.at(own.times)).mean():.0%}"
        )
    # After the first estimate every frame of the truth counts, including frames without estimate; after the last
    # estimate only if both share a clock.
    all_times = truth.seconds(int(truth.stamps_ns[0]))
    lost = (all_times > last + MAX_GAP) & (not own_clock)
    counted = all_times[(all_times >= moved.times[0]) & ((all_times <= last) | lost)]
    off = off_track(moved.at(counted, MAX_GAP).positions, curve.at(counted), BEYOND)
    return Comparison(
        name,
        alignment,
        compared.times,
        compared.positions,
        true,
        errors,
        np.where(estimate.joints, off, np.nan),
        _positional(own, curve),
        _named(estimate, true_angles, whole, moved, int(truth.stamps_ns[0])),
    )


def _positional(found: Trajectory, curve: Curve) -> AngleComparison:
    """The angles of both skeletons at the estimate's instants."""
    mine, stddev = angles_over_time(found.positions, found.covariances)
    positions = curve.at(found.times)
    true, shown = angles_over_time(positions, np.broadcast_to(_SHOWN, (len(positions), *_SHOWN.shape)))
    true = np.where(np.isfinite(shown), true, np.nan)
    return AngleComparison(ANGLE_NAMES, found.times, mine, true, stddev, angle_errors(mine, true, stddev))


def _named(
    estimate: Recorded,
    theirs: AngleSeries | None,
    whole: Trajectory,
    moved: Trajectory,
    zero_ns: int,
) -> AngleComparison | None:
    """The angles with common names; the alignment does not transform frame-dependent angles."""
    mine = estimate.angles
    if mine is None or theirs is None:
        return None
    names = tuple(name for name in mine.names if name in theirs.names)
    if not names:
        return None
    shift = moved.times[0] - whole.times[0]
    times = (mine.stamps_ns - estimate.stamps_ns[0]) / NANOSECONDS + whole.times[0] + shift
    found, stddev = (values[:, [mine.names.index(name) for name in names]] for values in (mine.known, mine.stddev))
    position = theirs.known[:, [theirs.names.index(name) for name in names]]
    true = Curve((theirs.stamps_ns - zero_ns) / NANOSECONDS, _unwrapped(position), MAX_GAP).at(times)
    return AngleComparison(names, times, found, true, stddev, angle_errors(found, true, stddev))


def _unwrapped(angles: FloatArray) -> FloatArray:
    """(n, m) angles without jumps by full turns; NaN stays NaN."""
    unwrapped = np.full_like(angles, np.nan)
    for column in range(angles.shape[1]):
        there = np.isfinite(angles[:, column])
        unwrapped[there, column] = np.unwrap(angles[there, column])
    return unwrapped


def _calibration(estimate: Recorded, truth: Recorded, zero_ns: int) -> tuple[SensorErrors, ...]:
    """Errors of the sensors known in both, without the one that defines the world frame."""
    base = truth.positions[:, Joint.SPINE_BASE if truth.joints[Joint.SPINE_BASE] else int(truth.joints.argmax())]
    place = base[known(base)].mean(axis=0)
    found = []
    for sensor in estimate.sensors.keys() & truth.sensors.keys():
        mine, true = estimate.sensors[sensor], truth.sensors[sensor]
        errors = pose_errors(mine.rotations, mine.translations, true.rotations[-1], true.translations[-1], place)
        if not errors.displacement.max() > 1e-6:
            continue
        clock_times = (mine.clock_stamps_ns - zero_ns) / NANOSECONDS
        true_times = (true.clock_stamps_ns - zero_ns) / NANOSECONDS
        clock = np.full(len(clock_times), np.nan)
        if len(true_times):
            clock = mine.clock_offsets - np.interp(clock_times, true_times, true.clock_offsets)
        times = np.maximum((mine.pose_stamps_ns - zero_ns) / NANOSECONDS, 0.0)
        found.append(SensorErrors(sensor, times, errors, clock_times, clock))
    return tuple(sorted(found, key=lambda each: each.sensor))

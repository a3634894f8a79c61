"""The joint angles in a recording: read, compared with the truth where it is there, and put into a table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from body_tracking import graph
from body_tracking.cdr import decode_skeletons
from body_tracking.errors import BodyTrackingError
from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.conventions import CONVENTIONS, angles_of, convention
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.base import JOINT_STATE, POINT_CLOUD, MessageError, to_nanoseconds
from body_tracking.messages.model import coordinates_to_configuration
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, deserialize
from body_tracking.skeleton import NANOSECONDS, FloatArray, IntArray, Skeleton

_PREFIX, _SUFFIX = "/humans/bodies/", "/joint_states"
_MATCH_NS = NANOSECONDS // 50
_EXACT, _AMPLIFIED = 1e-6, 10.0
"""Radians: so well known is the body model's true pose; an angle that makes more than ten times of it counts not."""


class EvaluationError(BodyTrackingError):
    """A recording does not hold what is to be evaluated."""


@dataclass(frozen=True, slots=True, eq=False)
class AngleSeries:
    """Angles over time.

    Attributes:
        stamps_ns: (n,) capture times, nanoseconds.
        names: m names, without the body's id.
        position: (n, m) radians.
        stddev: (n, m) radians; infinity where unknown; zero for the truth.
    """

    stamps_ns: IntArray
    names: tuple[str, ...]
    position: FloatArray
    stddev: FloatArray

    @property
    def known(self) -> FloatArray:
        """(n, m) the angles, NaN where nothing observes them."""
        return np.where(np.isfinite(self.stddev), self.position, np.nan)


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """What a recording holds of one person.

    Attributes:
        bag: the folder or file.
        body: the person's id.
        angles: what was measured.
        skeletons: filtered, in time order; may be empty.
        true_angles: None where the recording holds no truth.
        true_skeletons: in time order; may be empty.
    """

    bag: Path
    body: str
    angles: AngleSeries
    skeletons: tuple[Skeleton, ...]
    true_angles: AngleSeries | None
    true_skeletons: tuple[Skeleton, ...]

    @property
    def duration(self) -> float:
        """Seconds from the first angle to the last."""
        return float(self.angles.stamps_ns[-1] - self.angles.stamps_ns[0]) / NANOSECONDS


@dataclass(frozen=True, slots=True)
class AngleSummary:
    """One angle over a recording; degrees, NaN where there is nothing to say.

    Attributes:
        name: of the angle.
        min: over the frames in which it is known.
        max: likewise.
        last: in the last frame in which it is known.
        stddev: median stated standard deviation over all frames; infinity where it is mostly unknown.
        known: share of the frames in which it is known.
        true_min: of the truth in the same frames.
        true_max: likewise.
        rms_error: against the truth, over the frames in which it is known.
        max_error: likewise, the largest.
        within_2_stddev: share of these frames in which the truth lies within two stated standard deviations.
    """

    name: str
    min: float
    max: float
    last: float
    stddev: float
    known: float
    true_min: float
    true_max: float
    rms_error: float
    max_error: float
    within_2_stddev: float


def read(path: Path, body: str | None = None, truth: Path | None = None) -> Tracked:
    """Read the angles of a person, and all that helps to show them, from a bag.

    Args:
        path: a bag folder or an mcap file.
        body: the person's id; the first one in the bag where None.
        truth: the bag with the truth; this one where None.

    Raises:
        BagError: no such bag, or nothing of it can be read.
        EvaluationError: it holds no joint angles, or none of this person.
    """
    with RigReader(path) as bag:
        if not bodies(bag):
            raise EvaluationError(f"{path}: holds no joint angles ({_PREFIX}<id>{_SUFFIX}); make some with replay")
        body, angles = read_angles(bag, body)
        skeletons = read_skeletons(bag, graph.FILTERED)
    with RigReader(truth or path) as bag:
        own, coordinates = (
            read_joint_states(bag, topic, of) for topic, of in ((graph.TRUE_ANGLES, body), (graph.TRUE_MODEL_STATE, ""))
        )
        if truth is not None and own is None and coordinates is None:
            raise EvaluationError(f"{truth}: holds no truth ({graph.TRUE_ANGLES}); recordings of simulate do")
        return Tracked(
            bag=Path(path),
            body=body,
            angles=angles,
            skeletons=skeletons,
            true_angles=true_angles(angles.names, own, coordinates),
            true_skeletons=read_skeletons(bag, graph.TRUE_SKELETON),
        )


def true_angles(names: tuple[str, ...], own: AngleSeries | None, coordinates: AngleSeries | None) -> AngleSeries | None:
    """The truth in the convention of the angles that are judged.

    Args:
        names: of the judged angles.
        own: the true angles that a recording holds, of ``kinematics.positional``; None for none.
        coordinates: the true coordinates of the body model; None for none.

    Returns:
        The angles of a convention of the model, made of the coordinates, where these are there; ``own`` otherwise.
    """
    if coordinates is None:
        return own
    model = UpperBody()
    of_names = {convention(name, model).names: name for name in CONVENTIONS}
    if names not in of_names or coordinates.names != model.coordinate_names:
        return own
    exact = _EXACT**2 * np.eye(2 * model.nv)
    lengths = model.default_lengths()  # no angle depends on them
    rates = np.zeros(model.nv)
    series: list[JointAngles] = []
    for stamp_ns, tangent in zip(coordinates.stamps_ns, coordinates.position, strict=True):
        q, _ = coordinates_to_configuration(tangent, rates, model)
        estimate = ModelEstimate(int(stamp_ns), "", 0, q, rates, exact, lengths, np.zeros_like(lengths))
        series.append(angles_of(estimate, model, of_names[names], series[-1] if series else None))
    stddev = np.stack([each.position_stddev for each in series])
    return AngleSeries(
        coordinates.stamps_ns,
        names,
        np.stack([each.position for each in series]),
        np.where(stddev > _AMPLIFIED * _EXACT, np.inf, stddev),
    )


def bodies(bag: BagReader) -> tuple[str, ...]:
    """The ids of the people whose joint angles a bag holds, sorted."""
    return tuple(
        sorted(
            topic.removeprefix(_PREFIX).removesuffix(_SUFFIX)
            for topic, info in bag.topics.items()
            if topic.startswith(_PREFIX) and topic.endswith(_SUFFIX) and info.type_name == JOINT_STATE and info.count
        )
    )


def read_angles(bag: BagReader, body: str | None = None) -> tuple[str, AngleSeries]:
    """A person's id and measured angles.

    Args:
        bag: with the joint angles of at least one of :func:`bodies`.
        body: the person's id; the first one in the bag where None.

    Raises:
        EvaluationError: the bag holds no joint angles of this person, or none that can be read.
    """
    found = bodies(bag)
    if body is not None and body not in found:
        raise EvaluationError(f"{bag.path}: holds no joint angles of {body!r} (there: {', '.join(found) or 'none'})")
    body = body or found[0]
    values = read_joint_states(bag, graph.joint_states_topic(body), body)
    if values is None:
        raise EvaluationError(f"{bag.path}: every message of {graph.joint_states_topic(body)} is malformed")
    return body, _with_stddev(values, read_joint_states(bag, graph.joint_states_stddev_topic(body), body))


def read_joint_states(bag: BagReader, topic: str, body: str) -> AngleSeries | None:
    """A topic's positions as a series in time order; frames with other names than the first are left out.

    Returns:
        With standard deviations of zero and names without the body's id; None where there is no such message.
    """
    if topic not in bag.topics or bag.topics[topic].type_name != JOINT_STATE:
        return None
    names: tuple[str, ...] = ()
    rows: dict[int, FloatArray] = {}
    for raw in bag.messages([topic]):
        message = deserialize(JOINT_STATE, raw.cdr)
        names = names or tuple(message.name)
        if tuple(message.name) == names and len(message.position) == len(names):
            rows[to_nanoseconds(message.header.stamp)] = np.array(message.position, dtype=np.float64)
    if not rows:
        return None
    stamps = sorted(rows)
    position = np.array([rows[stamp] for stamp in stamps])
    short = tuple(name.removesuffix(f"_{body}") for name in names)
    return AngleSeries(np.array(stamps, dtype=np.int64), short, position, np.zeros_like(position))


def _with_stddev(values: AngleSeries, deviations: AngleSeries | None) -> AngleSeries:
    """Values with the deviations of the same stamp; infinity where there is none."""
    stddev = np.full_like(values.position, np.inf)
    if deviations is not None and deviations.names == values.names:
        _, here, there = np.intersect1d(values.stamps_ns, deviations.stamps_ns, return_indices=True)
        stddev[here] = deviations.position[there]
    stddev[~np.isfinite(values.position)] = np.inf
    return AngleSeries(values.stamps_ns, values.names, values.position, stddev)


def read_skeletons(bag: BagReader, topic: str) -> tuple[Skeleton, ...]:
    """The first body of each of a topic's messages in time order; none where the topic is missing or holds others."""
    skeletons = {everybody[0].stamp_ns: everybody[0] for everybody in _read_frames(bag, topic)}
    return tuple(skeletons[stamp] for stamp in sorted(skeletons))


def most_people(bag: BagReader, topic: str) -> int:
    """The largest number of bodies in one of a topic's messages."""
    return max((len(everybody) for everybody in _read_frames(bag, topic)), default=0)


def _read_frames(bag: BagReader, topic: str) -> Iterator[tuple[Skeleton, ...]]:
    """The bodies of each message, at least one; none where the topic is missing or holds others."""
    if topic not in bag.topics or bag.topics[topic].type_name != POINT_CLOUD:
        return
    for raw in bag.messages([topic]):
        try:
            yield decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
        except MessageError:
            continue  # a damaged frame is not shown


def nearest(stamps_ns: IntArray, wanted_ns: IntArray, within_ns: int = _MATCH_NS) -> IntArray:
    """Index of the nearest of (n,) sorted stamps for each of (m,) wanted ones; -1 where none is near enough."""
    after = np.clip(np.searchsorted(stamps_ns, wanted_ns), 1, max(len(stamps_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps_ns) - 1)
    closer = np.abs(stamps_ns[after] - wanted_ns) < np.abs(stamps_ns[before] - wanted_ns)
    index = np.where(closer, after, before)
    result: IntArray = np.where(np.abs(stamps_ns[index] - wanted_ns) <= within_ns, index, -1)
    return result


def true_at(angles: AngleSeries, truth: AngleSeries | None) -> FloatArray:
    """(n, m) the truth at the stamps of what was measured, or within 20 ms; NaN where there is none."""
    true = np.full_like(angles.position, np.nan)
    if truth is not None:
        matches = nearest(truth.stamps_ns, angles.stamps_ns)
        for column, name in enumerate(angles.names):
            if name in truth.names:
                true[:, column] = np.where(matches >= 0, truth.known[matches, truth.names.index(name)], np.nan)
    return true


def summaries(angles: AngleSeries, truth: AngleSeries | None = None) -> tuple[AngleSummary, ...]:
    """A summary per angle.

    Args:
        angles: what was measured.
        truth: what was true, at any stamps within 20 ms of the measured ones.
    """
    true = true_at(angles, truth)
    errors = (angles.known - true + np.pi) % (2.0 * np.pi) - np.pi
    result = []
    for column, name in enumerate(angles.names):
        values, stddev = np.degrees(angles.known[:, column]), np.degrees(angles.stddev[:, column])
        known, error = np.isfinite(values), np.degrees(errors[:, column])
        values, compared = values[known], np.isfinite(error)
        right = np.degrees(true[compared, column])
        nothing = float("nan")
        result.append(
            AngleSummary(
                name=name,
                min=float(values.min()) if len(values) else nothing,
                max=float(values.max()) if len(values) else nothing,
                last=float(values[-1]) if len(values) else nothing,
                stddev=float(np.median(stddev)),
                known=float(known.mean()),
                true_min=float(right.min()) if len(right) else nothing,
                true_max=float(right.max()) if len(right) else nothing,
                rms_error=float(np.sqrt(np.mean(error[compared] ** 2))) if compared.any() else nothing,
                max_error=float(np.abs(error[compared]).max()) if compared.any() else nothing,
                within_2_stddev=(
                    float((np.abs(error) <= 2.0 * stddev)[compared].mean()) if compared.any() else nothing
                ),
            )
        )
    return tuple(result)


def table(rows: tuple[AngleSummary, ...]) -> str:
    """The summaries for a terminal, in degrees; the columns of the truth only where there is one."""
    with_truth = any(np.isfinite(row.rms_error) for row in rows)
    width = max(len(row.name) for row in rows)
    header = f"{'angle (deg)':<{width}} {'min':>8} {'max':>8} {'final':>8} {'stddev':>8} {'known':>7}"
    if with_truth:
        header += f" {'true min':>9} {'true max':>8} {'rms err':>8} {'max err':>8} {'in 2 sd':>8}"
    lines = [header, "-" * len(header)]
    for row in rows:
        line = f"{row.name:<{width}}" + "".join(
            f" {_number(value):>8}" for value in (row.min, row.max, row.last, row.stddev)
        )
        line += f" {row.known:>7.0%}"
        if with_truth:
            share = "-" if np.isnan(row.within_2_stddev) else f"{row.within_2_stddev:.0%}"
            line += f" {_number(row.true_min):>9} {_number(row.true_max):>8}"
            line += f" {_number(row.rms_error):>8} {_number(row.max_error):>8} {share:>8}"
        lines.append(line)
    return "\n".join(lines)


def _number(value: float) -> str:
    return "-" if np.isnan(value) else "inf" if np.isinf(value) else f"{value:.1f}"

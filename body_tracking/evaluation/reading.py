"""Reads a person's estimated and true skeletons, joint angles and calibration from recordings."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import JOINT_STATE, POINT_CLOUD, TIME_REFERENCE, TRANSFORM
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray, Skeleton
from body_tracking.evaluation.plug_in_gait import read_measurements, read_plug_in_gait
from body_tracking.kinematics.conventions import CONVENTIONS, angles_of, convention
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.calibration import time_reference_to_clock, transform_to_pose
from body_tracking.messages.cdr import decode_skeletons, stamp_of
from body_tracking.messages.skeletons import cloud_to_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BagReader, RawMessage, deserialize

_MATCH_NS = NANOSECONDS // 50
_RENAMED = {"trunk_lateral_lean": "trunk_lateral_flexion", "trunk_axial_lean": "trunk_axial_rotation"}
"""Former names, which the shipped recordings have."""
_IN_EVERY_CONVENTION: Final = ("elbow_flexion_left", "elbow_flexion_right")
"""Positional angles that are the same in every convention that has their names. The trunk flexion of the others is
against the pelvis, not the vertical; ISB's shoulder elevation has the other sign."""
_EXACT, _AMPLIFIED = 1e-6, 10.0
"""Assumed error of the true pose, radians; true angles that amplify it by more than the factor are ignored."""


class EvaluationError(BodyTrackingError):
    """Raised when a recording lacks the data to evaluate."""


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
        """(n, m) the angles, NaN where unobserved."""
        return np.where(np.isfinite(self.stddev), self.position, np.nan)

    def only(self, names: tuple[str, ...]) -> AngleSeries:
        """The series of the named angles."""
        columns = [self.names.index(name) for name in names]
        return AngleSeries(self.stamps_ns, names, self.position[:, columns], self.stddev[:, columns])


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """One person in a recording.

    Attributes:
        bag: the folder or file.
        body: the person's id.
        angles: estimated.
        skeletons: filtered, in time order; may be empty.
        true_angles: None if the recording has no truth.
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
        """Seconds from the first to the last angle."""
        return float(self.angles.stamps_ns[-1] - self.angles.stamps_ns[0]) / NANOSECONDS


@dataclass(frozen=True, slots=True, eq=False)
class SensorClaims:
    """Published poses and clock offsets of one sensor over time; stamps in nanoseconds of the reference clock.

    Attributes:
        pose_stamps_ns: (n,) start of each pose's validity.
        rotations: (n, 3, 3) sensor to world.
        translations: (n, 3) metres.
        clock_stamps_ns: (c,).
        clock_offsets: (c,) s, sensor clock minus reference clock.
    """

    pose_stamps_ns: IntArray
    rotations: FloatArray
    translations: FloatArray
    clock_stamps_ns: IntArray
    clock_offsets: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Recorded:
    """Skeletons, angles and calibration of one person over time: an estimate, or the truth.

    Attributes:
        source: the bag or file.
        topic: of the skeletons; empty for a file without topics.
        frame_id: of the positions.
        stamps_ns: (n,) capture times, increasing, nanoseconds.
        positions: (n, 25, 3) metres, NaN where unknown.
        covariances: (n, 25, 3, 3) square metres, NaN where unknown; None if not stated.
        angles: None if there are none.
        sensors: calibration by sensor.
        coordinates: of ``kinematics.upper_body``, as in ``/filtered/model_state``; None if there are none.
        warnings: problems of the file, one per line.
    """

    source: Path
    topic: str
    frame_id: str
    stamps_ns: IntArray
    positions: FloatArray
    covariances: FloatArray | None = None
    angles: AngleSeries | None = None
    sensors: Mapping[str, SensorClaims] = field(default_factory=dict)
    coordinates: AngleSeries | None = None
    warnings: tuple[str, ...] = ()

    @property
    def joints(self) -> BoolArray:
        """(25,) joints known in any frame."""
        return np.asarray(np.isfinite(self.positions).all(axis=-1).any(axis=0))

    def seconds(self, zero_ns: int) -> FloatArray:
        """(n,) s since ``zero_ns``."""
        return (self.stamps_ns - zero_ns) / NANOSECONDS


def read(path: Path, body: str | None = None, truth: Path | None = None) -> Tracked:
    """Read a person's angles and skeletons, and the truth, from a bag.

    Args:
        path: a bag folder or an mcap file.
        body: the person's id; None for the first one in the bag.
        truth: the bag with the truth; None for this one.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: no joint angles, or none of this person; or the truth is that of another recording.
    """
    with RigReader(path) as bag:
        if not bodies(bag):
            raise EvaluationError(
                f"{path}: holds no joint angles ({graph.joint_states_topic('<id>')}); make some with replay"
            )
        body, angles = read_angles(bag, body)
        skeletons = read_skeletons(bag, graph.FILTERED)
    if truth is not None:
        check_same_recording(path, truth)
    with RigReader(truth or path) as bag:
        topic = graph.true_angles_topic(body)
        own = read_joint_states(bag, topic if topic in bag.topics else graph.TRUE_ANGLES, body)
        coordinates = read_joint_states(bag, graph.TRUE_MODEL_STATE, "")
        if truth is not None and own is None and coordinates is None:
            raise EvaluationError(f"{truth}: holds no truth ({graph.TRUE_ANGLES}, {topic}); recordings of simulate do")
        return Tracked(
            bag=Path(path),
            body=body,
            angles=angles,
            skeletons=skeletons,
            true_angles=true_angles(angles.names, own, coordinates),
            true_skeletons=read_skeletons(bag, graph.TRUE_SKELETON),
        )


def check_same_recording(path: Path, other: Path) -> None:
    """EvaluationError if a sensor published skeletons in both bags, and no frame of it is in both."""
    with RigReader(path) as bag:
        sensors = _sensor_stamps(bag, bag.topics)
    with RigReader(other) as bag:
        for topic, stamps in _sensor_stamps(bag, sensors).items():
            if stamps.isdisjoint(sensors[topic]):
                raise EvaluationError(f"{other}: is another recording than {path}: no frame of {topic} is in both")


def _sensor_stamps(bag: BagReader, topics: Collection[str]) -> dict[str, set[int]]:
    """The stamps of the sensors' skeletons in a bag, of those of these topics that it has."""
    wanted = [topic for topic in map(graph.skeleton_topic, graph.sensors_among(bag.topics)) if topic in topics]
    found: dict[str, set[int]] = {}
    for raw in bag.messages(wanted) if wanted else ():
        found.setdefault(raw.topic, set()).add(stamp_of(raw.cdr))
    return found


def true_angles(names: tuple[str, ...], own: AngleSeries | None, coordinates: AngleSeries | None) -> AngleSeries | None:
    """The truth in the convention of the evaluated angles.

    Args:
        names: of the evaluated angles.
        own: the true angles of a recording, of ``kinematics.positional``; None if there are none.
        coordinates: the true coordinates of the body model; None if there are none.

    Returns:
        Angles computed from the coordinates if there are any and the names are those of a convention. Else ``own``;
        if the evaluated angles are of another convention than these, only those that are the same in both.
    """
    model = UpperBody()
    of_names = {convention(name, model).names: name for name in CONVENTIONS}
    if names not in of_names:
        return own
    if coordinates is None or coordinates.names != model.coordinate_names:
        return own if own is None or own.names != ANGLE_NAMES else own.only(_IN_EVERY_CONVENTION)
    found = true_model_angles(coordinates, model, of_names[names])
    return replace(found, stddev=np.where(found.stddev > _AMPLIFIED * _EXACT, np.inf, found.stddev))


def true_model_angles(coordinates: AngleSeries, model: UpperBody, name: str) -> AngleSeries:
    """Angles in a convention from the true coordinates, as if these had errors of :data:`_EXACT`."""
    exact = _EXACT**2 * np.eye(2 * model.nv)
    lengths, rates = model.default_lengths(), np.zeros(model.nv)  # angles do not depend on them
    configurations = model.integrate(model.neutral(), coordinates.position)
    states = (
        ModelEstimate(stamp_ns, "", 0, q, rates, exact, lengths, np.zeros_like(lengths))
        for stamp_ns, q in zip(coordinates.stamps_ns.tolist(), configurations, strict=True)
    )
    return model_angles(states, model, name)


def model_angles(states: Iterable[ModelEstimate], model: UpperBody, name: str) -> AngleSeries:
    """The angles of one or more consecutive states in a convention."""
    series: list[JointAngles] = []
    for state in states:
        series.append(angles_of(state, model, name, series[-1] if series else None))
    return AngleSeries(
        np.array([each.stamp_ns for each in series], dtype=np.int64),
        series[0].names,
        np.stack([each.position for each in series]),
        np.stack([each.position_stddev for each in series]),
    )


def bodies(bag: BagReader) -> tuple[str, ...]:
    """The ids of people with joint angles in a bag, sorted."""
    return graph.bodies_among(
        topic for topic, info in bag.topics.items() if info.type_name == JOINT_STATE and info.count
    )


def read_angles(bag: BagReader, body: str | None = None) -> tuple[str, AngleSeries]:
    """A person's id and measured angles.

    Args:
        bag: with joint angles of at least one of :func:`bodies`.
        body: the person's id; None for the first one in the bag.

    Raises:
        EvaluationError: no readable joint angles of this person.
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
    """A topic's positions in time order; messages with other names than the first are ignored.

    Returns:
        A series with zero standard deviations and names without the body's id; None without messages.
    """
    names: tuple[str, ...] = ()
    rows: dict[int, FloatArray] = {}
    for raw in _messages(bag, topic, JOINT_STATE):
        message = deserialize(JOINT_STATE, raw.cdr)
        names = names or tuple(message.name)
        if tuple(message.name) == names and len(message.position) == len(names):
            rows[to_nanoseconds(message.header.stamp)] = np.array(message.position, dtype=np.float64)
    if not rows:
        return None
    stamps = sorted(rows)
    position = np.array([rows[stamp] for stamp in stamps])
    short = tuple(name.removesuffix(f"_{body}") for name in names)
    short = tuple(_RENAMED.get(name, name) for name in short)
    return AngleSeries(np.array(stamps, dtype=np.int64), short, position, np.zeros_like(position))


def _with_stddev(values: AngleSeries, deviations: AngleSeries | None) -> AngleSeries:
    """Values with the standard deviations of equal stamps, else infinity."""
    stddev = np.full_like(values.position, np.inf)
    if deviations is not None and deviations.names == values.names:
        _, here, there = np.intersect1d(values.stamps_ns, deviations.stamps_ns, return_indices=True)
        stddev[here] = deviations.position[there]
    stddev[~np.isfinite(values.position)] = np.inf
    return AngleSeries(values.stamps_ns, values.names, values.position, stddev)


def read_frames(bag: BagReader, topic: str) -> dict[int, tuple[Skeleton, ...]]:
    """The bodies of a topic's messages by stamp, in time order; malformed messages are ignored."""
    frames = {}
    for raw in _messages(bag, topic, POINT_CLOUD):
        try:
            skeletons = decode_skeletons(raw.cdr) or cloud_to_skeletons(deserialize(POINT_CLOUD, raw.cdr))
        except MessageError:
            continue
        frames[skeletons[0].stamp_ns] = skeletons
    return dict(sorted(frames.items()))


def read_skeletons(bag: BagReader, topic: str) -> tuple[Skeleton, ...]:
    """The first body of each message, in time order; empty if there is no such topic."""
    return tuple(skeletons[0] for skeletons in read_frames(bag, topic).values())


def nearest(stamps_ns: IntArray, wanted_ns: IntArray, within_ns: int = _MATCH_NS) -> IntArray:
    """Index of the nearest of (n,) sorted stamps for each of (m,) wanted ones; -1 if farther than ``within_ns``."""
    after = np.clip(np.searchsorted(stamps_ns, wanted_ns), 1, max(len(stamps_ns) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stamps_ns) - 1)
    closer = np.abs(stamps_ns[after] - wanted_ns) < np.abs(stamps_ns[before] - wanted_ns)
    index = np.where(closer, after, before)
    result: IntArray = np.where(np.abs(stamps_ns[index] - wanted_ns) <= within_ns, index, -1)
    return result


def true_at(angles: AngleSeries, truth: AngleSeries | None) -> FloatArray:
    """(n, m) truth within 20 ms of the angles' stamps; NaN if there is none."""
    true = np.full_like(angles.position, np.nan)
    if truth is not None:
        matches = nearest(truth.stamps_ns, angles.stamps_ns)
        for column, name in enumerate(angles.names):
            if name in truth.names:
                true[:, column] = np.where(matches >= 0, truth.known[matches, truth.names.index(name)], np.nan)
    return true


# --- estimate and truth


def read_estimate(path: Path, topic: str | None = None, body: str | None = None) -> Recorded:
    """The estimated skeletons, angles and calibration in a bag.

    Args:
        path: a bag folder or an mcap file.
        topic: of the skeletons; None for ``/filtered/skeleton``, or ``/fused/skeleton`` if that is missing.
        body: id of the person whose angles are read; None for the first one in the bag.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: the topic is missing, empty or of another type, or there are no angles of this person.
    """
    with RigReader(path) as bag:
        if topic is None:
            full = [each for each in (graph.FILTERED, graph.FUSED) if each in bag.topics and bag.topics[each].count]
            topic = full[0] if full else graph.FILTERED
            if topic not in bag.topics and bodies(bag):
                raise EvaluationError(
                    f"{path}: joint angles without skeletons, as markers give them; `body_tracking show {path}` "
                    "prints them, beside the truth where a bag holds that of these angles (--truth BAG)"
                )
        made = _recorded(bag, topic, "; make some with replay, or choose one with --topic")
        angles = read_angles(bag, body)[1] if body is not None or bodies(bag) else None
        return replace(made, angles=angles, sensors=_sensors(bag, graph.CALIBRATION, graph.CALIBRATION_CLOCK))


def read_truth(path: Path, body: str | None = None) -> Recorded:
    """The true skeletons, angles and calibration in a bag.

    Args:
        path: a bag folder or an mcap file.
        body: the id at the end of the angles' names; None for any.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: it holds no true skeletons.
    """
    with RigReader(path) as bag:
        advice = "; --truth names a recording with the truth or another estimate, --help says which kinds"
        ids = (body,) if body is not None else bodies(bag)
        return replace(
            _recorded(bag, graph.TRUE_SKELETON, advice),
            angles=read_joint_states(bag, graph.TRUE_ANGLES, ids[0] if ids else graph.DEFAULT_BODY),
            sensors=_sensors(bag, graph.TRUE_CALIBRATION, graph.TRUE_CLOCK),
            coordinates=read_joint_states(bag, graph.TRUE_MODEL_STATE, ""),
        )


def read_markers(path: Path, subject: str | None = None, measurements: Path | None = None) -> Recorded:
    """Joint centres from markers as the truth, with its own clock and frame.

    Args:
        path: a C3D file with the markers of Plug-in Gait.
        subject: required if the file has several.
        measurements: Vicon's file of the subject's measurements; None for those in the C3D file.

    Raises:
        MarkerError: unreadable files, or too few markers.
    """
    measured = None if measurements is None else read_measurements(measurements)
    markers = read_plug_in_gait(path, subject=subject, measurements=measured)
    warnings = [f"{path}: not seen: {gap}" for gap in markers.gaps]
    for names, what in ((markers.missing, "has no marker"), (markers.estimated, "estimates the subject's")):
        if names:
            warnings.append(f"{path}: {what} {', '.join(names)}")
    return replace(truth_of_markers(path, markers.stamps, markers.positions), warnings=tuple(warnings))


def truth_of_markers(source: Path, stamps: FloatArray, positions: FloatArray) -> Recorded:
    """Joint centres as the truth, with its own clock and frame.

    Args:
        source: the file.
        stamps: (n,) s, increasing.
        positions: (n, 25, 3) metres, NaN where unknown.
    """
    stamps_ns = np.rint(stamps * NANOSECONDS).astype(np.int64)
    return Recorded(source, "", "markers", stamps_ns, positions)


def _recorded(bag: BagReader, topic: str, advice: str) -> Recorded:
    """The first body of a topic's skeletons."""
    info = bag.topics.get(topic)
    there = ", ".join(sorted(name for name, each in bag.topics.items() if each.type_name == POINT_CLOUD))
    if info is None:
        raise EvaluationError(f"{bag.path}: no topic {topic} (skeletons there: {there or 'none'}){advice}")
    if info.type_name != POINT_CLOUD:
        raise EvaluationError(f"{bag.path}: {topic} holds {info.type_name}, expected {POINT_CLOUD}")
    if not info.count:
        raise EvaluationError(f"{bag.path}: {topic} is empty")
    frames = read_frames(bag, topic)
    if len(frames) < 2:
        raise EvaluationError(
            f"{bag.path}: {len(frames)} skeleton(s) with a stamp of their own in the {info.count} messages of "
            f"{topic}, at least 2 are needed"
        )
    skeletons = [bodies_there[0] for bodies_there in frames.values()]
    people = max(map(len, frames.values()))
    crowd = (f"{bag.path}: {topic} holds {people} people, only the first is compared",) if people > 1 else ()
    # infinite covariances become NaN: rotating a matrix spreads infinity over all elements
    stated = [
        np.where(np.isfinite(each.covariances), each.covariances, np.nan)
        for each in skeletons
        if each.covariances is not None
    ]
    return Recorded(
        bag.path,
        topic,
        skeletons[0].frame_id,
        np.array(list(frames), dtype=np.int64),
        np.stack([np.where(each.valid[:, None], each.positions, np.nan) for each in skeletons]),
        np.stack(stated) if len(stated) == len(skeletons) else None,
        warnings=(*bag.warnings, *crowd),
    )


def _sensors(bag: BagReader, pose_topic: str, clock_topic: str) -> dict[str, SensorClaims]:
    poses = [transform_to_pose(deserialize(TRANSFORM, raw.cdr)) for raw in _messages(bag, pose_topic, TRANSFORM)]
    clocks = [
        time_reference_to_clock(deserialize(TIME_REFERENCE, raw.cdr))
        for raw in _messages(bag, clock_topic, TIME_REFERENCE)
    ]
    claims = {}
    for sensor in dict.fromkeys(pose.sensor for pose in poses):
        own = [pose for pose in poses if pose.sensor == sensor]
        times = sorted((at_ns, clock.offset) for name, at_ns, clock in clocks if name == sensor)
        claims[sensor] = SensorClaims(
            np.array([pose.valid_from_ns for pose in own], dtype=np.int64),
            np.stack([pose.rotation for pose in own]),
            np.stack([pose.translation for pose in own]),
            np.array([at_ns for at_ns, _ in times], dtype=np.int64),
            np.array([offset for _, offset in times]),
        )
    return claims


def _messages(bag: BagReader, topic: str, kind: str) -> Iterator[RawMessage]:
    """A topic's messages; none if it is missing or of another type."""
    there = topic in bag.topics and bag.topics[topic].type_name == kind
    return bag.messages([topic]) if there else iter(())

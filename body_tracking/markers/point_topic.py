"""Stage and codec for points published by another motion capture system, which replace those of the rig's cameras."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from body_tracking.core.message_types import MARKERS, POINT_CLOUD
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import RELIABLE, SENSOR_DATA
from body_tracking.core.skeleton import MAX_RANGE, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.codecs import SpacePoints
from body_tracking.markers.messages import MAX_POINTS
from body_tracking.markers.trajectories import DEFAULT_NOISE, EMPTY, FAR, FRAME, points_of
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.clouds import COVARIANCE, POSITION, columns, covariance_of, has, read_cloud
from body_tracking.messages.codecs import Codec, Wire
from body_tracking.pipeline.shared import RELIABLE as TRANSPORT
from body_tracking.pipeline.stage import Now, Output, Port, Stage

TYPES: Final = {"PointCloud2": POINT_CLOUD, "MarkerArray": MARKERS}
"""Message types by their names in the parameter ``message``."""
_SINGLE, _LISTS = (1, 2, 3), (6, 7, 8)
"""``visualization_msgs/Marker``: cube, sphere, cylinder; lists of cubes, of spheres, points."""
UNSTAMPED: Final = "messages without a stamp"
MISSING: Final = "points that are not finite"


@dataclass(frozen=True, slots=True, eq=False)
class ForeignPoints:
    """Points of another system: stamp (0 if unknown), frame, (n, 3) metres, (n, 3, 3) covariance if known."""

    stamp_ns: int
    frame_id: str
    positions: FloatArray
    covariance: FloatArray | None


class ForeignCodec(Codec):
    """Reads ``PointCloud2`` with ``x y z`` and optionally ``xx xy xz yy yz zz``, or ``MarkerArray``."""

    def __init__(self, type_name: str) -> None:
        self.type_name = type_name

    def decode(self, cdr: bytes, wire: Wire) -> ForeignPoints:
        message = wire.deserialize(self.type_name, cdr)
        return from_cloud(message) if self.type_name == POINT_CLOUD else from_markers(message)

    def stamp_ns(self, payload: ForeignPoints) -> int | None:
        return payload.stamp_ns or None


def from_cloud(cloud: Any) -> ForeignPoints:
    """The points of a ``sensor_msgs/PointCloud2``.

    Raises:
        MessageError: as :func:`~body_tracking.messages.clouds.read_cloud`; an incomplete covariance, or one that is not
            positive definite.
    """
    rows = read_cloud(cloud, dict(POSITION + COVARIANCE), [name for name, _ in POSITION], MAX_POINTS)
    positions, covariance = columns(rows, "xyz"), None
    if has(rows, COVARIANCE):
        covariance = covariance_of(rows)
        finite = np.isfinite(positions).all(axis=1)
        known = covariance[finite]
        if not np.isfinite(known).all() or (len(known) and np.linalg.eigvalsh(known)[:, 0].min() <= 0.0):
            raise MessageError("the covariance of a point is not positive definite")
    return ForeignPoints(to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id), positions, covariance)


def from_markers(message: Any) -> ForeignPoints:
    """The points of a ``visualization_msgs/MarkerArray``: single spheres (cubes, cylinders) or lists of them.

    Texts, lines and arrows are ignored, as are instructions to delete a marker.

    Raises:
        MessageError: more than :data:`MAX_POINTS` points, markers of several times or frames, a list with a rotated
            pose.
    """
    shown = [each for each in message.markers if each.action == 0 and each.type in _SINGLE + _LISTS]
    headers = {(to_nanoseconds(each.header.stamp), str(each.header.frame_id)) for each in shown}
    if len(headers) > 1:
        raise MessageError(f"{len(shown)} markers of {len(headers)} times or frames, expected those of one")
    if sum(len(each.points) if each.type in _LISTS else 1 for each in shown) > MAX_POINTS:
        raise MessageError(f"more than {MAX_POINTS} points")
    positions = [np.empty((0, 3))]
    for each in shown:
        place, turn = each.pose.position, each.pose.orientation
        origin = np.array([[place.x, place.y, place.z]])
        if each.type in _LISTS:
            if max(abs(turn.x), abs(turn.y), abs(turn.z)) > 1e-6:
                raise MessageError("a list of points whose pose is turned")
            origin = origin + np.array([(p.x, p.y, p.z) for p in each.points]).reshape(-1, 3)
        positions.append(origin)
    stamp_ns, frame_id = headers.pop() if headers else (0, "")
    return ForeignPoints(stamp_ns, frame_id, np.concatenate(positions), None)


class PointTopicStage(Stage):
    """Republishes points of another motion capture system on the marker system's topic of points."""

    NAME = "marker_points"
    PARAMETERS = (
        Parameter("topic", "mocap/points", "the input topic"),
        Parameter("message", next(iter(TYPES)), "type of its messages", choices=tuple(TYPES)),
        Parameter(
            "noise",
            DEFAULT_NOISE,
            "standard deviation of each coordinate, for messages without a covariance",
            "m",
            1e-6,
            0.1,
            live=True,
        ),
        TRANSPORT,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self._counters: Counter[str] = Counter()
        self._frames = 0
        codec = ForeignCodec(TYPES[str(values["message"])])
        self.inputs = (
            Port(
                str(values["topic"]),
                codec,
                RELIABLE if values["reliable"] else SENSOR_DATA,
                perishable=True,
                absolute=True,
            ),
        )
        self.outputs = (Port(setup.POINTS, SpacePoints(), RELIABLE, measured=True),)

    def take(self, topic: str, payload: ForeignPoints, now: Now) -> Iterable[Output]:
        finite = np.isfinite(payload.positions).all(axis=1)
        near = finite & (np.abs(payload.positions) < MAX_RANGE).all(axis=1)
        self._frames += 1
        self._counters[MISSING] += int((~finite).sum())
        self._counters[FAR] += int((finite & ~near).sum())
        self._counters[EMPTY] += not near.any()
        self._counters[UNSTAMPED] += not payload.stamp_ns
        stamp_ns = payload.stamp_ns or now.ros_ns
        noise = float(str(self.values["noise"]))
        points = points_of(payload.positions[near], stamp_ns, payload.frame_id or FRAME, noise)
        if payload.covariance is not None:
            points = replace(points, covariance=payload.covariance[near])
        yield Output(setup.POINTS, points, stamp_ns)

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """Warn as long as no message has arrived."""
        if not self._frames:
            return 1, f"no usable message on {self.values['topic']} yet", {}
        return 0, "", {}

    @property
    def counters(self) -> Mapping[str, int]:
        return {"frames": self._frames, **self._counters}

"""The only bridge between the library's types and ROS messages.

The same functions serve two families of message classes: those of a ROS install (``rclpy``, live nodes) and those of
``rosbags`` (recordings, read and written with no ROS at all). Reading needs only attributes, which both have; writing
goes through a :class:`MessageTypes`, which knows how its family is constructed.
"""

from __future__ import annotations

import array
import importlib
from collections.abc import Mapping, Sequence
from functools import cache
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from body_tracking.calibration.result import ClockModel, SensorPose
from body_tracking.errors import BodyTrackingError
from body_tracking.kinematics import so3
from body_tracking.kinematics.angles import JointAngles
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.model import BodyModel
from body_tracking.node_status import NodeStatus
from body_tracking.orientation import SegmentOrientation
from body_tracking.sensors.imu import ImuSample, check_magnetic_field
from body_tracking.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.viewing.colours import Colour
from body_tracking.viewing.shapes import Ellipsoids, Figure

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
JOINT_STATE = "sensor_msgs/msg/JointState"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TIME_REFERENCE = "sensor_msgs/msg/TimeReference"
IMAGE = "sensor_msgs/msg/Image"
SEGMENTS = "sensor_msgs/msg/MultiDOFJointState"
IMU = "sensor_msgs/msg/Imu"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
STRING = "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOCK = "rosgraph_msgs/msg/Clock"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
FLOAT_ARRAY = "std_msgs/msg/Float64MultiArray"
MARKERS = "visualization_msgs/msg/MarkerArray"
TF = "tf2_msgs/msg/TFMessage"

# sensor_msgs/PointField datatypes
_UINT8, _UINT16, _FLOAT32 = 2, 4, 7
_NUMPY = {_UINT8: "u1", _UINT16: "<u2", _FLOAT32: "<f4"}

_BASE_FIELDS = (
    ("x", _FLOAT32),
    ("y", _FLOAT32),
    ("z", _FLOAT32),
    ("joint", _UINT8),
    ("tracking_state", _UINT8),
    ("body", _UINT16),
)
_COVARIANCE_FIELDS = tuple((name, _FLOAT32) for name in ("xx", "xy", "xz", "yy", "yz", "zz"))
_VELOCITY_FIELDS = tuple((name, _FLOAT32) for name in ("vx", "vy", "vz"))

_UPPER = np.triu_indices(3)
MAX_BODIES = 64
"""More bodies than this in one message is taken for a malformed one."""


class MessageError(BodyTrackingError):
    """A message does not have the layout that its topic promises."""


class MessageTypes(Protocol):
    """A family of message classes."""

    def make(self, type_name: str, /, **fields: Any) -> Any:
        """A message of type ``pkg/msg/Name`` with every one of its fields given."""

    def octets(self, data: bytes) -> Any:
        """The value of a ``uint8[]`` field."""

    def floats(self, values: FloatArray) -> Any:
        """The value of a ``float64[]`` field."""


class RosMessages:
    """The classes that ``rclpy`` publishes."""

    @staticmethod
    @cache
    def _class(type_name: str) -> Any:
        package, _, name = type_name.split("/")
        return getattr(importlib.import_module(f"{package}.msg"), name)

    def make(self, type_name: str, /, **fields: Any) -> Any:
        return self._class(type_name)(**fields)

    def octets(self, data: bytes) -> Any:
        return array.array("B", data)

    def floats(self, values: FloatArray) -> Any:
        return array.array("d", np.ascontiguousarray(values, dtype=np.float64).tobytes())


class BagMessages:
    """The classes of a ``rosbags`` type store."""

    def __init__(self, types: Mapping[str, Any]) -> None:
        self._types = types

    def make(self, type_name: str, /, **fields: Any) -> Any:
        return self._types[type_name](**fields)

    def octets(self, data: bytes) -> Any:
        return np.frombuffer(data, dtype=np.uint8)

    def floats(self, values: FloatArray) -> Any:
        return np.asarray(values, dtype=np.float64)


# --- stamps and headers


def to_nanoseconds(stamp: Any) -> int:
    """``builtin_interfaces/Time`` to integer nanoseconds."""
    return int(stamp.sec) * NANOSECONDS + int(stamp.nanosec)


def to_time(nanoseconds: int, types: MessageTypes) -> Any:
    """Integer nanoseconds to ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(nanoseconds, NANOSECONDS)
    return types.make("builtin_interfaces/msg/Time", sec=sec, nanosec=nanosec)


def to_header(stamp_ns: int, frame_id: str, types: MessageTypes) -> Any:
    """``std_msgs/Header``."""
    return types.make("std_msgs/msg/Header", stamp=to_time(stamp_ns, types), frame_id=frame_id)


# --- skeletons


@cache
def _cloud_layout(with_covariance: bool, with_velocity: bool) -> tuple[np.dtype[Any], tuple[tuple[str, int], ...]]:
    """The packed record and its fields; 16, 40 or 52 bytes a point."""
    fields = (
        _BASE_FIELDS + (_COVARIANCE_FIELDS if with_covariance else ()) + (_VELOCITY_FIELDS if with_velocity else ())
    )
    return np.dtype([(name, _NUMPY[kind]) for name, kind in fields]), fields


def skeletons_to_cloud(skeletons: Sequence[Skeleton], types: MessageTypes) -> Any:
    """Bodies seen at one instant as one ``sensor_msgs/PointCloud2``.

    Args:
        skeletons: at least one; all with the same stamp, frame and kind (covariances and velocities or not).
        types: the family of message classes to build.

    Returns:
        The message; a point per joint and body, joints in SDK order, fields as in the design's topic table.
    """
    first = skeletons[0]
    record, fields = _cloud_layout(first.covariances is not None, first.velocities is not None)
    points = np.empty((len(skeletons), N_JOINTS), dtype=record)
    points["joint"] = np.arange(N_JOINTS, dtype=np.uint8)
    for row, skeleton in zip(points, skeletons, strict=True):
        row["x"], row["y"], row["z"] = skeleton.positions.T
        row["tracking_state"] = skeleton.states
        row["body"] = skeleton.body
        if skeleton.covariances is not None:
            upper = skeleton.covariances[:, _UPPER[0], _UPPER[1]]
            for column, (name, _) in enumerate(_COVARIANCE_FIELDS):
                row[name] = upper[:, column]
        if skeleton.velocities is not None:
            row["vx"], row["vy"], row["vz"] = skeleton.velocities.T
    offsets = record.fields
    assert offsets is not None
    return types.make(
        POINT_CLOUD,
        header=to_header(first.stamp_ns, first.frame_id, types),
        height=1,
        width=points.size,
        fields=[
            types.make("sensor_msgs/msg/PointField", name=name, offset=int(offsets[name][1]), datatype=kind, count=1)
            for name, kind in fields
        ],
        is_bigendian=False,
        point_step=record.itemsize,
        row_step=record.itemsize * points.size,
        data=types.octets(points.tobytes()),
        is_dense=bool(np.isfinite(first.positions).all()),
    )


def _record_of(cloud: Any) -> np.dtype[Any]:
    """The numpy record that the message's own field table describes."""
    wanted = dict(_BASE_FIELDS + _COVARIANCE_FIELDS + _VELOCITY_FIELDS)
    names: list[str] = []
    formats: list[str] = []
    offsets: list[int] = []
    step = int(cloud.point_step)
    for field in cloud.fields:
        if field.name not in wanted or field.name in names:
            continue
        if field.datatype != wanted[field.name] or field.count != 1:
            raise MessageError(
                f"field {field.name!r} has datatype {field.datatype} x {field.count}, expected {wanted[field.name]} x 1"
            )
        if field.offset + np.dtype(_NUMPY[field.datatype]).itemsize > step:
            raise MessageError(f"field {field.name!r} at offset {field.offset} ends beyond point_step {step}")
        names.append(field.name)
        formats.append(_NUMPY[field.datatype])
        offsets.append(int(field.offset))
    missing = [name for name, _ in _BASE_FIELDS if name not in names]
    if missing:
        raise MessageError(f"missing field(s) {', '.join(missing)}")
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})


def cloud_to_skeletons(cloud: Any) -> tuple[Skeleton, ...]:
    """The bodies in one ``sensor_msgs/PointCloud2``, by number.

    Joints may come in any order; unknown fields are ignored.

    Raises:
        MessageError: fields missing or of another type, big-endian data, sizes that contradict each other, no
            points, a joint missing, repeated or unknown, a tracking state above 2.
    """
    if cloud.is_bigendian:
        raise MessageError("big-endian point data (the skeleton layout is little-endian)")
    count = int(cloud.width) * int(cloud.height)
    if count == 0:
        raise MessageError("0 points")
    if count % N_JOINTS or count > N_JOINTS * MAX_BODIES:
        raise MessageError(f"{count} points, expected a multiple of {N_JOINTS} and at most {N_JOINTS * MAX_BODIES}")
    record = _record_of(cloud)
    if int(cloud.row_step) != int(cloud.width) * record.itemsize or len(cloud.data) != int(cloud.row_step) * int(
        cloud.height
    ):
        raise MessageError(
            f"{len(cloud.data)} bytes of data for {count} points of {record.itemsize} bytes (row_step {cloud.row_step})"
        )
    points = np.frombuffer(memoryview(cloud.data), dtype=record)
    worst = int(points["tracking_state"].max())
    if worst > TrackingState.TRACKED:
        raise MessageError(f"tracking_state {worst}, expected 0, 1 or 2")
    order = np.lexsort((points["joint"], points["body"]))
    points = points[order].reshape(-1, N_JOINTS)
    if (points["joint"] != np.arange(N_JOINTS)).any() or (points["body"] != points["body"][:, :1]).any():
        raise MessageError(f"a joint is missing, repeated or above {N_JOINTS - 1}")
    stamp_ns, frame_id = to_nanoseconds(cloud.header.stamp), str(cloud.header.frame_id)
    names = record.names or ()
    return tuple(
        Skeleton(
            stamp_ns,
            frame_id,
            _columns(row, ("x", "y", "z")),
            row["tracking_state"].copy(),
            int(row["body"][0]),
            _symmetric(row) if "xx" in names else None,
            _columns(row, ("vx", "vy", "vz")) if "vx" in names else None,
        )
        for row in points
    )


def markers_to_points(message: Any) -> tuple[int, list[int], FloatArray]:
    """The markers of one ``visualization_msgs/MarkerArray`` that are there to be shown: stamp, ids, (n, 3) positions.

    Raises:
        MessageError: no such marker, or markers of several times.
    """
    shown = [marker for marker in message.markers if marker.action == 0]  # ADD
    stamps = {to_nanoseconds(marker.header.stamp) for marker in shown}
    if len(stamps) != 1:
        raise MessageError(f"{len(shown)} markers of {len(stamps)} times, expected those of one")
    places = [marker.pose.position for marker in shown]
    points = np.array([(place.x, place.y, place.z) for place in places])
    return stamps.pop(), [int(marker.id) for marker in shown], points


def _columns(row: Any, names: Sequence[str]) -> FloatArray:
    return np.stack([row[name] for name in names], axis=1).astype(np.float64)


def _symmetric(row: Any) -> FloatArray:
    upper = _columns(row, [name for name, _ in _COVARIANCE_FIELDS])
    full = np.empty((len(row), 3, 3))
    full[:, _UPPER[0], _UPPER[1]] = upper
    full[:, _UPPER[1], _UPPER[0]] = upper
    return full


# --- joint angles


def angles_to_joint_states(angles: JointAngles, body: str, frame_id: str, types: MessageTypes) -> tuple[Any, Any]:
    """Values and standard deviations as two ``sensor_msgs/JointState``.

    Args:
        angles: radians and radians per second.
        body: the REP-155 body id; every name ends in ``_<body>``.
        frame_id: written into both headers.
        types: the family of message classes to build.
    """
    header = to_header(angles.stamp_ns, frame_id, types)
    names = [f"{name}_{body}" for name in angles.names]

    def joint_state(position: FloatArray, velocity: FloatArray) -> Any:
        return types.make(
            JOINT_STATE,
            header=header,
            name=names,
            position=types.floats(position),
            velocity=types.floats(velocity),
            effort=types.floats(np.empty(0)),
        )

    return (
        joint_state(angles.position, angles.velocity),
        joint_state(angles.position_stddev, angles.velocity_stddev),
    )


def joint_states_to_angles(values: Any, deviations: Any, body: str) -> JointAngles:
    """The inverse of :func:`angles_to_joint_states`.

    Args:
        values: ``sensor_msgs/JointState``.
        deviations: the same, of the same stamp.
        body: whose they are; the ending ``_<body>`` of their names is left out.

    Raises:
        MessageError: different names or stamps, a name without that ending, sizes that do not go together.
    """
    names, stamp_ns = tuple(values.name), to_nanoseconds(values.header.stamp)
    if tuple(deviations.name) != names or to_nanoseconds(deviations.header.stamp) != stamp_ns:
        raise MessageError("joint states and their standard deviations have other names or stamps")
    other = next((name for name in names if not name.endswith(f"_{body}")), None)
    if other is not None:
        raise MessageError(f"name {other!r} does not end in _{body}")
    columns = [
        np.array(numbers, dtype=np.float64)
        for message in (values, deviations)
        for numbers in (message.position, message.velocity)
    ]
    if any(len(column) != len(names) for column in columns):
        raise MessageError(f"{', '.join(str(len(column)) for column in columns)} numbers of {len(names)} names")
    position, velocity, position_stddev, velocity_stddev = columns
    short = tuple(name.removesuffix(f"_{body}") for name in names)
    return JointAngles(stamp_ns, short, position, velocity, position_stddev, velocity_stddev)


# --- commands to robots


def command_to_trajectory(
    joints: Sequence[str], position: FloatArray, stamp_ns: int, from_start: float, types: MessageTypes
) -> Any:
    """``trajectory_msgs/JointTrajectory`` with one point, for ``joint_trajectory_controller``.

    Without velocities, for that controller refuses a trajectory that ends in motion (its parameter
    ``allow_nonzero_velocity_at_trajectory_end``, false from Jazzy on).

    Args:
        joints: n names.
        position: (n,) radians.
        stamp_ns: when the trajectory starts; 0 for when it arrives.
        from_start: seconds from then to the point.
        types: the family of message classes to build.
    """
    sec, nanosec = divmod(round(from_start * NANOSECONDS), NANOSECONDS)
    none = types.floats(np.empty(0))
    return types.make(
        JOINT_TRAJECTORY,
        header=to_header(stamp_ns, "", types),
        joint_names=list(joints),
        points=[
            types.make(
                "trajectory_msgs/msg/JointTrajectoryPoint",
                positions=types.floats(position),
                velocities=none,
                accelerations=none,
                effort=none,
                time_from_start=types.make("builtin_interfaces/msg/Duration", sec=sec, nanosec=nanosec),
            )
        ],
    )


def command_to_array(position: FloatArray, types: MessageTypes) -> Any:
    """``std_msgs/Float64MultiArray`` of (n,) radians in the controller's order, for ``forward_command_controller``."""
    layout = types.make("std_msgs/msg/MultiArrayLayout", dim=[], data_offset=0)
    return types.make(FLOAT_ARRAY, layout=layout, data=types.floats(position))


def joint_state_values(message: Any) -> tuple[int, tuple[str, ...], FloatArray]:
    """Stamp in nanoseconds, n names and (n,) positions of a ``sensor_msgs/JointState``.

    Raises:
        MessageError: another number of positions than of names.
    """
    names, values = tuple(message.name), np.array(message.position, dtype=np.float64)
    if len(values) != len(names):
        raise MessageError(f"{len(values)} positions for {len(names)} names")
    return to_nanoseconds(message.header.stamp), names, values


# --- the state of a body model


def estimate_to_joint_states(estimate: ModelEstimate, model: BodyModel, types: MessageTypes) -> tuple[Any, Any]:
    """The coordinates of a body model and their standard deviations as two ``sensor_msgs/JointState``.

    Args:
        estimate: of the model.
        model: gives the names.
        types: the family of message classes to build.

    Returns:
        Positions: the tangent vector from the model's neutral pose, so that a rotation that is free is its rotation
        vector; velocities: the tangent velocity. The deviations are those of small tangent vectors at the estimate.
    """
    header = to_header(estimate.stamp_ns, estimate.frame_id, types)

    def joint_state(position: FloatArray, velocity: FloatArray) -> Any:
        return types.make(
            JOINT_STATE,
            header=header,
            name=list(model.coordinate_names),
            position=types.floats(position),
            velocity=types.floats(velocity),
            effort=types.floats(np.empty(0)),
        )

    deviations = stddevs(estimate)
    return (
        joint_state(model.difference(model.neutral(), estimate.q), estimate.velocity),
        joint_state(deviations[: model.nv], deviations[model.nv :]),
    )


def stddevs(estimate: ModelEstimate) -> FloatArray:
    """(2 nv,) the standard deviations in an estimate's covariance."""
    result: FloatArray = np.sqrt(np.maximum(estimate.covariance.diagonal(), 0.0))
    return result


def joint_state_to_model(message: Any, model: BodyModel) -> tuple[int, str, FloatArray, FloatArray]:
    """The inverse of :func:`estimate_to_joint_states`, without what that does not hold.

    Args:
        message: ``sensor_msgs/JointState``.
        model: what it is to be about.

    Returns:
        Stamp in nanoseconds, frame, (nq,) configuration, (nv,) tangent velocity; NaN where that is not known.

    Raises:
        MessageError: other names, other sizes, a position that is not finite, an infinite velocity.
    """
    names = tuple(message.name)
    if names != model.coordinate_names:
        other = next((name for name in names if name not in model.coordinate_names), None)
        what = f"unknown name {other!r}" if other is not None else f"{len(names)} names, or in another order"
        raise MessageError(f"{what}; expected the {model.nv} coordinates of {model.name}")
    position, velocity = (np.array(values, dtype=np.float64) for values in (message.position, message.velocity))
    return (
        to_nanoseconds(message.header.stamp),
        str(message.header.frame_id),
        *coordinates_to_configuration(position, velocity, model),
    )


def coordinates_to_configuration(
    position: FloatArray, velocity: FloatArray, model: BodyModel
) -> tuple[FloatArray, FloatArray]:
    """(nq,) configuration and (nv,) tangent velocity of the numbers in a message.

    Raises:
        MessageError: other sizes, a position that is not finite, an infinite velocity.
    """
    for name, values, unsound in (
        ("position", position, ~np.isfinite(position)),
        ("velocity", velocity, np.isinf(velocity)),
    ):
        if len(values) != model.nv:
            raise MessageError(f"{len(values)} {name} values, expected {model.nv}")
        if unsound.any():
            first = int(unsound.argmax())
            raise MessageError(f"{name} of {model.coordinate_names[first]} is {values[first]}")
    return model.integrate(model.neutral(), position), velocity


COVARIANCE_ENCODING = "32FC1"
"""Of the image that holds covariances: one float32 per pixel."""


def covariance_rows(estimate: ModelEstimate) -> NDArray[np.float32]:
    """(2 nv, nv) the covariance of the coordinates, and under it that of their rates."""
    nv = len(estimate.velocity)
    return np.concatenate([estimate.covariance[:nv, :nv], estimate.covariance[nv:, nv:]]).astype("<f4")


def rows_to_covariance(rows: FloatArray) -> FloatArray:
    """(2 nv, 2 nv) of (2 nv, nv) rows; nothing is said of how coordinates and rates depend on each other.

    Raises:
        MessageError: a NaN, or a negative variance.
    """
    nv = rows.shape[1]
    covariance = np.zeros((2 * nv, 2 * nv))
    covariance[:nv, :nv], covariance[nv:, nv:] = rows[:nv], rows[nv:]
    if np.isnan(covariance).any():
        raise MessageError("a covariance is NaN")
    if (covariance.diagonal() < 0.0).any():
        raise MessageError("a variance is negative")
    return covariance


def covariance_to_image(estimate: ModelEstimate, types: MessageTypes) -> Any:
    """``sensor_msgs/Image`` of :func:`covariance_rows`: 2 nv rows of nv columns."""
    rows = covariance_rows(estimate)
    return types.make(
        IMAGE,
        header=to_header(estimate.stamp_ns, estimate.frame_id, types),
        height=rows.shape[0],
        width=rows.shape[1],
        encoding=COVARIANCE_ENCODING,
        is_bigendian=0,
        step=4 * rows.shape[1],
        data=types.octets(rows.tobytes()),
    )


def image_to_covariance(message: Any, model: BodyModel) -> tuple[int, FloatArray]:
    """(stamp in nanoseconds, (2 nv, 2 nv) covariance), the inverse of :func:`covariance_to_image`.

    Raises:
        MessageError: another encoding or size, big-endian numbers, a NaN, a negative variance.
    """
    height, width, nv = int(message.height), int(message.width), model.nv
    if str(message.encoding) != COVARIANCE_ENCODING or message.is_bigendian:
        order = "big-endian " if message.is_bigendian else ""
        raise MessageError(f"{order}encoding {str(message.encoding)!r}, expected {COVARIANCE_ENCODING}")
    if (height, width, int(message.step)) != (2 * nv, nv, 4 * nv) or len(message.data) != 8 * nv * nv:
        size = f"{height} x {width} with {message.step} bytes a row and {len(message.data)} in all"
        raise MessageError(f"covariance of {size}, expected {2 * nv} x {nv} float32")
    rows = np.frombuffer(memoryview(message.data), "<f4").reshape(2 * nv, nv).astype(np.float64)
    return to_nanoseconds(message.header.stamp), rows_to_covariance(rows)


def segments_to_joint_state(
    estimate: ModelEstimate, names: Sequence[str], origins: FloatArray, quats_xyzw: FloatArray, types: MessageTypes
) -> Any:
    """``sensor_msgs/MultiDOFJointState``: the pose of each segment in the estimate's frame.

    Args:
        estimate: for its stamp and frame.
        names: s segments.
        origins: (s, 3) metres.
        quats_xyzw: (s, 4) unit quaternions.
        types: the family of message classes to build.
    """
    return types.make(
        SEGMENTS,
        header=to_header(estimate.stamp_ns, estimate.frame_id, types),
        joint_names=list(names),
        transforms=[
            types.make(
                "geometry_msgs/msg/Transform",
                translation=types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
                rotation=types.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
            )
            for (x, y, z), (qx, qy, qz, qw) in zip(origins.tolist(), quats_xyzw.tolist(), strict=True)
        ],
        twist=[],
        wrench=[],
    )


def joint_state_to_segments(message: Any) -> tuple[tuple[str, ...], FloatArray, FloatArray]:
    """The inverse of :func:`segments_to_joint_state`.

    Returns:
        Names of s segments, (s, 3) origins in metres, (s, 4) unit quaternions xyzw.

    Raises:
        MessageError: another number of transforms than of names, or numbers that are no pose.
    """
    names = tuple(message.joint_names)
    if len(message.transforms) != len(names):
        raise MessageError(f"{len(message.transforms)} transforms for {len(names)} segments")
    rows = np.array(
        [
            (t.translation.x, t.translation.y, t.translation.z, t.rotation.x, t.rotation.y, t.rotation.z, t.rotation.w)
            for t in message.transforms
        ]
    ).reshape(-1, 7)
    lengths = np.linalg.norm(rows[:, 3:], axis=1)
    unsound = ~np.isfinite(rows).all(axis=1) | (np.abs(lengths - 1.0) > 1e-3)
    if unsound.any():
        raise MessageError(f"the pose of {names[int(unsound.argmax())]} is {rows[int(unsound.argmax())]}")
    return names, rows[:, :3], rows[:, 3:] / lengths[:, None]


# --- inertial sensors


def _vector(values: FloatArray, types: MessageTypes) -> Any:
    x, y, z = (float(value) for value in values)
    return types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def imu_to_message(
    stamp_ns: int,
    frame_id: str,
    angular_velocity: FloatArray,
    linear_acceleration: FloatArray,
    quat_xyzw: FloatArray | None,
    covariances: tuple[FloatArray, FloatArray, FloatArray],
    types: MessageTypes,
) -> Any:
    """``sensor_msgs/Imu`` as REP-145 has it.

    Args:
        stamp_ns: capture time in the sensor's clock, nanoseconds.
        frame_id: of the sensor.
        angular_velocity: (3,) rad/s.
        linear_acceleration: (3,) m/s2, specific force.
        quat_xyzw: (4,) of the sensor in a world that is east, north, up; None for raw data.
        covariances: (3, 3) each, of orientation, angular velocity and acceleration; -1 in [0, 0] where unknown.
        types: the family of message classes to build.
    """
    x, y, z, w = (0.0, 0.0, 0.0, 1.0) if quat_xyzw is None else (float(value) for value in quat_xyzw)
    orientation, angular, linear = (types.floats(covariance.reshape(-1)) for covariance in covariances)
    return types.make(
        IMU,
        header=to_header(stamp_ns, frame_id, types),
        orientation=types.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w),
        orientation_covariance=orientation,
        angular_velocity=_vector(angular_velocity, types),
        angular_velocity_covariance=angular,
        linear_acceleration=_vector(linear_acceleration, types),
        linear_acceleration_covariance=linear,
    )


def magnetic_field_to_message(
    stamp_ns: int, frame_id: str, field: FloatArray, covariance: FloatArray, types: MessageTypes
) -> Any:
    """``sensor_msgs/MagneticField`` of (3,) tesla with a covariance (3, 3); the rest as :func:`imu_to_message`."""
    return types.make(
        MAGNETIC_FIELD,
        header=to_header(stamp_ns, frame_id, types),
        magnetic_field=_vector(field, types),
        magnetic_field_covariance=types.floats(covariance.reshape(-1)),
    )


def sample_to_messages(sample: ImuSample, types: MessageTypes) -> tuple[Any, Any | None]:
    """``sensor_msgs/Imu`` and, if there is a field, ``sensor_msgs/MagneticField`` of a reading.

    What the reading does not have is marked by -1 as REP-145 says; a covariance that is not known is zero.
    """
    absent = np.zeros((3, 3))
    absent[0, 0] = -1.0
    unknown = np.zeros((3, 3))
    stated = unknown if sample.orientation_covariance is None else sample.orientation_covariance
    imu = imu_to_message(
        sample.stamp_ns,
        sample.frame_id,
        np.zeros(3) if sample.angular_velocity is None else sample.angular_velocity,
        np.zeros(3) if sample.acceleration is None else sample.acceleration,
        sample.orientation,
        (
            absent if sample.orientation is None else stated,
            absent if sample.angular_velocity is None else unknown,
            absent if sample.acceleration is None else unknown,
        ),
        types,
    )
    if sample.magnetic_field is None:
        return imu, None
    field = magnetic_field_to_message(sample.stamp_ns, sample.frame_id, sample.magnetic_field, unknown, types)
    return imu, field


def message_to_sample(message: Any, magnetic_field: FloatArray | None = None) -> ImuSample:
    """The reading in a ``sensor_msgs/Imu``, without what its covariances say is absent (-1, REP-145).

    Args:
        message: of a ROS install or of a recording.
        magnetic_field: (3,) tesla of the same instant, if there is one.

    Raises:
        MessageError: a covariance that has not nine elements.
        ImuSampleError: what no inertial sensor can have said.
    """
    covariances = {}
    for name in ("orientation", "angular_velocity", "linear_acceleration"):
        values = np.array(getattr(message, f"{name}_covariance"), dtype=np.float64)
        if values.size != 9:
            raise MessageError(f"{name}_covariance of {values.size} elements, expected 9")
        covariances[name] = values.reshape(3, 3)
    there = {name: covariance[0, 0] != -1.0 for name, covariance in covariances.items()}
    q, stated = message.orientation, covariances["orientation"]
    return ImuSample(
        to_nanoseconds(message.header.stamp),
        str(message.header.frame_id),
        np.array([q.x, q.y, q.z, q.w]) if there["orientation"] else None,
        # all zeros: not known
        stated if there["orientation"] and stated.any() else None,
        _array(message.angular_velocity) if there["angular_velocity"] else None,
        _array(message.linear_acceleration) if there["linear_acceleration"] else None,
        magnetic_field,
    )


def message_to_magnetic_field(message: Any) -> tuple[int, str, FloatArray]:
    """(stamp in nanoseconds, frame, (3,) tesla) of a ``sensor_msgs/MagneticField``.

    Raises:
        ImuSampleError: not finite, or beyond 1e-3 T.
    """
    field = _array(message.magnetic_field)
    check_magnetic_field(field)
    return to_nanoseconds(message.header.stamp), str(message.header.frame_id), field


def _array(vector: Any) -> FloatArray:
    return np.array([vector.x, vector.y, vector.z], dtype=np.float64)


def orientation_to_message(measurement: SegmentOrientation, types: MessageTypes) -> Any:
    """``sensor_msgs/Imu`` of a segment's orientation: rotation and covariance in a fixed frame, rate in its own.

    The header's frame is that fixed frame, such as ``world``; which segment it is, the topic says.
    """
    absent = np.zeros((3, 3))
    absent[0, 0] = -1.0
    rate = measurement.angular_velocity
    return imu_to_message(
        measurement.stamp_ns,
        measurement.frame_id,
        np.zeros(3) if rate is None else rate,
        np.zeros(3),
        so3.matrix_to_quat(measurement.rotation),
        (
            measurement.covariance,
            absent if rate is None else measurement.angular_velocity_variance * np.eye(3),
            absent,
        ),
        types,
    )


def message_to_orientation(message: Any, segment: str) -> SegmentOrientation:
    """The inverse of :func:`orientation_to_message`.

    Raises:
        MessageError: a covariance that has not nine elements, no orientation or none of its covariance.
        ImuSampleError: numbers that are not finite, a quaternion that is none, no frame.
        OrientationError: no orientation of that segment.
    """
    sample = message_to_sample(message)
    if sample.orientation is None or sample.orientation_covariance is None:
        raise MessageError(f"orientation of {segment}: without orientation, or without its covariance")
    variance = float(message.angular_velocity_covariance[0])
    rate = sample.angular_velocity if variance > 0.0 else None
    return SegmentOrientation(
        sample.stamp_ns,
        f"imu_{segment}",
        segment,
        so3.quat_to_matrix(sample.orientation),
        sample.orientation_covariance,
        rate,
        variance if rate is not None else 0.0,
        sample.frame_id,
    )


# --- calibration


def pose_to_transform(pose: SensorPose, world: str, types: MessageTypes) -> Any:
    """``geometry_msgs/TransformStamped`` of a sensor's optical frame in ``world``; the stamp is ``valid_from_ns``."""
    x, y, z = (float(value) for value in pose.translation)
    qx, qy, qz, qw = (float(value) for value in pose.quat_xyzw)
    return types.make(
        TRANSFORM,
        header=to_header(pose.valid_from_ns, world, types),
        child_frame_id=f"{pose.sensor}_optical_frame",
        transform=types.make(
            "geometry_msgs/msg/Transform",
            translation=types.make("geometry_msgs/msg/Vector3", x=x, y=y, z=z),
            rotation=types.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )


def transform_to_pose(message: Any) -> SensorPose:
    """The inverse of :func:`pose_to_transform`.

    Raises:
        MessageError: a child frame that is not ``<sensor>_optical_frame``, numbers that are not finite, a quaternion
            far from unit length.
    """
    suffix = "_optical_frame"
    child = str(message.child_frame_id)
    if not child.endswith(suffix) or child == suffix:
        raise MessageError(f"child_frame_id {child!r}, expected <sensor>{suffix}")
    t, q = message.transform.translation, message.transform.rotation
    translation, quat_xyzw = np.array([t.x, t.y, t.z]), np.array([q.x, q.y, q.z, q.w])
    norm = float(np.linalg.norm(quat_xyzw))
    if not np.isfinite(translation).all() or not abs(norm - 1.0) < 1e-3:
        raise MessageError(f"transform of {child!r}: translation {translation}, quaternion of length {norm:.3g}")
    return SensorPose(child.removesuffix(suffix), translation, quat_xyzw / norm, to_nanoseconds(message.header.stamp))


def clock_to_time_reference(sensor: str, clock: ClockModel, at_ns: int, types: MessageTypes) -> Any:
    """``sensor_msgs/TimeReference``: at ``header.stamp`` of the reference clock the sensor's clock showed ``time_ref``.

    Args:
        sensor: written into ``source``.
        clock: the sensor's clock against the reference clock.
        at_ns: the reference time from which the relation is valid.
        types: the family of message classes to build.
    """
    return types.make(
        TIME_REFERENCE,
        header=to_header(at_ns, "", types),
        time_ref=to_time(clock.to_sensor(at_ns), types),
        source=sensor,
    )


def time_reference_to_clock(message: Any) -> tuple[str, int, ClockModel]:
    """(sensor, valid from in the reference clock, the relation of the clocks from then on)."""
    at_ns = to_nanoseconds(message.header.stamp)
    return str(message.source), at_ns, ClockModel(to_nanoseconds(message.time_ref) - at_ns, 0.0, at_ns)


# --- diagnostics


def diagnostics(
    stamp_ns: int, name: str, hardware_id: str, level: int, text: str, values: Mapping[str, object], types: MessageTypes
) -> Any:
    """One ``diagnostic_msgs/DiagnosticArray`` with one status.

    Args:
        stamp_ns: node time.
        name: ``<node>: <what>``.
        hardware_id: the sensor, or empty.
        level: 0 OK, 1 warning, 2 error, 3 stale.
        text: one line for people.
        values: counters and rates.
        types: the family of message classes to build.
    """
    status = types.make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=bytes([level]) if isinstance(types, RosMessages) else level,
        name=name,
        message=text,
        hardware_id=hardware_id,
        values=[types.make("diagnostic_msgs/msg/KeyValue", key=key, value=str(value)) for key, value in values.items()],
    )
    return types.make(DIAGNOSTICS, header=to_header(stamp_ns, "", types), status=[status])


def statuses(message: Any, received: float = 0.0) -> tuple[NodeStatus, ...]:
    """Those in a ``diagnostic_msgs/DiagnosticArray``, received at a steady time in seconds."""
    return tuple(
        NodeStatus(
            each.name,
            each.level[0] if isinstance(each.level, bytes) else int(each.level),
            each.message,
            {item.key: item.value for item in each.values},
            received,
        )
        for each in message.status
    )


# --- markers

# visualization_msgs/Marker types
_SPHERE, _LINE_LIST, _SPHERE_LIST, _TEXT = 2, 5, 7, 9
MARKER_LIFETIME_NS = NANOSECONDS // 2
"""Markers vanish by themselves when nobody sends them anew for so long."""


class Markers:
    """The markers of one message, in one frame at one time.

    Args:
        stamp_ns: of all of them; 0 for whatever is the latest transform.
        frame_id: of all of them.
        types: the family of message classes to build.
    """

    def __init__(self, stamp_ns: int, frame_id: str, types: MessageTypes) -> None:
        self._types = types
        self._header = to_header(stamp_ns, frame_id, types)
        self._markers: list[Any] = []

    def figure(self, name: str, shape: Figure, colour: Colour, radius: float, thickness: float) -> None:
        """Skeletons: joints as balls in their colours, bones as lines of one colour."""
        types = self._types
        colours = [self._colour(rgb) for rgb in shape.joint_colours.tolist()]
        points, ends = self._points(shape.joints), self._points(shape.bones.reshape(-1, 3))
        size = types.make("geometry_msgs/msg/Vector3", x=2 * radius, y=2 * radius, z=2 * radius)
        self._add(f"{name}/joints", 0, _SPHERE_LIST, size, self._colour(colour), points=points, colors=colours)
        width = types.make("geometry_msgs/msg/Vector3", x=thickness, y=0.0, z=0.0)
        self._add(f"{name}/bones", 0, _LINE_LIST, width, self._colour(colour), points=ends)

    def ellipsoids(self, name: str, shape: Ellipsoids, colour: Colour, opacity: float) -> None:
        """Each an ellipsoid of its own."""
        quats = so3.matrix_to_quat(shape.rotations)
        for number, (centre, quat, radii) in enumerate(zip(shape.centres, quats, shape.radii, strict=True)):
            size = _vector(2.0 * np.maximum(radii, 1e-4), self._types)
            self._add(name, number, _SPHERE, size, self._colour(colour, opacity), self._pose(centre, quat))

    def lines(self, name: str, number: int, ends: FloatArray, pose: SensorPose, colour: Colour) -> None:
        """(n, 2, 3) lines in a sensor's own frame, and its name."""
        width = self._types.make("geometry_msgs/msg/Vector3", x=0.008, y=0.0, z=0.0)
        placed = self._pose(pose.translation, pose.quat_xyzw)
        self._add(
            name, number, _LINE_LIST, width, self._colour(colour), placed, points=self._points(ends.reshape(-1, 3))
        )
        above = self._pose(pose.translation + np.array([0.0, 0.0, 0.12]), np.array([0.0, 0.0, 0.0, 1.0]))
        height = self._types.make("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.08)
        self._add(f"{name}/names", number, _TEXT, height, self._colour(colour), above, text=pose.sensor)

    def message(self) -> Any:
        """``visualization_msgs/MarkerArray``."""
        return self._types.make(MARKERS, markers=self._markers)

    def _add(
        self,
        name: str,
        number: int,
        kind: int,
        scale: Any,
        colour: Any,
        pose: Any = None,
        points: Sequence[Any] = (),
        colors: Sequence[Any] = (),
        text: str = "",
    ) -> None:
        types = self._types
        lifetime = types.make("builtin_interfaces/msg/Duration", sec=0, nanosec=MARKER_LIFETIME_NS)
        self._markers.append(
            types.make(
                "visualization_msgs/msg/Marker",
                header=self._header,
                ns=name,
                id=number,
                type=kind,
                action=0,
                pose=self._pose(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])) if pose is None else pose,
                scale=scale,
                color=colour,
                lifetime=lifetime,
                frame_locked=False,
                points=list(points),
                colors=list(colors),
                texture_resource="",
                texture=types.make(
                    "sensor_msgs/msg/CompressedImage", header=self._header, format="", data=types.octets(b"")
                ),
                uv_coordinates=[],
                text=text,
                mesh_resource="",
                mesh_file=types.make("visualization_msgs/msg/MeshFile", filename="", data=types.octets(b"")),
                mesh_use_embedded_materials=False,
            )
        )

    def _points(self, points: FloatArray) -> list[Any]:
        return [self._types.make("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in points.tolist()]

    def _colour(self, rgb: Sequence[int], opacity: float = 1.0) -> Any:
        r, g, b = (value / 255.0 for value in rgb)
        return self._types.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=opacity)

    def _pose(self, position: FloatArray, quat_xyzw: FloatArray) -> Any:
        x, y, z = position.tolist()
        qx, qy, qz, qw = quat_xyzw.tolist()
        return self._types.make(
            "geometry_msgs/msg/Pose",
            position=self._types.make("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=self._types.make("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        )


def segments_to_transforms(message: Any, body: str, segments: Sequence[str], types: MessageTypes) -> Any:
    """``tf2_msgs/TFMessage`` that places a person's segments.

    Args:
        message: ``sensor_msgs/MultiDOFJointState`` of :func:`segments_to_joint_state`.
        body: the id of the person; frames are named ``<segment>_<body>``, as the links of the person's URDF.
        segments: those to place; the others are left out.
        types: the family of message classes to build.
    """
    return types.make(
        TF,
        transforms=[
            types.make(TRANSFORM, header=message.header, child_frame_id=f"{name}_{body}", transform=transform)
            for name, transform in zip(message.joint_names, message.transforms, strict=True)
            if name in segments
        ],
    )

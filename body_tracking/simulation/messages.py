"""Messages of simulated recordings, and bags of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.qos import Qos
from body_tracking.core.skeleton import Skeleton
from body_tracking.inertial.simulated import ImuSamples, SimulatedImu
from body_tracking.kinematics.positional import positional_angles
from body_tracking.messages.angles import angles_to_joint_state
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.imus import imu_to_message, magnetic_field_to_message
from body_tracking.messages.model import estimate_to_joint_state
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter, serialize
from body_tracking.simulation.people import MODEL

Message = tuple[int, str, bytes]
"""Log time, topic, serialised message."""
IMAGE_CHUNK_BYTES: Final = 32 << 20
"""Large chunks: consecutive images differ little, so they compress to a third of the size of small chunks."""


def imu_topic(imu: SimulatedImu) -> str:
    """The topic of a sensor's readings (REP-145)."""
    return f"/{imu.name}/imu/{'data' if imu.oriented else 'data_raw'}"


def mag_topic(imu: SimulatedImu) -> str:
    """The topic of a sensor's magnetic field (REP-145)."""
    return f"/{imu.name}/imu/mag"


def imu_messages(imu: SimulatedImu, samples: ImuSamples) -> Iterator[Message]:
    """The readings of an inertial sensor."""
    for k, (stamp_ns, received_ns) in enumerate(
        zip(samples.stamps_ns.tolist(), samples.received_ns.tolist(), strict=True)
    ):
        message = imu_to_message(
            stamp_ns,
            f"{imu.name}_link",
            samples.angular_velocity[k],
            samples.linear_acceleration[k],
            None if samples.orientation is None else samples.orientation[k],
            (
                samples.orientation_covariance[k],
                samples.angular_velocity_covariance,
                samples.linear_acceleration_covariance,
            ),
            BAG_MESSAGES,
        )
        yield received_ns, imu_topic(imu), serialize(message)
        if samples.magnetic_field is not None:
            field = magnetic_field_to_message(
                stamp_ns, f"{imu.name}_link", samples.magnetic_field[k], samples.magnetic_field_covariance, BAG_MESSAGES
            )
            yield received_ns, mag_topic(imu), serialize(field)


def truth_messages(skeletons: list[Skeleton], state: ModelEstimate, log_ns: int) -> Iterator[Message]:
    """The true joints of all people, and of the first one the state of the body model and the positional angles."""
    # positions only, as from a sensor
    yield log_ns, graph.TRUE_SKELETON, encode_skeletons([replace(each, velocities=None) for each in skeletons])
    yield log_ns, graph.TRUE_MODEL_STATE, serialize(estimate_to_joint_state(state, MODEL, BAG_MESSAGES))
    angles = positional_angles(skeletons[0])
    message = angles_to_joint_state(angles, graph.DEFAULT_BODY, skeletons[0].frame_id, BAG_MESSAGES)
    yield log_ns, graph.TRUE_ANGLES, serialize(message)


def write_bag(
    folder: Path, topics: Mapping[str, tuple[str, Qos]], messages: Iterable[Message], *, overwrite: bool = False
) -> None:
    """Write a bag of images, in the order of the messages.

    Args:
        folder: of the bag.
        topics: type and QoS of each topic.
        messages: may be computed while they are written.
        overwrite: replace an existing bag.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    with BagWriter(folder, overwrite=overwrite, chunk_bytes=IMAGE_CHUNK_BYTES, flush_interval_s=float("inf")) as bag:
        for topic, (type_name, qos) in topics.items():
            bag.add_topic(topic, type_name, qos)
        for log_ns, topic, cdr in messages:
            bag.write(topic, cdr, log_ns)


def print_bag(folder: Path, what: str) -> None:
    """Say what a written bag holds, and its size."""
    size = sum(path.stat().st_size for path in folder.iterdir())
    print(f"{folder}: {what}, {size / 1e6:.2f} MB")

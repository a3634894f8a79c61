"""Recordings of a simulated depth camera as bags, including the shipped one.

Topics: depth images and their ``camera_info``, simulated skeletons of a Kinect v2, an inertial sensor on each wrist,
and the ground truth: joints, angles, the camera's pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.message_types import IMAGE, IMU, JOINT_STATE, POINT_CLOUD, TRANSFORM
from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.inertial.simulated import SimulatedImu, usual_mounting
from body_tracking.inertial.surroundings import Surroundings
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.kinematics.positional import positional_angles
from body_tracking.mesh.codecs import DepthImage, DepthInfo
from body_tracking.mesh.topics import IMAGES, depth_topic, info_topic
from body_tracking.messages.angles import angles_to_joint_state
from body_tracking.messages.calibration import pose_to_transform
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.imus import imu_to_message
from body_tracking.messages.model import estimate_to_joint_state
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter, serialize
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthFrame, DepthScene, held_out, kinect_camera
from body_tracking.simulation.makehuman import makehuman_for
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, WORLD

SHIPPED: Final = "mesh_reaching"
"""The recording in ``bags/``."""
SECONDS: Final = 10.0
TRUTH: Final = {
    graph.TRUE_SKELETON: (POINT_CLOUD, SENSOR_DATA),
    graph.TRUE_MODEL_STATE: (JOINT_STATE, SENSOR_DATA),
    graph.TRUE_ANGLES: (JOINT_STATE, RELIABLE),
    graph.TRUE_CALIBRATION: (TRANSFORM, LATCHED),
}
"""Type and quality of service of each topic with the truth."""
_DELAY_NS: Final = 30_000_000
"""Time from the capture of an image to its receipt."""
_CHUNK_BYTES: Final = 32 << 20
"""Large chunks: consecutive images differ little, so they compress to a third of the size of small chunks."""
_FOREARMS: Final = ("forearm_left", "forearm_right")

_Message = tuple[int, str, bytes]


def shipped_scene() -> DepthScene:
    """The scene of the shipped recording, with every second pixel of a Kinect v2 in each direction.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
    """
    return DepthScene(held_out(makehuman_for(SHIPPED), 4), "reaching", 4, kinect_camera(2), still=True)


def make_shipped(bags: Path) -> None:
    """Write the shipped recording, replacing an existing one.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
        BagError: the recording cannot be written.
    """
    write_depth_bag(shipped_scene(), bags / SHIPPED, SECONDS, overwrite=True)
    size = sum(path.stat().st_size for path in (bags / SHIPPED).iterdir())
    print(f"{bags / SHIPPED}: {SECONDS:.0f} s of depth images, {size / 1e6:.2f} MB")


def write_depth_bag(scene: DepthScene, folder: Path, seconds: float, *, overwrite: bool = False) -> None:
    """Write the first seconds of a scene as a bag, with progress on stderr.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    topics = {
        depth_topic(SENSOR): (IMAGE, IMAGES),
        info_topic(SENSOR): (CAMERA_INFO, LATCHED),
        graph.skeleton_topic(SENSOR): (POINT_CLOUD, SENSOR_DATA),
        **{f"/{segment}/imu/data": (IMU, SENSOR_DATA) for segment in _FOREARMS},
        **TRUTH,
    }
    with BagWriter(folder, overwrite=overwrite, chunk_bytes=_CHUNK_BYTES, flush_interval_s=float("inf")) as bag:
        for topic, (type_name, qos) in topics.items():
            bag.add_topic(topic, type_name, qos)
        info = DepthInfo().encode((START_NS, scene.camera), BAG_WIRE)
        bag.write(info_topic(SENSOR), info, RECEIVED_FROM_NS)
        pose = pose_to_transform(scene.pose, WORLD, BAG_MESSAGES)
        bag.write(graph.TRUE_CALIBRATION, serialize(pose), RECEIVED_FROM_NS)
        messages, progress = [*inertial_messages(scene, seconds)], Progress(0, round(seconds * RATE))
        joints = []
        for index, frame in enumerate(scene.frames(0.0, seconds)):
            stamp_ns, log_ns = capture_times(frame.time)
            image = DepthImage().encode((stamp_ns, scene.camera.frame_id, frame.image), BAG_WIRE)
            messages.append((log_ns, depth_topic(SENSOR), image))
            joints.append(scene.pose.apply(frame.joints))
            messages += truth_messages(scene, frame, stamp_ns, log_ns)
            progress.at(index)
        messages += _skeletons(scene, np.array(joints))
        for log_ns, topic, cdr in sorted(messages, key=lambda item: item[:2]):
            bag.write(topic, cdr, log_ns)
        progress.end()


def capture_times(seconds: float, delay_ns: int = _DELAY_NS) -> tuple[int, int]:
    """Stamp of an image by the reference clock, and its time of receipt, nanoseconds."""
    elapsed_ns = round(seconds * NANOSECONDS)
    return START_NS + elapsed_ns, RECEIVED_FROM_NS + elapsed_ns + delay_ns


def truth_messages(scene: DepthScene, frame: DepthFrame, stamp_ns: int, log_ns: int) -> Iterator[_Message]:
    """Log time, topic and message of the true joints in ``world``, of the model's state and of positional angles."""
    joints = scene.pose.apply(frame.joints)
    truth = Skeleton(stamp_ns, WORLD, joints, np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8))
    yield log_ns, graph.TRUE_SKELETON, encode_skeletons([truth])
    q, lengths = scene.course(np.array([frame.time])).q[0], scene.who.person.lengths
    exact, unknown = np.zeros((2 * MODEL.nv, 2 * MODEL.nv)), np.full(MODEL.nv, np.nan)
    state = ModelEstimate(stamp_ns, WORLD, 0, q, unknown, exact, lengths, np.zeros_like(lengths))
    yield log_ns, graph.TRUE_MODEL_STATE, serialize(estimate_to_joint_state(state, MODEL, BAG_MESSAGES))
    angles = angles_to_joint_state(positional_angles(truth), graph.DEFAULT_BODY, WORLD, BAG_MESSAGES)
    yield log_ns, graph.TRUE_ANGLES, serialize(angles)


def _skeletons(scene: DepthScene, joints: FloatArray) -> Iterator[_Message]:
    """Simulated skeletons of a Kinect v2 from (n, 25, 3) true joints in ``world``, stamped as the depth images."""
    kinect = SimulatedKinect(scene.pose, ClockModel(anchor_ns=START_NS))
    rng, times = np.random.default_rng([scene.seed, 3]), np.arange(len(joints)) / RATE
    misreading = Misreading.draw(np.random.default_rng([scene.seed, 6]))
    positions, states = kinect.see(times, joints, scene.who.person.capsules(), rng, misreading)
    for index, time in enumerate(times):
        if states[index].any():
            stamp_ns = START_NS + round(float(time) * NANOSECONDS)
            skeleton = Skeleton(stamp_ns, scene.camera.frame_id, positions[index], states[index])
            log_ns = RECEIVED_FROM_NS + stamp_ns - START_NS + _DELAY_NS
            yield log_ns, graph.skeleton_topic(SENSOR), encode_skeletons([skeleton])


def inertial_messages(
    scene: DepthScene, seconds: float, segments: Sequence[str] = _FOREARMS, rate: float = 100.0
) -> Iterator[tuple[int, str, bytes]]:
    """Log time, topic and message of the readings of worn sensors with their own orientation filters, unordered."""
    for number, segment in enumerate(segments):
        place = MODEL.segment_names.index(segment)

        def motion(times: FloatArray, place: int = place) -> tuple[FloatArray, FloatArray]:
            posture = MODEL.forward(scene.course(times).q, scene.who.person.lengths)
            return posture.rotations[:, place], posture.origins[:, place]

        imu = SimulatedImu(segment, segment, usual_mounting(segment, scene.who.person.stature), rate, oriented=True)
        rng = np.random.default_rng([scene.seed, 4, number])
        samples = imu.samples(
            motion, seconds, START_NS, rng, surroundings=Surroundings(), received_from_ns=RECEIVED_FROM_NS
        )
        assert samples.orientation is not None and samples.orientation_covariance is not None
        for k, (stamp_ns, log_ns) in enumerate(
            zip(samples.stamps_ns.tolist(), samples.received_ns.tolist(), strict=True)
        ):
            message = imu_to_message(
                stamp_ns,
                f"{segment}_link",
                samples.angular_velocity[k],
                samples.linear_acceleration[k],
                samples.orientation[k],
                (
                    samples.orientation_covariance[k],
                    samples.angular_velocity_covariance,
                    samples.linear_acceleration_covariance,
                ),
                BAG_MESSAGES,
            )
            yield log_ns, f"/{segment}/imu/data", serialize(message)

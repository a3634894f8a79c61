"""Recordings of a simulated depth camera as bags, including the shipped one.

Topics: depth images and their ``camera_info``, simulated skeletons of a Kinect v2, an inertial sensor on each wrist,
and the ground truth: joints, angles, the camera's pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
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
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.topics import IMAGES, depth_topic, info_topic
from body_tracking.messages.calibration import pose_to_transform
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, serialize
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthFrame, DepthScene, held_out, kinect_camera
from body_tracking.simulation.makehuman import needed_makehuman
from body_tracking.simulation.messages import Message, imu_messages, print_bag, truth_messages, write_bag
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
_FOREARMS: Final = ("forearm_left", "forearm_right")


def shipped_scene() -> DepthScene:
    """The scene of the shipped recording, with every second pixel of a Kinect v2 in each direction.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
    """
    return DepthScene(held_out(needed_makehuman(), 4), "reaching", 4, kinect_camera(2), still=True)


def make_shipped(bags: Path) -> None:
    """Write the shipped recording, replacing an existing one.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
        BagError: the recording cannot be written.
    """
    write_depth_bag(shipped_scene(), bags / SHIPPED, SECONDS, overwrite=True)
    print_bag(bags / SHIPPED, f"{SECONDS:.0f} s of depth images")


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
    pose = serialize(pose_to_transform(scene.pose, WORLD, BAG_MESSAGES))
    messages = [
        (RECEIVED_FROM_NS, info_topic(SENSOR), CameraInfo().encode((START_NS, scene.camera), BAG_WIRE)),
        (RECEIVED_FROM_NS, graph.TRUE_CALIBRATION, pose),
        *inertial_messages(scene, seconds),
    ]
    progress = Progress(0, round(seconds * RATE))
    joints = []
    for index, frame in enumerate(scene.frames(0.0, seconds)):
        stamp_ns, log_ns = capture_times(frame.time)
        image = DepthImage().encode((stamp_ns, scene.camera.frame_id, frame.image), BAG_WIRE)
        messages.append((log_ns, depth_topic(SENSOR), image))
        joints.append(scene.pose.apply(frame.joints))
        messages += truth_of(scene, frame, stamp_ns, log_ns)
        progress.at(index)
    progress.end()
    messages += _skeletons(scene, np.array(joints))
    write_bag(folder, topics, sorted(messages, key=lambda item: item[:2]), overwrite=overwrite)


def capture_times(seconds: float, delay_ns: int = _DELAY_NS) -> tuple[int, int]:
    """Stamp of an image by the reference clock, and its time of receipt, nanoseconds."""
    elapsed_ns = round(seconds * NANOSECONDS)
    return START_NS + elapsed_ns, RECEIVED_FROM_NS + elapsed_ns + delay_ns


def truth_of(scene: DepthScene, frame: DepthFrame, stamp_ns: int, log_ns: int) -> Iterator[Message]:
    """The true joints in ``world``, the model's state and the positional angles of a frame."""
    joints = scene.pose.apply(frame.joints)
    truth = Skeleton(stamp_ns, WORLD, joints, np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8))
    q, lengths = scene.course(np.array([frame.time])).q[0], scene.who.person.lengths
    exact, unknown = np.zeros((2 * MODEL.nv, 2 * MODEL.nv)), np.full(MODEL.nv, np.nan)
    state = ModelEstimate(stamp_ns, WORLD, 0, q, unknown, exact, lengths, np.zeros_like(lengths))
    return truth_messages([truth], state, log_ns)


def _skeletons(scene: DepthScene, joints: FloatArray) -> Iterator[Message]:
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
) -> Iterator[Message]:
    """The readings of worn sensors with their own orientation filters, unordered."""
    for number, segment in enumerate(segments):
        imu = SimulatedImu(segment, segment, usual_mounting(segment, scene.who.person.stature), rate, oriented=True)
        rng = np.random.default_rng([scene.seed, 4, number])
        samples = imu.samples(
            scene.motion_of(segment),
            seconds,
            START_NS,
            rng,
            surroundings=Surroundings(),
            received_from_ns=RECEIVED_FROM_NS,
        )
        yield from imu_messages(imu, replace(samples, magnetic_field=None))

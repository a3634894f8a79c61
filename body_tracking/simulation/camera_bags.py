"""The shipped recordings of simulated cameras: people in clothes in rendered images, with ground truth.

One is from a colour-and-depth camera: its depth images are registered to the colour images and have half the pixels in
each direction. The other is from two colour cameras with their rig. Colour images are JPEG, on the topics of
image_transport.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.topics import COMPRESSED, DRIVERS, RIG_SENSOR
from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE
from body_tracking.core.qos import LATCHED, Qos
from body_tracking.core.sensor_poses import SensorPose, level_pose
from body_tracking.core.sources import optical_frame
from body_tracking.markers import setup
from body_tracking.markers.rig import LENS, POSE, Rig
from body_tracking.markers.rig_storage import save_rig
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.topics import IMAGES
from body_tracking.messages.calibration import pose_to_transform
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, serialize
from body_tracking.simulation.colour_images import CAMERA, Painter, colour_camera
from body_tracking.simulation.depth_bags import TRUTH, capture_times, truth_of
from body_tracking.simulation.depth_scene import RATE, DepthScene, held_out
from body_tracking.simulation.makehuman import needed_makehuman
from body_tracking.simulation.messages import Message, print_bag, write_bag
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, WORLD

SHIPPED: Final = "camera_reaching"
"""The recording in ``bags/`` of a colour-and-depth camera."""
SHIPPED_PAIR: Final = "cameras_turning"
"""The recording of two colour cameras."""
SECONDS: Final = 10.0
PAIR_SECONDS: Final = 6.0
_AROUND: Final = (-0.6, 0.6)
"""Azimuths of the two cameras around the person, radians."""
_AWAY, _HEIGHT, _PITCH = 2.6, 1.2, 0.05
"""Distance of these cameras from the person and height above the floor, metres; pitch downwards, radians."""
_PERSON: Final = 2.2
"""Distance of the person from the origin of ``world``, metres."""
EVERY: Final = 2
"""Every second image of 30 per second is used."""
_WIDTH: Final = 480
"""Width of a colour image, pixels; a depth image has half of it."""
_PAIR_FROM: Final = 2.0
"""Initial part of the motion that is skipped, because the person stands still, seconds."""


def make_shipped(bags: Path, rig_folder: Path) -> None:
    """Write the shipped recordings and the rig of the second one, replacing existing files.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
        BagError: a recording cannot be written.
        RigFileError: the rig cannot be written.
    """
    people = needed_makehuman()
    scene = DepthScene(held_out(people, 1), "reaching", 1, colour_camera(_WIDTH // 2), still=True)
    messages = camera_messages(scene, SECONDS, truth=True)
    write_bag(bags / SHIPPED, {**camera_topics(), **TRUTH}, messages, overwrite=True)
    turning = DepthScene(held_out(people, 3), "torso_twist", 3, colour_camera(_WIDTH // 4))
    poses = [pose_around(f"camera{number + 1}", angle) for number, angle in enumerate(_AROUND)]
    save_rig(rig_of(poses, colour_camera(_WIDTH)), rig_folder / setup.RIG)
    write_pair_bag(turning, poses, bags / SHIPPED_PAIR, PAIR_SECONDS)
    for name in (SHIPPED, SHIPPED_PAIR):
        print_bag(bags / name, "images")


def pose_around(camera: str, angle: float) -> SensorPose:
    """The pose in ``world`` of a camera that looks at the scene's person from an azimuth in radians."""
    level = level_pose(camera, _HEIGHT, _PITCH)
    turned = so3.quat_multiply(so3.exp(np.array([0.0, 0.0, angle])), level.quat_xyzw)
    place = np.array([_PERSON - _AWAY * np.cos(angle), -_AWAY * np.sin(angle), _HEIGHT])
    return SensorPose(camera, place, turned)


def rig_of(poses: Sequence[SensorPose], camera: Camera) -> Rig:
    """The rig of equal cameras at these poses, in the frame of the first one, with zero covariance."""
    first = poses[0]
    rotations = np.array([pose.rotation.T @ first.rotation for pose in poses])
    translations = np.array([pose.rotation.T @ (first.translation - pose.translation) for pose in poses])
    cameras = tuple(replace(camera, frame_id=optical_frame(pose.sensor)) for pose in poses)
    size = len(cameras) * (LENS + len(camera.distortion) + POSE)
    return Rig(cameras, rotations, translations, np.zeros((size, size)))


def write_pair_bag(scene: DepthScene, poses: Sequence[SensorPose], folder: Path, seconds: float) -> None:
    """Write colour images of a scene from several cameras as a bag, replacing an existing one; progress on stderr.

    Raises:
        BagError: it cannot be written.
    """
    painters = {
        DRIVERS["plain"].of(pose.sensor).colour + COMPRESSED: Painter.of(scene, colour_camera(_WIDTH), pose)
        for pose in poses
    }

    def messages() -> Iterator[Message]:
        yield _true_pose(replace(poses[0], sensor=RIG_SENSOR))
        progress = Progress(0, round(seconds * RATE) // EVERY)
        for index, frame in enumerate(scene.frames(_PAIR_FROM, _PAIR_FROM + seconds, EVERY)):
            stamp_ns, log_ns = capture_times(frame.time - _PAIR_FROM)
            for topic, painter in painters.items():
                taken = (stamp_ns, optical_frame(painter.pose.sensor), painter.image(frame))
                yield log_ns, topic, CompressedColour().encode(taken, BAG_WIRE)
            yield from truth_of(scene, frame, stamp_ns, log_ns)
            progress.at(index)
        progress.end()

    topics = {**dict.fromkeys(painters, (COMPRESSED_IMAGE, IMAGES)), **TRUTH}
    write_bag(folder, topics, messages(), overwrite=True)


def _true_pose(pose: SensorPose) -> Message:
    return RECEIVED_FROM_NS, graph.TRUE_CALIBRATION, serialize(pose_to_transform(pose, WORLD, BAG_MESSAGES))


def camera_topics() -> dict[str, tuple[str, Qos]]:
    """The topics of a colour-and-depth camera, by its driver's names."""
    names = DRIVERS["plain"].of(CAMERA)
    return {
        names.colour + COMPRESSED: (COMPRESSED_IMAGE, IMAGES),
        names.colour_info: (CAMERA_INFO, LATCHED),
        names.depth: (IMAGE, IMAGES),
        names.depth_info: (CAMERA_INFO, LATCHED),
    }


def camera_messages(scene: DepthScene, seconds: float, *, truth: bool) -> Iterator[Message]:
    """The images of a colour-and-depth camera, with progress on stderr; ``truth``: also the ground truth."""
    painter, names = Painter.of(scene, colour_camera(_WIDTH)), DRIVERS["plain"].of(CAMERA)
    for topic, camera in ((names.colour_info, painter.camera), (names.depth_info, scene.camera)):
        yield RECEIVED_FROM_NS, topic, CameraInfo().encode((START_NS, camera), BAG_WIRE)
    if truth:
        yield _true_pose(scene.pose)
    progress = Progress(0, round(seconds * RATE) // EVERY)
    for index, frame in enumerate(scene.frames(0.0, seconds, EVERY)):
        stamp_ns, log_ns = capture_times(frame.time)
        taken = (stamp_ns, painter.camera.frame_id, painter.image(frame))
        yield log_ns, names.colour + COMPRESSED, CompressedColour().encode(taken, BAG_WIRE)
        depth = (stamp_ns, scene.camera.frame_id, frame.image)
        yield log_ns, names.depth, DepthImage().encode(depth, BAG_WIRE)
        if truth:
            yield from truth_of(scene, frame, stamp_ns, log_ns)
        progress.at(index)
    progress.end()

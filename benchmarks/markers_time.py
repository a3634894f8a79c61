"""Time from a pair of images to joint angles: computation alone, and through the live nodes.

Two scenes of three targets in front of two cameras of 640x480, with the usual noise: targets that swing a metre away,
whose balls stay apart in the images; and the arm of the shipped recording, 1.7 m away, whose balls often touch.

- computation: of each pair, tracked and from scratch, without messages: median and 99 %, ms of this machine, and as
  multiples of the reference: ``cv2.GaussianBlur`` of the same two images (sigma 2), pair by pair in the same run.
  ``cpu`` is processor time; other work on the machine changes it less.
- live: reliable images at 60 Hz through the graph's nodes, from just before the left image is published until the
  angles are received, by one clock; number of pairs without angles. ``--no-live`` leaves this part out.

The exit code is 1 if a bar is missed.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import common
import cv2
import live
import markers_lab as lab
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Image
from target_points import random_rotation

from body_tracking.core.parameters import check_all
from body_tracking.core.qos import Qos
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import setup
from body_tracking.markers.chain import Chain
from body_tracking.markers.chain_files import save_chain
from body_tracking.markers.codecs import CameraImage
from body_tracking.markers.joint_model import SIZE, Joint, JointKind, axis_frame, conventional
from body_tracking.markers.joint_tree import Posture, place, tree_of
from body_tracking.markers.rendering import Sensor
from body_tracking.markers.rig_storage import save_rig
from body_tracking.markers.stages import AnglesOfTargetsStage, DetectorStage, TrackerStage, TriangulationStage
from body_tracking.markers.targets_file import save_targets
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now, Stage
from body_tracking.recording.rosbag2 import BAG_WIRE
from body_tracking.simulation.marker_bags import SEED, images
from body_tracking.simulation.marker_scene import MarkerScene, make_targets, marker_scene, stereo_rig

RATE, FRAMES = 60.0, 60
BARS_MS = {"median": 4.0, "p99": 10.0, "scratch": 8.0}
LIVE_BARS_MS = {"median_ms": 12.0, "p95_ms": 25.0}
IMAGES = Qos(reliability="reliable", depth=10)
STEPS = ("detection", "triangulation", "tracking", "angles", "afterwards")


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Images of a scene, a pair per frame; frame ids of the two cameras; folder of its setup."""

    images: Sequence[tuple[NDArray[Any], NDArray[Any]]]
    frames: tuple[str, str]
    folder: Path


def apart(rng: np.random.Generator) -> MarkerScene:
    """Three targets side by side at a metre, turned so that their balls are apart; they swing by 6 degrees."""
    rig, bodies = stereo_rig(), make_targets()
    places = lab.before(1.0) + np.array([[-0.2, 0.0, 0.0], [0.0, 0.0, 0.0], [0.2, 0.0, 0.0]])
    rest = np.stack([widest(rig.project, body.points, place, rng) for body, place in zip(bodies, places, strict=True)])
    joints: list[Joint] = []
    turns = []
    times = np.arange(FRAMES) / RATE
    swing = np.radians(6.0) * np.sin(2.0 * np.pi * np.array([[0.5], [0.7], [0.9]]) * times).T
    for index, kind in enumerate((JointKind.BALL, JointKind.HINGE)):
        middle = 0.5 * (places[index] + places[index + 1])
        own, other = (rest[k].T @ (middle - places[k]) for k in (index, index + 1))
        frames = [np.eye(3), np.eye(3)]
        if kind is JointKind.HINGE:
            axis = np.array([0.0, 0.0, 1.0])
            frames = [axis_frame(rest[k].T @ axis, c) for k, c in ((index, own), (index + 1, other))]
        names = bodies[index].name, bodies[index + 1].name
        joint = Joint(f"joint{index}", *names, kind, frames[0], own, frames[1], other, np.zeros((SIZE, SIZE)))
        joints.append(conventional(joint)[0])
        base = joints[-1].parent_rotation.T @ rest[index].T @ rest[index + 1] @ joints[-1].child_rotation
        about = swing if kind is JointKind.BALL else swing[:, :1] * np.array([0.0, 0.0, 1.0])
        turns.append(Rotation.from_rotvec(about).as_matrix() @ base)
    posture = Posture(np.tile(rest[0], (FRAMES, 1, 1)), np.tile(places[0], (FRAMES, 1)), tuple(turns))
    rotations, translations = place(tree_of(joints), posture)
    return MarkerScene(rig, bodies, times, rotations, translations, swing[:, :2], chain_of(joints))


def widest(project: Any, points: FloatArray, where: FloatArray, rng: np.random.Generator) -> FloatArray:
    """The rotation with the widest gaps between the balls in both images, of 500 random ones."""

    def gap(rotation: FloatArray) -> float:
        pixels = project(points @ rotation.T + where)
        rows, columns = np.triu_indices(len(points), 1)
        return float(np.linalg.norm(pixels[:, rows] - pixels[:, columns], axis=-1).min())

    return max((random_rotation(rng) for _ in range(500)), key=gap)


def chain_of(joints: Sequence[Joint]) -> Chain:
    """Joints with 0.03 mm and about 0.002 degrees; zero sensitivities to the calibration, which take as long."""
    size = SIZE * len(joints)
    return Chain(tuple(joints), 1e-9 * np.eye(size), np.zeros((size, 30)))


def prepared(scene: MarkerScene, folder: Path, seed: int) -> Pairs:
    """Render a scene, and write its setup with a rig as calibrated with boards."""
    save_rig(lab.calibrated(scene.rig, np.random.default_rng(seed)), folder / setup.RIG)
    save_targets(scene.targets, folder / setup.TARGETS)
    save_chain(chain_of(scene.chain.joints), folder / setup.CHAIN)
    made = [images(scene, index, Sensor(), seed) for index in range(len(scene.times))]
    left, right = (camera.frame_id for camera in scene.rig.cameras)
    return Pairs([(one, other) for one, other in made], (left, right), folder)


# --- computation


def stages(folder: Path) -> list[Stage]:
    """The four stages, without a deadline."""
    made = (DetectorStage, TriangulationStage, TrackerStage, AnglesOfTargetsStage)
    given = {"setup": str(folder), "deadline": 1.0}
    return [
        stage(check_all(stage.PARAMETERS, {k: v for k, v in given.items() if k in {p.name for p in stage.PARAMETERS}}))
        for stage in made
    ]


def through(chain: Sequence[Stage], pairs: Pairs, index: int, stamp_ns: int) -> tuple[FloatArray, bool]:
    """(5, 2) seconds of wall and processor time for a pair, and whether it gave angles.

    Each row ends at the stage's last output; the last row is the work of the triangulation after it (it watches the
    rig), for which no other stage waits.
    """
    payloads: list[tuple[str, Any]] = [
        (setup.image_topic(frame), (stamp_ns, frame, image))
        for frame, image in zip(pairs.frames, pairs.images[index], strict=True)
    ]
    spent = np.zeros((len(chain) + 1, 2))
    for number, stage in enumerate(chain):
        taken = {port.topic for port in stage.inputs}
        payloads = [each for each in payloads if each[0] in taken]
        begin, given, outputs = clocks(), None, []
        for topic, payload in payloads:
            for out in stage.take(topic, payload, Now(stamp_ns, stamp_ns)):
                outputs.append((out.topic, out.payload))
                if stage is chain[1]:
                    given = clocks()
        end = clocks()
        spent[number] = end - begin
        if given is not None:
            spent[-1] = end - given
            spent[number] -= spent[-1]
        payloads = outputs
    return spent, bool(payloads)


def clocks() -> FloatArray:
    """(2,) seconds of wall and processor time; in a virtual machine a call may itself take 0.2 ms."""
    return np.array([time.perf_counter(), time.thread_time()])


def computation(pairs: Pairs) -> dict[str, Any]:
    """Times of all pairs, tracked (to and fro through the recording) and from scratch, and of the reference."""
    chain, period = stages(pairs.folder), round(NANOSECONDS / RATE)
    count = len(pairs.images)
    for index in range(5):  # for compilation and loading
        through(chain, pairs, index, index * period)
    tracked, scratch, reference, came = [], [], [], 0
    order = [*range(5, count), *range(count - 1, -1, -1)]
    for number, index in enumerate(order, 5):
        spent, found = through(chain, pairs, index, number * period)
        tracked.append(spent)
        came += found
        begin = time.perf_counter(), time.thread_time()
        for image in pairs.images[index]:
            cv2.GaussianBlur(image, (0, 0), 2.0)
        reference.append((time.perf_counter() - begin[0], time.thread_time() - begin[1]))
    for index in range(0, count, 3):
        for stage in chain:
            stage.reset("")
        scratch.append(through(chain, pairs, index, index * period)[0])
    wall, again, blur = 1e3 * np.array(tracked), 1e3 * np.array(scratch), 1e3 * np.array(reference)
    total, again = wall[:, :-1].sum(axis=1), again[:, :-1].sum(axis=1)
    return {
        "median": float(np.median(total[:, 0])),
        "p99": float(np.percentile(total[:, 0], 99)),
        "scratch": float(np.median(again[:, 0])),
        "cpu median": float(np.median(total[:, 1])),
        "cpu p99": float(np.percentile(total[:, 1], 99)),
        "cpu scratch": float(np.median(again[:, 1])),
        "reference": float(np.median(blur[:, 0])),
        "cpu reference": float(np.median(blur[:, 1])),
        "steps": {name: float(np.median(wall[:, number, 1])) for number, name in enumerate(STEPS)},
        "angles": came / len(order),
    }


# --- live


def measured_live(pairs: Pairs, seconds: float, warm_up: float) -> dict[str, Any]:
    """Delays from publishing the left image to receipt of the angles."""
    topics = [setup.image_topic(frame) for frame in pairs.frames]
    messages = [
        [
            bytearray(CameraImage().encode((0, frame, image), BAG_WIRE))
            for frame, image in zip(pairs.frames, both, strict=True)
        ]
        for both in pairs.images
    ]

    def events() -> Iterator[live.Event]:
        there = [*range(len(messages)), *range(len(messages) - 2, 0, -1)]
        for number, index in enumerate(itertools.cycle(there)):
            for topic, message in zip(topics, messages[index], strict=True):
                yield number / RATE, topic, message

    bench = live.Bench("markers_time")
    for topic in topics:
        bench.publisher(topic, Image, IMAGES)
    bench.time("angles", graph.joint_states_topic(setup.BODY))
    with live.graph_of(bench, dict.fromkeys(topics, 1), sensors=(), marker_setup=str(pairs.folder)):
        until = itertools.takewhile(lambda event: event[0] < warm_up + seconds, events())
        late = bench.publish(until, {topics[0]: "angles"}, warm_up)
        time.sleep(1.0)
    delays, lost = bench.delays_ms("angles")
    found = (
        live.percentiles(delays, "the graph", 95)
        if len(delays)
        else {"median_ms": np.inf, "p95_ms": np.inf, "frames": 0}
    )
    return {**found, "lost": lost, "sending late, median ms": float(np.median(late))}


# --- the command


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__)
    parser.add_argument("--no-live", action="store_true", help="computation alone")
    parser.add_argument("--seconds", type=float, default=60.0, metavar="S", help="live (default: %(default)s)")
    args = parser.parse_args()
    cv2.setNumThreads(1)
    figures: dict[str, Any] = {}
    arm = marker_scene("random", SEED, RATE, FRAMES / RATE, 15.0)
    with tempfile.TemporaryDirectory() as temporary:
        made = {}
        for name, scene in (("balls apart", apart(np.random.default_rng(7))), ("the arm", arm)):
            folder = Path(temporary) / name.replace(" ", "_")
            folder.mkdir()
            common.progress(f"{name}: rendering")
            made[name] = prepared(scene, folder, 3)
            common.progress(f"{name}: computation")
            figures[name] = {"computation": computation(made[name])}
        if not args.no_live:
            for name, pairs in made.items():
                common.progress(f"{name}: live")
                figures[name]["live"] = measured_live(pairs, args.seconds, 3.0)
    common.report(args, figures)
    row = figures["balls apart"]["computation"]
    met = {f"balls apart, {key} {row[key]:.2f} ms, at most {bar:g}": row[key] <= bar for key, bar in BARS_MS.items()}
    if not args.no_live:
        found = figures["balls apart"]["live"]
        met |= {f"live, {key} {found[key]:g}, at most {bar:g}": found[key] <= bar for key, bar in LIVE_BARS_MS.items()}
        met[f"live, {found['lost']} pairs lost of {found['lost'] + found['frames']}"] = found["lost"] == 0
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

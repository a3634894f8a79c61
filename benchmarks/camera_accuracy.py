"""Two colour-and-depth cameras to joint angles, beside two Kinects, on simulated people on whom nothing was tuned.

Both stand as in layout 4 of Schlagenhauf (2017): 2 m from the person, 45 degrees to each side. Kinects are simulated as
in ``accuracy.py``, 30 frames a second; cameras see rendered images of 640x480 pixels, 15 a second, with the depth
errors of a Kinect v2. Calibration, fusion and filter are those of the graph at its defaults.

network    the network's landmarks in the rendered images.
published  the same with other pixels: each landmark is at the projection of the true joint, plus an error as published
           for photographs. The error is normal; its standard deviation gives the share of landmarks within a fifth of
           the torso's diagonal (PCK@0.2) that the authors of BlazePose Full state, mean of their three sets of
           images. Half of its variance persists per person and camera, the other half has a time constant of half a
           second: both are assumptions.

``joints``: mean 3D error of the joints of one sensor's skeleton, mm; ``inside``: the share of true joints inside its
stated 95 % ellipsoids. The errors of ten joints of the filtered skeleton are as in ``accuracy.py``: mean 3D error, mm,
and without each joint's constant offset. Then of the published angles (convention ``positional`` of the default filter,
``isb`` of ``ekf``): RMSE of elevation and elbow flexion, the median stated deviation, both in degrees, and the share of
frames with errors within 1.96 of it. ``--write`` writes the section of docs/accuracy.md.
"""

from __future__ import annotations

import sys
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import common
import numpy as np
from accuracy import DEFAULT, OURS, compared
from camera_skeleton import INSIDE, MOTIONS, Placed
from mesh_runs import people, wheel
from offline_graph import play

from body_tracking.camera.lifting import Lifted, lift
from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import Landmark, Landmarks, PoseModel
from body_tracking.core.camera import Camera
from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import BONE_CORRELATION
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray, Joint, Skeleton, TrackingState
from body_tracking.core.so3 import wrapped
from body_tracking.core.sources import RecordedFrame, optical_frame
from body_tracking.evaluation.metrics import Curve
from body_tracking.filters import DEFAULT_FILTER
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.kinematics.positional import positional_angles
from body_tracking.mesh.depth import to_metres
from body_tracking.messages.base import to_nanoseconds
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.pipeline import graph
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import deserialize
from body_tracking.simulation.colour_images import Painter, colour_camera
from body_tracking.simulation.depth_scene import RATE, DepthFrame, held_out
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS

KINECTS, NETWORK, PUBLISHED = "two Kinects", "network", "published"
FILTERS = {DEFAULT: DEFAULT_FILTER, OURS: "ekf"}
_FIRST_SEED = 20
PCK = 0.955, 0.963, 0.957
"""BlazePose Full: share of landmarks within a fifth of the torso's diagonal, in images of yoga, dance and HIIT (Google,
MediaPipe Pose, "Pose estimation quality")."""
PER_TORSO = 0.2 / float(np.sqrt(-2.0 * np.log(1.0 - np.mean(PCK))))
"""Standard deviation per axis of a normal error with this share, in torso lengths."""
PERSISTENT, TIME_CONSTANT = 0.5, 0.5
"""Persistent share of the variance, and time constant of the rest, seconds."""
DELAY_NS = round(0.06 * NANOSECONDS)
"""Delay from capture to receipt of the skeleton."""
COLUMNS = {
    "error": "error",
    "fixed": "without offsets",
    "elevation": "elevation",
    "stated_elevation": "stated",
    "covered_elevation": "covered",
    "elbow": "elbow",
    "stated_elbow": "stated",
    "covered_elbow": "covered",
}


ARMS = ("shoulder_elevation_left", "shoulder_elevation_right", "elbow_flexion_left", "elbow_flexion_right")


class Angles(NamedTuple):
    """(n, 4) published angles of ``ARMS`` and their stated deviations, radians, and (n,) stamps."""

    position: FloatArray
    stddev: FloatArray
    stamps_ns: IntArray


class PublishedErrors:
    """Landmarks at the true joints with errors as published, for one person and camera."""

    def __init__(self, seed: int, number: int) -> None:
        self._rng = np.random.default_rng([seed, number, 2006])
        shape = len(Landmark), 2
        self._constant, self._slow = self._rng.normal(size=shape), self._rng.normal(size=shape)
        self._time: float | None = None

    def of(self, found: Landmarks, frame: DepthFrame, camera: Camera) -> Landmarks:
        """``found`` with pixels at the true joints plus errors."""
        kept = 0.0 if self._time is None else np.exp(-(frame.time - self._time) / TIME_CONSTANT)
        fresh = self._rng.normal(size=self._slow.shape)
        if self._time is not None:
            self._slow = kept * self._slow + np.sqrt(1.0 - kept**2) * fresh
        self._time = frame.time
        places = marked(frame.joints)
        torso = float(np.linalg.norm(frame.joints[Joint.SHOULDER_RIGHT] - frame.joints[Joint.HIP_LEFT]))
        size = PER_TORSO * torso * float(camera.matrix[0, 0]) / float(frame.joints[Joint.SPINE_MID, 2])
        error = np.sqrt(PERSISTENT) * self._constant + np.sqrt(1.0 - PERSISTENT) * self._slow
        pixels = camera.project(places) + size * error
        return replace(found, pixels=np.where(np.isfinite(pixels), pixels, found.pixels))


def marked(joints: FloatArray) -> FloatArray:
    """(33, 3) positions of landmarks at joints (25, 3); NaN for landmarks that mark no joint, such as of the face."""
    places = np.full((len(Landmark), 3), np.nan)
    for side in ("LEFT", "RIGHT"):
        for name in ("SHOULDER", "ELBOW", "WRIST", "HIP", "KNEE", "ANKLE"):
            places[Landmark[f"{name}_{side}"]] = joints[Joint[f"{name}_{side}"]]
        places[Landmark[f"TOES_{side}"]] = joints[Joint[f"FOOT_{side}"]]
        places[Landmark[f"EAR_{side}"]] = joints[Joint.HEAD]
        # the hand joint is assumed at the mean of wrist and two fingers
        fingers = 0.5 * (3.0 * joints[Joint[f"HAND_{side}"]] - joints[Joint[f"WRIST_{side}"]])
        places[Landmark[f"INDEX_FINGER_{side}"]] = places[Landmark[f"LITTLE_FINGER_{side}"]] = fingers
    return places


def seen_by_cameras(
    views: Sequence[Placed], model: PoseModel, seconds: float, step: int
) -> tuple[dict[str, list[RecordedFrame]], dict[str, dict[str, float]]]:
    """Frames of both cameras by network and by published errors, and the figures of the cameras' own skeletons."""
    frames: dict[str, list[RecordedFrame]] = {NETWORK: [], PUBLISHED: []}
    errors: dict[str, list[FloatArray]] = {name: [] for name in frames}
    distances: dict[str, list[FloatArray]] = {name: [] for name in frames}
    for view in views:
        sensor = f"camera{view.number + 1}"
        tracker, painter, published = (
            PersonTracker(model, 1, 0.3),
            Painter.of(view),
            PublishedErrors(view.seed, view.number),
        )
        for frame in view.frames(0.0, seconds, step):
            at_ns = round(frame.time * NANOSECONDS)
            people = list(tracker.update(at_ns, painter.image(frame)).values())
            if not people:
                continue
            found = {NETWORK: people[0], PUBLISHED: published.of(people[0], frame, view.camera)}
            for name, landmarks in found.items():
                lifted = lift(landmarks, to_metres(frame.image), view.camera)
                if lifted is None:
                    continue
                skeleton = lifted.skeleton(START_NS + at_ns, optical_frame(sensor))
                frames[name].append(RecordedFrame(sensor, RECEIVED_FROM_NS + at_ns + DELAY_NS, (skeleton,)))
                off, distance = errors_of(lifted, frame.joints)
                errors[name].append(off)
                distances[name].append(distance)
    own = {}
    for name, each in frames.items():
        each.sort(key=lambda frame: (frame.received_ns, frame.sensor))
        squares = np.concatenate(distances[name])
        own[name] = {
            "joints": 1e3 * float(np.linalg.norm(np.concatenate(errors[name]), axis=1).mean()),
            "inside": float((squares < INSIDE).mean()),
            "NEES": float(squares.mean() / 3.0),
        }
    return frames, own


def errors_of(lifted: Lifted, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3) errors of the known joints, metres, and (n,) their squared Mahalanobis distances."""
    known = np.isfinite(lifted.positions).all(axis=1)
    off = (lifted.positions - true)[known]
    squares = np.einsum("ji,jik,jk->j", off, np.linalg.inv(lifted.covariances[known]), off)
    return off, np.asarray(squares)


def seen_by_kinects(
    views: Sequence[Placed], times: FloatArray, true: FloatArray
) -> tuple[list[RecordedFrame], dict[str, float]]:
    """Frames of Kinects at the cameras' poses, and the mean error of their own skeletons' joints."""
    frames: list[RecordedFrame] = []
    sizes = []
    misreading = Misreading.draw(np.random.default_rng([views[0].seed, 6]))
    for view in views:
        sensor = SimulatedKinect(view.pose, ClockModel(anchor_ns=START_NS))
        rng = np.random.default_rng([view.seed, zlib.crc32(view.motion.encode()), 3, view.number])
        positions, states = sensor.see(times, true, view.who.person.capsules(), rng, misreading)
        optical = (true - view.pose.translation) @ view.pose.rotation
        sizes.append(np.linalg.norm(positions - optical, axis=2)[states > 0])
        frames += sensor.deliver(times, {0: (positions, states)}, START_NS, RECEIVED_FROM_NS, rng)
    frames.sort(key=lambda frame: (frame.received_ns, frame.sensor))
    own = {"joints": 1e3 * float(np.concatenate(sizes).mean()), "inside": float("nan"), "NEES": float("nan")}
    return frames, own


def figures_of(job: tuple[str, int, float, int]) -> dict[str, dict[str, float]]:
    """All figures by kind of sensor and filter, for one person in one motion."""
    motion, seed, seconds, step = job
    who = held_out(people(), seed)
    views = [Placed(who, motion, seed, colour_camera(), number=number) for number in (0, 1)]
    seconds = min(seconds, views[0].movement.duration)
    times = np.arange(int(seconds * RATE)) / RATE
    course = views[0].course(times)
    true = np.array([who.posed(course, index)[1] for index in range(len(times))])
    frames, own = seen_by_cameras(views, PoseModel(default_folder()), seconds, step)
    frames[KINECTS], own[KINECTS] = seen_by_kinects(views, times, true)
    curve = Curve(times, true)
    found: dict[str, dict[str, float]] = {}
    for name in (KINECTS, NETWORK, PUBLISHED):
        sensors = tuple(dict.fromkeys(frame.sensor for frame in frames[name]))
        others = () if name == KINECTS else sensors
        of_bones = BONE_CORRELATION if name == KINECTS else 0.0  # as `up` sets the parameters
        outputs: dict[str, list[Skeleton]] = {}
        published: dict[str, Angles] = {}
        for label, filter_name in FILTERS.items():
            settings = ReplaySettings(
                tuple(sorted(sensors)),
                filter_name=filter_name,
                convention="isb" if label == OURS else graph.POSITIONAL,
                parameters={
                    "skeleton_filter": {"not_kinects": others, "ekf.bone_correlation": of_bones},
                    "joint_angles": {"bone_correlation": of_bones},
                },
            )
            outputs[label], published[label] = run_graph(settings, frames[name])
        begin = max(each[0].stamp_ns for each in outputs.values())
        for label, skeletons in outputs.items():
            some = [each for each in skeletons if each.stamp_ns >= begin]
            poses = [view.pose for view in views]
            figures = compared(some, poses, who.person.capsules(), curve, START_NS)
            positions = {key: getattr(figures, key) for key in ("error", "fixed")}
            arms = figures_of_angles(published[label], begin, curve)
            found[f"{name}, {label}"] = {**own[name], **positions, **arms}
    return found


def run_graph(settings: ReplaySettings, frames: Sequence[RecordedFrame]) -> tuple[list[Skeleton], Angles]:
    """Filtered skeletons, and published angles of the arms, of the graph from its sensors' frames."""
    skeletons: list[Skeleton] = []
    values: tuple[dict[int, FloatArray], dict[int, FloatArray]] = {}, {}
    topics = graph.joint_states_topic(graph.DEFAULT_BODY), graph.joint_states_stddev_topic(graph.DEFAULT_BODY)

    def take(topic: str, cdr: bytes, _at_ns: int) -> None:
        if topic == graph.FILTERED:
            skeletons.extend(decode_skeletons(cdr) or ())
        elif topic in topics:
            message = deserialize(JOINT_STATE, cdr)
            names = [name.removesuffix(f"_{graph.DEFAULT_BODY}") for name in message.name]
            values[topics.index(topic)][to_nanoseconds(message.header.stamp)] = np.array(
                [message.position[names.index(name)] for name in ARMS]
            )

    play(settings, frames, take)
    stamps = sorted(values[0].keys() & values[1].keys())
    return skeletons, Angles(*(np.array([each[stamp] for stamp in stamps]) for each in values), np.array(stamps))


def figures_of_angles(angles: Angles, begin_ns: int, curve: Curve) -> dict[str, float]:
    """RMSE of the published angles, degrees, and the shares of errors within 1.96 stated deviations."""
    times = (angles.stamps_ns - START_NS) / NANOSECONDS
    here = (angles.stamps_ns >= begin_ns) & (times >= curve.span[0]) & (times <= curve.span[1])
    tracked = np.full(len(Joint), TrackingState.TRACKED, dtype=np.uint8)
    true = np.array(
        [
            [each.position[each.names.index(name)] for name in ARMS]
            for each in (positional_angles(Skeleton(0, "world", at, tracked)) for at in curve.at(times[here]))
        ]
    )
    found_angles, stddev = angles.position[here].copy(), angles.stddev[here]
    found_angles[:, :2] = np.abs(found_angles[:, :2])  # elevations by ISB are negative
    off = wrapped(found_angles - true)
    known = np.isfinite(off) & np.isfinite(stddev)
    found = {}
    for kind, columns in (("elevation", slice(0, 2)), ("elbow", slice(2, 4))):
        each, sure, there = off[:, columns], stddev[:, columns], known[:, columns]
        found[kind] = common.rms_deg(each)
        found[f"covered_{kind}"] = float((np.abs(each) <= common.NORMAL * sure)[there].mean())
        found[f"stated_{kind}"] = float(np.degrees(np.median(sure[there])))
        found[f"known_{kind}"] = float(there.mean())
    return found


def table(results: Sequence[dict[str, dict[str, float]]]) -> dict[str, dict[str, common.Mean]]:
    """Means over all runs."""
    return {
        name: {key: common.Mean.of(each[name][key] for each in results) for key in row}
        for name, row in results[0].items()
    }


def section(means: dict[str, dict[str, common.Mean]]) -> list[str]:
    """Lines of the table in docs/accuracy.md."""
    lines = [
        "| | joints of one sensor | inside 95 % | " + " | ".join(COLUMNS.values()) + " |",
        "|---|" + "---:|" * (2 + len(COLUMNS)),
    ]
    for name, row in means.items():
        cells = []
        for key in ("joints", "inside", *COLUMNS):
            mean, digits = row[key], 2 if key.startswith(("inside", "covered")) else 1
            cells.append("-" if np.isnan(mean.value) else f"{mean.value:.{digits}f} ± {mean.half:.{digits}f}")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__, seeds=2, motions=MOTIONS, jobs=True)
    parser.add_argument("--seconds", type=float, default=16.0, help="of each motion, at most (16)")
    parser.add_argument("--step", type=int, default=2, metavar="N", help="cameras take every n-th image of 30 (2)")
    parser.add_argument("--write", action="store_true", help="write the table of docs/accuracy.md")
    args = parser.parse_args()
    wheel()
    jobs = [
        (motion, _FIRST_SEED + seed, args.seconds, args.step) for motion in args.motions for seed in range(args.seeds)
    ]
    results = common.mapped(figures_of, jobs, args.jobs)
    means = table(results)
    runs = {f"{motion} {seed}": each for (motion, seed, *_), each in zip(jobs, results, strict=True)}
    common.report(args, {"means": means, "runs": runs}, unshown=("runs",))
    if args.write:
        common.write_section(common.ROOT / "docs" / "accuracy.md", "cameras", "camera_accuracy.py", section(means))
    met = {}
    for name, row in means.items():
        if not name.startswith(KINECTS):
            for key in ("inside", "covered_elevation", "covered_elbow"):
                share = 100.0 * row[key].value
                met[f"{name}: {key} {share:.1f} %, 90 to 99"] = 90.0 <= share <= 99.0
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

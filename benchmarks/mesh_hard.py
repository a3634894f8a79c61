"""The mesh in hard cases: fast motion, people who walk in, and motions that a Kinect's skeleton hides.

``fast``: motions at three times the speed; ``punching`` has no bar, its hands exceed 7 m/s. Errors of shoulders, elbows
and wrists, millimetres; ``floor`` is the fit of every tenth image, started at the true joints. An image is lost if it
has no skeleton, or if the mean error of these joints exceeds 100 mm. It is flagged if it has no skeleton, or if every
joint with an error of more than 150 mm is inferred. ``longest`` is the duration of the longest run of lost images.

``walk in``: people walk in from a side, with the arms in any posture, and turn to the camera. ``within`` is the share
of people who are tracked, with a mean error of these joints below 100 mm, within a second after all these joints, head
and base of the spine are in the image.

``bend``, ``shrug``: the trunk bends to both sides, or both shoulders are lifted repeatedly; by the mesh's skeleton, by
that of the simulated Kinect, and by the angles of the filter ``ekf`` behind each. RMS errors after 3 s, without the
constant part: of the bend between lower and upper trunk by SpineBase, SpineMid and SpineShoulder, degrees; of a
shoulder's height over SpineShoulder along the trunk, millimetres; of the filter's angles, degrees. ``floor`` is the fit
of every tenth image, started at the true joints.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import common
import numpy as np
from common import mapped, report, rms, rms_deg, verdicts
from mesh_runs import (
    ARMS,
    ekf_stage,
    fed,
    fit_from_truth,
    kinect_skeletons,
    mesh_stage,
    people,
    scene_of,
    skeleton_of,
    wheel,
)

from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.topics import depth_topic, mesh_sensor
from body_tracking.pipeline import graph
from body_tracking.pipeline.stage import Now
from body_tracking.simulation.clothed import ClothedPerson
from body_tracking.simulation.depth_scene import RATE, SENSOR, DepthScene, held_out
from body_tracking.simulation.feet import Steps, carried, standing
from body_tracking.simulation.people import MODEL, Course
from body_tracking.simulation.postures import HANGING, configuration, posture
from body_tracking.simulation.repertoire import Movement

CASES = ("fast", "walk in", "bend", "shrug")
FAST = ("reaching", "two_handed_wave", "torso_twist", "arm_raises")
_PUNCHING = "punching"
SPEED = 3.0
LOST, WRONG = 0.1, 0.15
"""Metres: mean error of the arms' joints above which an image is lost, and error above which a joint must be
inferred."""
WITHIN = 1.0
"""Seconds in which people who walk in must be tracked."""
_FLOOR = 10
_PEOPLE = 12
"""Number of different people among the starts."""
_SETTLED = 3.0
"""Seconds before the comparison of bends and shrugs: the filter has learned the joints' centres from the T-pose."""
_LATERAL = [MODEL.coordinate_names.index(f"{part}_lateral") for part in ("lumbar", "thoracic")]
_ELEVATION = [MODEL.coordinate_names.index(f"clavicle_elevation_{side}") for side in ("left", "right")]


class Job(NamedTuple):
    """One person in one case; for ``walk in`` one start."""

    case: str
    motion: str
    seed: int


# --- fast motion


@dataclass(frozen=True, slots=True, eq=False)
class FastRun:
    """Errors of one person's images, in order.

    Attributes:
        errors: (n, 6) of the arms' joints, metres; NaN without a skeleton.
        inferred: (n, 6) whether the joint is stated to be inferred.
        floor: (m, 6) metres.
        kinect: (n, 6) metres.
    """

    errors: FloatArray
    inferred: BoolArray
    floor: FloatArray
    kinect: FloatArray

    @property
    def lost(self) -> BoolArray:
        """(n,) whether the image is lost."""
        return ~(self.errors.mean(axis=1) < LOST)

    @property
    def unflagged(self) -> int:
        """Number of lost images with a skeleton that are not flagged."""
        wrong = self.errors > WRONG
        flagged = wrong.any(axis=1) & (~wrong | self.inferred).all(axis=1)
        return int((self.lost & np.isfinite(self.errors[:, 0]) & ~flagged).sum())

    @property
    def longest(self) -> float:
        """Duration of the longest run of lost images, seconds."""
        most = now = 0
        for lost in self.lost:
            now = now + 1 if lost else 0
            most = max(most, now)
        return most / RATE


def run_fast(job: Job) -> FastRun:
    """One person in one fast motion."""
    scene = scene_of(job.motion, job.seed, SPEED)
    stage, view = mesh_stage(scene), DepthCamera(scene.camera)
    errors, inferred, floor, truth = [], [], [], []
    for number, frame in enumerate(scene.frames(0.5, 6.0)):
        stamp, depth = round(frame.time * NANOSECONDS), to_metres(frame.image)
        skeleton = skeleton_of(stage, stage.take(depth_topic(SENSOR), (stamp, "", depth), Now(stamp, stamp)))
        truth.append(frame.joints)
        errors.append(_off(skeleton, frame.joints))
        inferred.append(np.ones(6, np.bool_) if skeleton is None else skeleton.states[ARMS] != TrackingState.TRACKED)
        if number % _FLOOR == 0:
            points = fit_from_truth(stage.sensor.body, view, depth, frame.person, frame.joints).points
            floor.append(np.linalg.norm((points - frame.joints)[ARMS], axis=1))
    joints = np.array(truth)
    kinect = np.linalg.norm((kinect_skeletons(scene, joints) - joints)[:, ARMS], axis=2)
    return FastRun(np.array(errors), np.array(inferred), np.array(floor), kinect)


def _off(skeleton: Skeleton | None, joints: FloatArray) -> FloatArray:
    """(6,) errors of the arms' joints, metres; NaN without a skeleton."""
    if skeleton is None:
        return np.full(len(ARMS), np.nan)
    return np.asarray(np.linalg.norm((skeleton.positions - joints)[ARMS], axis=1))


def fast_figures(runs: Sequence[FastRun]) -> dict[str, float]:
    """The figures of several runs."""
    errors = 1e3 * np.concatenate([run.errors for run in runs])
    return {
        "mean, mm": float(np.nanmean(errors)),
        "95 %, mm": float(np.nanpercentile(errors, 95)),
        "floor, mm": float(1e3 * np.concatenate([run.floor for run in runs]).mean()),
        "kinect, mm": float(1e3 * np.nanmean(np.concatenate([run.kinect for run in runs]))),
        "images": float(len(errors)),
        "lost": float(sum(run.lost.sum() for run in runs)),
        "unflagged": float(sum(run.unflagged for run in runs)),
        "longest, s": max(run.longest for run in runs),
    }


# --- motions beside the repertoire


def composed(scene: DepthScene, postures: FloatArray, times: FloatArray, walk: Walk | None = None) -> Course:
    """Course of postures (n, 35) at (n,) seconds in the person's own frame, on the spot or on a walk."""
    person, turned = scene.who.person, postures.copy()
    if walk is None:
        feet, places = standing(person, postures), np.zeros((len(times), 2))
    else:
        places, yaw = walk(times)
        feet = Steps(person, walk, 0.0, walk.end, walk.step_s).at(times)
        turned += np.degrees(yaw)[:, None] * posture(pelvis_yaw=1.0)
    q = configuration(turned)
    q[:, :2] = places
    ankles = feet.ankles(person)
    q[:, 2] = carried(person, q, ankles, np.zeros(len(times)))
    return Course(times, q, ankles, feet.toes)


@dataclass(frozen=True, slots=True)
class Walk:
    """A straight walk to a place, and a turn there.

    Attributes:
        start, end_at: (2,) metres in the person's frame at the end: x to the camera, y to the left.
        speed: m/s.
        step_s: duration of a step, seconds.
    """

    start: FloatArray
    end_at: FloatArray
    speed: float
    step_s: float

    @property
    def arrival(self) -> float:
        """Time of arrival, seconds."""
        return float(np.linalg.norm(self.end_at - self.start)) / self.speed

    @property
    def end(self) -> float:
        """Time at which the person has turned to the camera, seconds."""
        return self.arrival + 0.8

    def __call__(self, times: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Places (n, 2), metres, and headings (n,), radians."""
        way = self.end_at - self.start
        share = np.clip(times / self.arrival, 0.0, 1.0)
        heading = float(np.arctan2(way[1], way[0]))
        turned = np.clip((times - self.arrival + 0.4) / 0.8, 0.0, 1.0)
        return self.start + share[:, None] * way, heading * (1.0 - turned * turned * (3.0 - 2.0 * turned))


@dataclass(frozen=True, slots=True, eq=False)
class Performed(DepthScene):
    """A scene with a motion of one of the cases below; ``motion`` is its name."""

    @property
    def movement(self) -> Movement:
        """The person's performance."""
        rng = np.random.default_rng([self.seed, CASES.index(self.motion), 31])
        if self.motion == "walk in":
            walk = self.walk()
            swing = posture(swing_left=20.0) - posture(swing_right=20.0)
            held = HANGING + _any_arms(rng)
            return Movement(
                self.motion,
                walk.end + 1.0,
                0.0,
                lambda times: composed(self, held + np.sin(np.pi * times / walk.step_s)[:, None] * swing, times, walk),
            )
        tpose, move = posture(elevation=88.0, plane=3.0, elbow=6.0), _MOVES[self.motion] * rng.uniform(0.85, 1.1)
        period = rng.uniform(2.2, 3.0)

        def postures(times: FloatArray) -> FloatArray:
            entered = np.clip((times - 1.5) / 1.0, 0.0, 1.0)[:, None]
            phase = 2.0 * np.pi * np.maximum(times - 2.5, 0.0) / period
            lean, both = np.sin(phase), 0.5 * (1.0 - np.cos(phase))
            wave = lean if self.motion == "bend" else both
            return tpose + entered * (HANGING - tpose) + wave[:, None] * move

        return Movement(self.motion, 9.0, 1.5, lambda times: composed(self, postures(times), times))

    def walk(self) -> Walk:
        """The walk of ``walk in``."""
        rng = np.random.default_rng([self.seed, 32])
        side = rng.choice([-1.0, 1.0])
        start = np.array([rng.uniform(-0.6, 0.6), side * rng.uniform(2.1, 2.5)])
        return Walk(start, rng.uniform(-0.4, 0.4, 2), float(rng.uniform(0.7, 1.1)), float(rng.uniform(0.5, 0.55)))


_MOVES = {"bend": posture(trunk_lateral=28.0, pelvis_lateral=3.0), "shrug": posture(shrug=24.0, elbow=4.0)}


def _any_arms(rng: np.random.Generator) -> FloatArray:
    """(35,) added to hanging arms: zero for a third of the people, else random arms in front or beside."""
    if rng.random() < 1.0 / 3.0:
        return posture()
    return sum(
        (
            posture(
                **{
                    f"elevation_{side}": rng.uniform(0.0, 60.0),
                    f"plane_{side}": rng.uniform(0.0, 70.0),
                    f"elbow_{side}": rng.uniform(0.0, 90.0),
                    f"pronation_{side}": rng.uniform(0.0, 60.0),
                }
            )
            for side in ("left", "right")
        ),
        posture(),
    )


# --- people who walk in


@dataclass(frozen=True, slots=True)
class WalkRun:
    """One start.

    Attributes:
        seconds: from the first image with all joints inside to the first with a correct skeleton; infinite for none
            within a second.
        floor: whether the skeleton, or else the last image's fit from the truth, is correct.
    """

    seconds: float
    floor: bool


@cache
def _person(seed: int) -> ClothedPerson:
    return held_out(people(), seed)


def run_walk(job: Job) -> WalkRun:
    """One person who walks in."""
    scene = Performed(_person(job.seed % _PEOPLE), "walk in", job.seed)
    stage, camera = mesh_stage(scene), scene.camera
    times = np.arange(round(scene.movement.duration * RATE)) / RATE
    course, begin = scene.course(times), None
    for number in range(len(times)):
        _, joints, _ = scene.who.posed(course, number)
        optical = (joints - scene.pose.translation) @ scene.pose.rotation
        pixels = camera.project(optical[[*ARMS, Joint.HEAD, Joint.SPINE_BASE]])
        inside = (pixels > 8.0) & (pixels < [camera.width - 8.0, camera.height - 8.0])
        if inside.all():
            begin = float(times[number])
            break
    assert begin is not None
    # two images of the empty room, then images from shortly before the person is fully in view
    seen = chain(scene.frames(0.0, 2.0 / RATE), scene.frames(max(begin - 0.3, 3.0 / RATE), begin + WITHIN + 0.5 / RATE))
    view = DepthCamera(camera)
    for frame in seen:
        stamp, depth = round(frame.time * NANOSECONDS), to_metres(frame.image)
        skeleton = skeleton_of(stage, stage.take(depth_topic(SENSOR), (stamp, "", depth), Now(stamp, stamp)))
        if frame.time < begin - 1e-6:
            continue
        if _off(skeleton, frame.joints).mean() < LOST:
            return WalkRun(frame.time - begin, True)
    points = fit_from_truth(stage.sensor.body, view, depth, frame.person, frame.joints).points
    floor = bool(np.linalg.norm((points - frame.joints)[ARMS], axis=1).mean() < LOST)
    return WalkRun(float("inf"), floor)


def walk_figures(runs: Sequence[WalkRun]) -> dict[str, float]:
    """The figures of all starts."""
    seconds = np.array([run.seconds for run in runs])
    return {
        "starts": float(len(runs)),
        "within 1 s, %": float(100.0 * np.isfinite(seconds).mean()),
        "floor, %": float(100.0 * np.mean([run.floor for run in runs])),
        "median, s": float(np.median(seconds)),
    }


# --- motions that a Kinect's skeleton hides


@dataclass(frozen=True, slots=True, eq=False)
class TrunkRun:
    """Errors by source in one run, after it has settled.

    Attributes:
        bend: (n,) radians.
        lift: (n, 2) of the left and the right shoulder, metres.
        lateral: (n,) of the sum of the filter's lumbar and thoracic angle, radians; none for the floor.
        elevation: (n, 2) of the filter's clavicles, radians; none for the floor.
    """

    bend: dict[str, FloatArray]
    lift: dict[str, FloatArray]
    lateral: dict[str, FloatArray]
    elevation: dict[str, FloatArray]


def run_trunk(job: Job) -> TrunkRun:
    """One person who bends or shrugs."""
    scene = Performed(held_out(people(), job.seed), job.case, job.seed)
    frames = [*scene.frames()]
    stamps = [round(frame.time * NANOSECONDS) for frame in frames]
    truth = dict(zip(stamps, (frame.joints for frame in frames), strict=True))
    pose = replace(scene.pose, sensor=mesh_sensor(SENSOR))
    stage, view = mesh_stage(scene), DepthCamera(scene.camera)
    images = [
        (stamp, depth_topic(SENSOR), (stamp, "", to_metres(f.image))) for stamp, f in zip(stamps, frames, strict=True)
    ]
    mesh = {s: each for s, (each,) in fed(stage, pose, images, [], graph.skeleton_topic(stage.sensor.name))}
    read = kinect_skeletons(scene, np.array([*truth.values()]))
    states = np.where(np.isfinite(read[..., 0]), TrackingState.TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8)
    kinect = {s: Skeleton(s, "", one, own, 0) for s, one, own in zip(stamps, read, states, strict=True)}
    settled = [s for s in stamps if s >= _SETTLED * NANOSECONDS]
    skeletons: dict[str, dict[int, FloatArray]] = {
        "mesh": {s: each.positions for s, each in mesh.items()},
        "kinect": {s: each.positions for s, each in kinect.items()},
        "floor": {
            s: fit_from_truth(stage.sensor.body, view, to_metres(f.image), f.person, f.joints).points
            for s, f in [*zip(stamps, frames, strict=True)][::_FLOOR]
        },
    }
    result = TrunkRun({}, {}, {}, {})
    for name, found in skeletons.items():
        used = [s for s in settled if s in found]
        points, true = np.array([found[s] for s in used]), np.array([truth[s] for s in used])
        result.bend[name] = _free(_bend(points) - _bend(true))
        result.lift[name] = _free(_lift(points) - _lift(true))
    course = scene.course(np.array(stamps) / NANOSECONDS)
    true_q = dict(zip(stamps, course.q, strict=True))
    for name, sensor, found_by in (("mesh", pose.sensor, mesh), ("kinect", SENSOR, kinect)):
        own = replace(pose, sensor=sensor)
        measured = [(s, graph.skeleton_topic(sensor), (each,)) for s, each in found_by.items()]
        estimates = [
            (s, each) for s, each in fed(ekf_stage(sensor), own, measured, [], graph.MODEL_STATE) if s in true_q
        ]
        pairs = [(_angles(each.q), _angles(true_q[s])) for s, each in estimates if s >= _SETTLED * NANOSECONDS]
        off = _free(np.array([one - other for one, other in pairs]))
        result.lateral[name], result.elevation[name] = off[:, _LATERAL].sum(axis=1), off[:, _ELEVATION]
    return result


def _angles(q: FloatArray) -> FloatArray:
    """(32,) coordinates of a configuration that are angles about axes, radians; 0 for the others."""
    found = np.zeros(MODEL.nv)
    found[MODEL.scalar_v] = q[MODEL.scalar_q]
    return found


def _free(errors: FloatArray) -> FloatArray:
    """Errors (n, ...) without their constant part."""
    return np.asarray(errors - np.nanmean(errors, axis=0))


def _bend(points: FloatArray) -> FloatArray:
    """(n,) lean of the upper trunk to the right in the image against the lower trunk, radians."""
    lower = points[:, Joint.SPINE_MID] - points[:, Joint.SPINE_BASE]
    upper = points[:, Joint.SPINE_SHOULDER] - points[:, Joint.SPINE_MID]
    return np.asarray(np.arctan2(upper[:, 0], -upper[:, 1]) - np.arctan2(lower[:, 0], -lower[:, 1]))


def _lift(points: FloatArray) -> FloatArray:
    """(n, 2) heights of the shoulders over SpineShoulder along the line from SpineBase to it, metres."""
    up = points[:, Joint.SPINE_SHOULDER] - points[:, Joint.SPINE_BASE]
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    shoulders = points[:, [Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT]] - points[:, None, Joint.SPINE_SHOULDER]
    return np.asarray(np.einsum("nsa,na->ns", shoulders, up))


def trunk_figures(runs: Sequence[TrunkRun], case: str) -> dict[str, dict[str, float]]:
    """The figures of several runs, by source."""
    figures = {}
    for name in ("mesh", "kinect", "floor"):
        skeleton = (
            {"skeleton": rms_deg(np.concatenate([run.bend[name] for run in runs]))}
            if case == "bend"
            else {"skeleton": 1e3 * rms(np.concatenate([run.lift[name].ravel() for run in runs]))}
        )
        angle = [getattr(run, "lateral" if case == "bend" else "elevation").get(name) for run in runs]
        own = rms_deg(np.concatenate([each.ravel() for each in angle])) if angle[0] is not None else float("nan")
        figures[name] = {**skeleton, "angle, deg": own}
    return figures


# --- all of them


def run(job: Job) -> Any:
    """Run a job of any case."""
    return {"fast": run_fast, "walk in": run_walk}.get(job.case, run_trunk)(job)


def main() -> int:
    parser = common.parser(__doc__, seeds=3, jobs=True)
    parser.add_argument(
        "--cases", type=common.names, default=list(CASES), metavar="A,B", help=f"default: {','.join(CASES)}"
    )
    parser.add_argument("--starts", type=int, default=200, metavar="N", help="who walk in (default: %(default)s)")
    arguments = parser.parse_args()
    wheel()
    jobs = [Job("fast", motion, seed) for motion in (*FAST, _PUNCHING) for seed in range(arguments.seeds)]
    jobs += [Job("walk in", "", seed) for seed in range(arguments.starts)]
    jobs += [Job(case, "", seed) for case in ("bend", "shrug") for seed in range(arguments.seeds)]
    jobs = [job for job in jobs if job.case in arguments.cases]
    runs = mapped(run, jobs, arguments.jobs)
    figures: dict[str, Any] = {}
    met: dict[str, bool] = {}
    for case in arguments.cases:
        own = [each for job, each in zip(jobs, runs, strict=True) if job.case == case]
        if case == "fast":
            motions = [job.motion for job in jobs if job.case == case]
            of = {
                m: [each for each, motion in zip(own, motions, strict=True) if motion == m] for m in (*FAST, _PUNCHING)
            }
            found = fast_figures([each for motion in FAST for each in of[motion]])
            met["fast: mean of 35 mm"] = found["mean, mm"] <= 35.0
            met["fast: found again within 0.5 s of every loss"] = found["longest, s"] <= 0.5
            met["fast: every lost image is flagged"] = found["unflagged"] == 0
            figures[case] = {**{motion: fast_figures(each) for motion, each in of.items()}, "all with a bar": found}
        elif case == "walk in":
            walked = walk_figures(own)
            met["walk in: tracked within 1 s in 95 %"] = walked["within 1 s, %"] >= 95.0
            figures[case] = {case: walked}
        else:
            trunk = trunk_figures(own, case)
            for what in ("skeleton", "angle, deg"):
                is_half = trunk["mesh"][what] <= 0.5 * trunk["kinect"][what]
                met[f"{case}: half the Kinect's error, {what.partition(',')[0]}"] = is_half
            figures[case] = trunk
    report(arguments, figures)
    return verdicts(arguments, met)


if __name__ == "__main__":
    sys.exit(main())

"""Joint-angle estimators on the same synthetic motion, the same 19 points and the same noise.

The truth is made with ``upper_body`` itself: people of random proportions whose 26 joint angles follow smooth random
curves within ranges of motion, on a base that sways and turns. The peers are given the true segment lengths and their
true first pose. A peer is shown as it comes, and with the settings that a search found to give
the least angle error when the truth is known, for each scenario anew (``peers/tuned.json``; ``--search`` repeats it).
biorbd is shown once more with both axial rotations of the spine locked at zero, which leaves nothing undetermined.

Ours are at their defaults and are told the points only, neither lengths nor pose nor noise. ``ik`` solves each frame by
itself with the lengths that ``ekf`` has learnt by the end of the recording and the noise of the measurement model. The
thesis's filter cannot follow a base that moves, and its angles are another body's; so it gets more than all others and
shows points only: the points in the frame of the true pelvis (its result is put back by the truth), and, before the
motion, 50 frames without noise in a T-pose, from which it has the true lengths, and 2 s on the way to the first pose.

Columns: RMSE of all 26 joint angles; of those that the points determine (see ``UNOBSERVED`` of the model); of the
hidden arm's 7 angles while it is hidden; of elbow flexion and arm elevation as the points show them; RMS distance of
the 19 points from the truth, and of the 10 joints that the thesis's model has; jitter; median processor time of
a frame. The error of a shoulder is one rotation: the square of its angle stands for its three coordinates in the mean.
Other angles are compared modulo a turn. Jitter is the RMS of the second differences of the 26 angles from frame to
frame, less that of the truth; below zero the estimate is smoother than the person. The first three frames count for
nobody: ``ekf`` takes them to learn the noise and has its first estimate with the fourth.

Then the bars, met or missed; a missed one makes the exit code 1. Needs the peers: ``pip install -e '.[peers]'``. One
thread.
"""

from __future__ import annotations

import os

# before numpy reads them
os.environ.update(dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"))

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.filters.ekf import ExtendedKalmanFilter
from body_tracking.filters.schlagenhauf import SchlagenhaufKalmanFilter, SchlagenhaufParameters
from body_tracking.kinematics.inverse import InverseKinematics
from body_tracking.kinematics.ranges import RANGES
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26
from body_tracking.kinematics.upper_body import UNOBSERVED, UpperBody
from body_tracking.measurement import BASE_STDDEV
from body_tracking.skeleton import (
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)

try:
    from peers.biorbd_ekf import BiorbdEkf, biomod
    from peers.opensim_ik import OpenSimIk, osim_model
    from peers.tree import Tree
except ModuleNotFoundError as error:
    sys.exit(f"{error.name} is not installed; the peers come with: pip install -e '.[peers]'")

MODEL = UpperBody()
RATE = 30.0
"""Frames per second."""

MOTION: dict[str, tuple[float, float]] = {
    "lumbar_flexion": (-10.0, 40.0),
    "lumbar_lateral": (-15.0, 15.0),
    "lumbar_axial": (-8.0, 8.0),
    "thoracic_flexion": (-10.0, 25.0),
    "thoracic_lateral": (-15.0, 15.0),
    "thoracic_axial": (-20.0, 20.0),
    "neck_flexion": (-30.0, 40.0),
    "neck_lateral": (-25.0, 25.0),
    "clavicle_protraction": (-10.0, 15.0),
    "clavicle_elevation": (-5.0, 20.0),
    "shoulder_flexion": (-30.0, 120.0),
    "shoulder_abduction": (0.0, 75.0),
    "shoulder_rotation": (-50.0, 50.0),
    "elbow_flexion": (5.0, 130.0),
    "forearm_pronation": (-60.0, 60.0),
    "wrist_flexion": (-45.0, 45.0),
    "wrist_deviation": (-20.0, 20.0),
    "base_yaw": (-120.0, 120.0),
    "base_pitch": (-8.0, 8.0),
    "base_roll": (-8.0, 8.0),
}
"""Degrees that the motion sweeps. It keeps off an abduction of 90, where the peers' shoulders are singular."""
SWAY = 0.05
"""Metres to either side, of the base."""
ANGLE_BAND, BASE_BAND = (0.1, 0.8), (0.05, 0.25)
"""Hz."""
WAVES = 8
"""Sines that make a curve."""
GAP, GAP_EVERY = 0.5, 4.0
"""Seconds: the arms, left and right by turns, are hidden for so long once in so long."""
OUTLIER = 0.3
"""Metres."""
UNCOUNTED = 3
"""Frames at the start that count for nobody."""

SIDES = ("left", "right")
ANGLES = MODEL.coordinate_names[6:]


def _arm_points(side: str) -> IntArray:
    names = [f"{name}_{side.upper()}" for name in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")]
    return np.flatnonzero(np.isin(MODEL.joints, [Joint[name] for name in names]))


HIDDEN = tuple(map(_arm_points, SIDES))
"""Points that a dropout hides, of the left and the right arm."""
ARM = tuple(
    np.array([n for n, name in enumerate(ANGLES) if name.endswith(side) and not name.startswith("clavicle")])
    for side in SIDES
)
"""Which of the 26 angles are the left and the right arm's."""
BASE = np.concatenate([np.arange(3), np.arange(MODEL.nq)[MODEL.quaternion_of("pelvis")]])
OBSERVED = np.array([number for number, name in enumerate(ANGLES) if name not in UNOBSERVED])
TEN = np.flatnonzero(np.isin(MODEL.joints, Schlagenhauf26().joints))
"""The points that the thesis's model has."""


@dataclass(frozen=True, slots=True)
class Scenario:
    """What is done to the points: noise in metres per axis, arms hidden or not, the share of outliers."""

    name: str
    noise: float
    gaps: bool = False
    outliers: float = 0.0


SCENARIOS = (
    Scenario("noise 5 mm", 0.005),
    Scenario("noise 20 mm", 0.020),
    Scenario("20 mm, dropout", 0.020, gaps=True),
    Scenario("20 mm, outliers", 0.020, outliers=0.05),
)


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """What an estimator is given.

    Attributes:
        times: (n,) seconds.
        positions: (n, 19, 3) metres in world, NaN where a point is missing.
        lengths: (21,) metres, the person's true segment lengths.
        first: (35,) the true first configuration.
        base: (n, 7) the true position and quaternion of the base, without which the thesis's filter cannot do.
    """

    times: FloatArray
    positions: FloatArray
    lengths: FloatArray
    first: FloatArray
    base: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """What an estimator makes of it.

    Attributes:
        configurations: (n, 35) of ``upper_body``; None where it has none.
        positions: (n, 19, 3) metres; NaN of points that it does not have.
        seconds: (n,) of processor time that each frame took.
    """

    configurations: FloatArray | None
    positions: FloatArray
    seconds: FloatArray


class Estimator(Protocol):
    """What the benchmark runs."""

    @property
    def name(self) -> str:
        """What the table calls it."""

    def run(self, observations: Observations) -> Estimate:
        """Estimate a recording, frame by frame."""


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A motion with its observations.

    Attributes:
        observations: what is seen.
        truth: (n, 35) configurations.
        positions: (n, 19, 3) metres, true.
        hidden: (n, 2) whether the left and the right arm are hidden.
    """

    observations: Observations
    truth: FloatArray
    positions: FloatArray
    hidden: BoolArray


def _curves(rng: np.random.Generator, times: FloatArray, count: int, band: tuple[float, float]) -> FloatArray:
    """(n, count) independent sums of sines of a band in Hz, each from -1 to 1 at most."""
    frequencies = rng.uniform(*band, (WAVES, count))
    phases = rng.uniform(0.0, 2.0 * np.pi, (WAVES, count))
    sines = rng.normal(size=(WAVES, count)) * np.sin(2.0 * np.pi * frequencies * times[:, None, None] + phases)
    sums = sines.sum(axis=1)
    curves: FloatArray = sums / np.abs(sums).max(axis=0)
    return curves


def record(scenario: Scenario, seed: int, seconds: float) -> Recording:
    """A person of their own for each seed, who moves alike in all scenarios."""
    rng = np.random.default_rng(seed)
    lengths = MODEL.default_lengths(rng.uniform(1.55, 1.95)) * rng.uniform(0.9, 1.1, len(MODEL.length_names))
    tree = Tree(MODEL, lengths)
    times = np.arange(round(seconds * RATE)) / RATE
    base, angles = _curves(rng, times, 6, BASE_BAND), _curves(rng, times, MODEL.nv - 6, ANGLE_BAND)
    bounds = np.radians([MOTION[name.removesuffix("_left").removesuffix("_right")] for name in tree.names[3:]])
    swept = np.concatenate([base[:, 3:], angles], axis=1)
    rotations = bounds.mean(axis=1) + 0.5 * (bounds[:, 1] - bounds[:, 0]) * swept
    truth = tree.configurations(np.concatenate([SWAY * base[:, :3] + [0.0, 0.0, 1.0], rotations], axis=1))
    positions = MODEL.forward(truth, lengths).positions

    seen = positions + rng.normal(scale=scenario.noise, size=positions.shape)
    directions = rng.normal(size=positions.shape)
    directions *= OUTLIER / np.linalg.norm(directions, axis=-1, keepdims=True)
    wrong = rng.random(positions.shape[:2]) < scenario.outliers
    seen[wrong] += directions[wrong]
    hidden = np.zeros((len(times), 2), dtype=bool)
    if scenario.gaps:
        for number, start in enumerate(np.arange(0.5 * GAP_EVERY, seconds - GAP, GAP_EVERY)):
            hidden[(times >= start) & (times < start + GAP), number % 2] = True
    for arm, points in enumerate(HIDDEN):
        seen[np.ix_(hidden[:, arm], points)] = np.nan
    return Recording(Observations(times, seen, lengths, truth[0], truth[:, BASE]), truth, positions, hidden)


@dataclass(frozen=True, slots=True)
class Score:
    """Pooled over recordings: degrees, millimetres and milliseconds; NaN where there is nothing to say."""

    angles: float
    observed: float
    hidden: float
    arms: float
    points: float
    ten: float
    jitter: float
    time: float


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2))) if values.size else float("nan")


def _wrapped(angles: FloatArray) -> FloatArray:
    turned: FloatArray = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return turned


def _bends(q: FloatArray) -> FloatArray:
    """(n - 2, 26) second differences of the joint angles, radians."""
    steps = _wrapped(MODEL.difference(q[:-1], q[1:])[:, 6:])
    return np.diff(steps, axis=0)


def _arm_angles(positions: FloatArray) -> FloatArray:
    """(n, 4) radians: elbow flexion, and elevation of the upper arm against the trunk axis, left and right."""
    point = {Joint(joint): positions[:, number] for number, joint in enumerate(MODEL.joints)}
    down = point[Joint.SPINE_MID] - point[Joint.SPINE_SHOULDER]
    angles = []
    for side in ("LEFT", "RIGHT"):
        shoulder, elbow, wrist = (point[Joint[f"{name}_{side}"]] for name in ("SHOULDER", "ELBOW", "WRIST"))
        angles += [_between(elbow - shoulder, wrist - elbow), _between(down, elbow - shoulder)]
    return np.stack(angles, axis=1)


def _between(a: FloatArray, b: FloatArray) -> FloatArray:
    angle: FloatArray = np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(axis=-1))
    return angle


def _angle_errors(recording: Recording, estimate: Estimate) -> FloatArray:
    """(n, 26) degrees; none where there are no configurations."""
    if estimate.configurations is None:
        return np.empty((0, len(ANGLES)))
    return np.degrees(_wrapped(MODEL.difference(estimate.configurations, recording.truth)[UNCOUNTED:, 6:]))


def score(recordings: Sequence[Recording], estimates: Sequence[Estimate]) -> Score:
    """Compare with the truth; infinite errors where an estimate is not finite everywhere."""
    found = [e.positions[UNCOUNTED:, TEN] for e in estimates]
    found += [e.configurations[UNCOUNTED:] for e in estimates if e.configurations is not None]
    if not all(np.isfinite(each).all() for each in found):
        lost = float("inf")
        return Score(lost, lost, lost, lost, lost, lost, lost, _milliseconds(estimates))
    pairs = list(zip(recordings, estimates, strict=True))
    errors = [_angle_errors(recording, estimate) for recording, estimate in pairs]
    apart = [1e3 * np.linalg.norm(e.positions - r.positions, axis=-1)[UNCOUNTED:] for r, e in pairs]
    arms = [np.degrees(_arm_angles(e.positions) - _arm_angles(r.positions))[UNCOUNTED:] for r, e in pairs]
    hidden = [
        error[np.ix_(recording.hidden[UNCOUNTED:, arm], angles)].ravel()
        for recording, error in zip(recordings, errors, strict=True)
        if len(error)
        for arm, angles in enumerate(ARM)
    ]
    moving = [e.configurations[UNCOUNTED:] for e in estimates if e.configurations is not None]
    jitter = still = float("nan")
    if moving:
        jitter = _rms(np.concatenate([_bends(q) for q in moving]))
        still = _rms(np.concatenate([_bends(r.truth[UNCOUNTED:]) for r in recordings]))
    return Score(
        angles=_rms(np.concatenate(errors)),
        observed=_rms(np.concatenate(errors)[:, OBSERVED]),
        hidden=_rms(np.concatenate(hidden)) if hidden else float("nan"),
        arms=_rms(np.concatenate(arms)),
        points=_rms(np.concatenate(apart)),
        ten=_rms(np.concatenate(apart)[:, TEN]),
        jitter=float(np.degrees(jitter - still)),
        time=_milliseconds(estimates),
    )


def per_angle(recordings: Sequence[Recording], estimates: Sequence[Estimate]) -> dict[str, float]:
    """RMSE of each angle, degrees; of a shoulder, the components of its rotation error in the upper arm's frame."""
    errors = np.concatenate([_angle_errors(*pair) for pair in zip(recordings, estimates, strict=True)])
    if not len(errors):
        return {}
    return dict(zip(ANGLES, np.sqrt(np.mean(errors**2, axis=0)).tolist(), strict=True))


def _milliseconds(estimates: Sequence[Estimate]) -> float:
    return 1e3 * float(np.median(np.concatenate([each.seconds[1:] for each in estimates])))


def _of_tree(tree: Tree, observations: Observations, run: tuple[FloatArray, FloatArray]) -> Estimate:
    coordinates, seconds = run
    if not np.isfinite(coordinates).all():
        nothing = np.full(observations.positions.shape, np.nan)
        return Estimate(np.full((len(coordinates), MODEL.nq), np.nan), nothing, seconds)
    q = tree.configurations(coordinates)
    return Estimate(q, MODEL.forward(q, observations.lengths).positions, seconds)


def _skeletons(observations: Observations) -> list[Skeleton]:
    """What a user has: points and whether they are tracked."""
    return [_skeleton(at, points) for at, points in zip(observations.times, observations.positions, strict=True)]


def _skeleton(at: float, points: FloatArray) -> Skeleton:
    positions, states = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, dtype=np.uint8)
    positions[MODEL.joints] = points
    states[MODEL.joints] = np.where(
        np.isfinite(points).all(axis=1), np.uint8(TrackingState.TRACKED), np.uint8(TrackingState.NOT_TRACKED)
    )
    return Skeleton(round((at + _PRELUDE) * NANOSECONDS), "world", positions, states)


@dataclass(frozen=True, slots=True)
class Ekf:
    """Our filter, at its defaults."""

    name: str = "ekf"

    def run(self, observations: Observations) -> Estimate:
        """Filter a recording; its time is that of all it tells, with the covariance of points and state."""
        return self.filtered(observations)[0]

    def filtered(self, observations: Observations) -> tuple[Estimate, FloatArray]:
        """The same, and the (21,) lengths that it has learnt by the end."""
        ekf, n = ExtendedKalmanFilter(), len(observations.times)
        q, positions, seconds = np.full((n, MODEL.nq), np.nan), np.full((n, len(MODEL.joints), 3), np.nan), np.empty(n)
        lengths = MODEL.default_lengths()
        for frame, skeleton in enumerate(_skeletons(observations)):
            started = time.process_time()
            output, estimate = ekf.update(skeleton), ekf.estimate
            seconds[frame] = time.process_time() - started
            if output is not None and estimate is not None:
                q[frame], positions[frame], lengths = estimate.q, output.positions[MODEL.joints], estimate.lengths
        return Estimate(q, positions, seconds), lengths


@dataclass(frozen=True, slots=True)
class Ik:
    """Our inverse kinematics, frame by frame."""

    warm: bool = True
    name: str = "ik"

    def run(self, observations: Observations) -> Estimate:
        """Solve every frame from the closed form, or, ``warm``, from the frame before it."""
        _, lengths = Ekf().filtered(observations)
        inverse, n, stddev = InverseKinematics(MODEL), len(observations.times), BASE_STDDEV[MODEL.joints]
        q, seconds = np.empty((n, MODEL.nq)), np.empty(n)
        for frame, points in enumerate(observations.positions):
            started = time.process_time()
            start = q[frame - 1] if frame and self.warm else None
            q[frame] = inverse.solve(points, stddev, lengths, start).q
            seconds[frame] = time.process_time() - started
        return Estimate(q, MODEL.forward(q, lengths).positions, seconds)


_PRELUDE = 4.0
"""Seconds that stamps begin with, for what comes before the motion."""
_ON_THE_WAY = 2.0
"""Seconds from the T-pose to the first pose."""


@dataclass(frozen=True, slots=True)
class Schlagenhauf:
    """The thesis's filter, with all that it needs."""

    name: str = "schlagenhauf_ekf"

    def run(self, observations: Observations) -> Estimate:
        """Filter the points in the frame of the true pelvis."""
        positions, turns = observations.base[:, None, :3], Rotation.from_quat(observations.base[:, 3:]).as_matrix()
        points = (observations.positions - positions) @ turns
        seen = _skeletons(dataclasses.replace(observations, positions=points))
        filter_, found, seconds = SchlagenhaufKalmanFilter(), np.full(points.shape, np.nan), np.empty(len(seen))
        for skeleton in self._prelude(observations):
            filter_.update(skeleton)
        if not filter_.calibrated:
            raise SystemExit("the thesis's filter did not take the T-pose")
        for frame, skeleton in enumerate(seen):
            started = time.process_time()
            output = filter_.update(skeleton)
            seconds[frame] = time.process_time() - started
            if output is not None:
                found[frame, TEN] = output.positions[MODEL.joints[TEN]]
        return Estimate(None, found @ turns.swapaxes(1, 2) + positions, seconds)

    def _prelude(self, observations: Observations) -> list[Skeleton]:
        """The frames before the first, without noise, in the frame of the pelvis: a T-pose, then on the way from it."""
        tree = Tree(MODEL, observations.lengths)
        coordinates = np.zeros((1, len(tree.names)))
        coordinates[0, [tree.names.index(f"shoulder_abduction_{side}") for side in SIDES]] = np.pi / 2.0
        t_pose, first = tree.configurations(coordinates)[0], observations.first.copy()
        first[BASE] = t_pose[BASE]
        share = np.linspace(0.0, 1.0, round(_ON_THE_WAY * RATE), endpoint=False)
        share = np.concatenate([np.zeros(SchlagenhaufParameters().calibration_frames), share])
        way = MODEL.integrate(np.tile(t_pose, (len(share), 1)), share[:, None] * MODEL.difference(t_pose, first))
        times = -np.arange(len(share), 0, -1) / RATE
        shown = MODEL.forward(way, observations.lengths).positions
        return [_skeleton(instant, points) for instant, points in zip(times, shown, strict=True)]


TUNED = Path(__file__).parent / "peers" / "tuned.json"
"""Scenario, peer: the settings that the search found."""

Step = tuple[str, Callable[[Any], Sequence[Any]]]
"""A step of the search for the best settings: a setting's name, and from its best value so far those to try."""


@dataclass(frozen=True, slots=True)
class Biorbd:
    """biorbd's extended Kalman filter; the settings are its defaults."""

    noise: float = 1e-10
    error: float = 1e-5
    start_known: bool = True
    locked: tuple[str, ...] = ()
    name: str = "biorbd EKF"

    STEPS: ClassVar[tuple[Step, ...]] = (
        ("noise", lambda _: [10.0**power for power in range(-9, -2)]),
        ("error", lambda _: [1e-8, 1e-2, 1.0]),
        ("noise", lambda best: [factor * best for factor in (0.2, 0.5, 2.0, 5.0)]),
        ("start_known", lambda _: [False]),
    )

    @property
    def settings(self) -> str:
        """What it is set to, in a few words."""
        start = "true first pose" if self.start_known else "own first guess"
        return f"noiseFactor {self.noise:.0e}, errorFactor {self.error:.0e}, {start}"

    def run(self, observations: Observations) -> Estimate:
        """Filter or solve a recording, frame by frame."""
        tree = Tree(MODEL, observations.lengths)
        start = tree.coordinates(observations.first[None])[0] if self.start_known else None
        peer = BiorbdEkf(tree, RATE, self.noise, self.error, start, self.locked)
        return _of_tree(tree, observations, peer.run(observations.times, observations.positions))


@dataclass(frozen=True, slots=True)
class OpenSim:
    """OpenSim's inverse kinematics; the settings are the defaults of its tool."""

    accuracy: float = 1e-5
    limits: bool = False
    prior: float = 0.0
    name: str = "OpenSim IK"

    STEPS: ClassVar[tuple[Step, ...]] = (
        ("prior", lambda _: [1e-5, 1e-4, 3e-4, 1e-3, 3e-3]),
        ("accuracy", lambda _: [1e-4, 1e-3, 1e-2]),
        ("limits", lambda _: [True]),
    )

    @property
    def settings(self) -> str:
        """What it is set to, in a few words."""
        limits = "clamped to ranges of motion" if self.limits else "no limits"
        return f"accuracy {self.accuracy:.0e}, {limits}, coordinate tasks of weight {self.prior:g}"

    def run(self, observations: Observations) -> Estimate:
        """Filter or solve a recording, frame by frame."""
        tree = Tree(MODEL, observations.lengths)
        ranges = {name: RANGES.get(name.removesuffix("_left").removesuffix("_right")) for name in tree.names}
        limits = {name: tuple(np.radians(bounds)) for name, bounds in ranges.items() if bounds and self.limits}
        start = tree.coordinates(observations.first[None])[0]
        peer = OpenSimIk(tree, self.accuracy, limits, self.prior, start)
        return _of_tree(tree, observations, peer.run(observations.times, observations.positions))


Peer = Biorbd | OpenSim
LOCKED = ("lumbar_axial", "thoracic_axial")
PEERS: tuple[Peer, ...] = (Biorbd(), Biorbd(locked=LOCKED, name="biorbd EKF, 24 DoF"), OpenSim())
OURS: tuple[Estimator, ...] = (Ekf(), Ik(), Ik(warm=False, name="ik, cold"), Schlagenhauf())


def tuned(peer: Peer, loss: Callable[[Peer], float]) -> Peer:
    """The settings of the least loss that the peer's search finds."""
    best, least = peer, loss(peer)
    for setting, values in peer.STEPS:
        for value in values(getattr(best, setting)):
            candidate = dataclasses.replace(best, **{setting: value})
            found = loss(candidate)
            if found < least:
                best, least = candidate, found
    return best


def progress(text: str) -> None:
    """A line for whoever waits; not part of the result."""
    print(text, file=sys.stderr, flush=True)


def check_kinematics() -> None:
    """The peers' own forward kinematics must be ours to 1e-9 m.

    Raises:
        SystemExit: it is not.
    """
    rng = np.random.default_rng(0)
    lengths = MODEL.default_lengths() * rng.uniform(0.8, 1.2, len(MODEL.length_names))
    tree = Tree(MODEL, lengths)
    q = MODEL.integrate(np.tile(MODEL.neutral(), (100, 1)), rng.normal(size=(100, MODEL.nv)))
    ours = MODEL.forward(q, lengths).positions
    for peer in (BiorbdEkf(tree, RATE, 1e-4, 1e-2), OpenSimIk(tree, 1e-5)):
        apart = float(np.abs(peer.positions(tree.coordinates(q)) - ours).max())
        progress(f"forward kinematics of {type(peer).__name__} at 100 random poses: {apart:.0e} m from ours")
        if not apart < 1e-9:
            raise SystemExit("the body is another one there; nothing below would be comparable")


def write_models(folder: Path) -> None:
    """The body of the first seed in the peers' own formats, to look at."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = Tree(MODEL, record(SCENARIOS[0], 0, 1.0).observations.lengths)
    (folder / "upper_body.bioMod").write_text(biomod(tree))
    osim_model(tree).printToXML(str(folder / "upper_body.osim"))


def main() -> None:
    """Run everything and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3, help="people and motions per scenario (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of a motion (default: %(default)s)")
    parser.add_argument("--only", metavar="TEXT", help="run only the estimators whose name contains this")
    parser.add_argument(
        "--search", action="store_true", help=f"find the peers' best settings again; writes {TUNED.name}"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures there, and those of each angle")
    parser.add_argument(
        "--models", type=Path, metavar="FOLDER", help="write upper_body.bioMod and .osim there, and end"
    )
    arguments = parser.parse_args()
    if arguments.seeds < 1 or arguments.seconds < 5.0:
        parser.error("at least one seed of five seconds")
    if arguments.models:
        write_models(arguments.models)
        return

    def wanted(estimator: Estimator) -> bool:
        return arguments.only is None or arguments.only.lower() in estimator.name.lower()

    if any(map(wanted, PEERS)):
        check_kinematics()

    best: dict[str, dict[str, dict[str, Any]]] = json.loads(TUNED.read_text()) if TUNED.exists() else {}
    rows: list[dict[str, Any]] = []
    for scenario in SCENARIOS:
        recordings = [record(scenario, seed, arguments.seconds) for seed in range(arguments.seeds)]

        def measure(estimator: Estimator, settings: str) -> tuple[Score, dict[str, float]]:
            estimates = [estimator.run(each.observations) for each in recordings]  # noqa: B023
            found = score(recordings, estimates)  # noqa: B023
            progress(f"  {found.angles:7.2f} deg  {found.time:6.2f} ms  {estimator.name}  {settings}")
            return found, per_angle(recordings, estimates)  # noqa: B023

        progress(scenario.name)
        entries: list[tuple[Estimator, str]] = [(each, "") for each in filter(wanted, OURS)]
        for peer in filter(wanted, PEERS):
            if arguments.search:
                found = tuned(peer, lambda each: measure(each, each.settings)[0].angles)
                settings = {name: getattr(found, name) for name, _ in found.STEPS}
                best.setdefault(scenario.name, {})[peer.name] = settings
                TUNED.write_text(json.dumps(best, indent=1) + "\n")
            entries.append((dataclasses.replace(peer, name=f"{peer.name}, as it comes"), peer.settings))
            if peer.name in best.get(scenario.name, {}):
                peer = dataclasses.replace(peer, **best[scenario.name][peer.name])
                entries.append((dataclasses.replace(peer, name=f"{peer.name}, tuned"), peer.settings))
        for estimator, settings_text in entries:
            figures, angles = measure(estimator, settings_text)
            rows.append(
                {
                    "scenario": scenario.name,
                    "estimator": estimator.name,
                    "settings": settings_text,
                    **dataclasses.asdict(figures),
                    "per_angle": angles,
                }
            )
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1) + "\n")
    report(rows)
    bars = judge(rows)
    print()
    for met, text in bars:
        print(f"{'met   ' if met else 'MISSED'}  {text}")
    if not bars:
        print("the bars need ekf and both peers")
    sys.exit(0 if all(met for met, _ in bars) else 1)


def report(rows: Sequence[dict[str, Any]]) -> None:
    """Print the table."""
    columns = {"angles": 9, "observed": 8, "hidden": 6, "arms": 5, "points": 6, "ten": 6, "jitter": 6, "time": 5}
    heads, units = (
        ("26 angles", "observed", "hidden", "arms", "points", "10 pts", "jitter", "time"),
        ("deg", "deg", "deg", "deg", "mm", "mm", "deg", "ms"),
    )
    for first, second, cells in (("scenario", "estimator", heads), ("", "", units)):
        print(f"{first:<15} {second:<32}", *(f"{c:>{w}}" for c, w in zip(cells, columns.values(), strict=True)))
    for row in rows:
        cells = tuple(
            "-".rjust(width) if np.isnan(row[name]) else f"{row[name]:{width}.{1 if name in ('points', 'ten') else 2}f}"
            for name, width in columns.items()
        )
        print(f"{row['scenario']:<15} {row['estimator']:<32}", *cells, f" {row['settings']}")


def judge(rows: Sequence[dict[str, Any]]) -> list[tuple[bool, str]]:
    """The bars of "Against the peers": whether each is met, and the figures; none without ``ekf`` and both peers."""

    def least(figure: str, scenario: str, estimator: str) -> tuple[float, str]:
        """Of all rows of an estimator, whatever its settings; and which it is."""
        return min(
            (row[figure], row["estimator"])
            for row in rows
            if row["scenario"] == scenario and row["estimator"].startswith(estimator)
        )

    def time_of(estimator: str) -> float:
        names = (estimator, f"{estimator}, as it comes", f"{estimator}, tuned")
        return float(np.median([row["time"] for row in rows if row["estimator"] in names]))

    names = [row["estimator"] for row in rows]
    if not all(any(name.startswith(each) for name in names) for each in ("ekf", "biorbd EKF", "OpenSim IK")):
        return []
    bars = []
    for scenario in ("noise 5 mm", "noise 20 mm"):
        (ours, _), (best, which) = least("angles", scenario, "ekf"), least("angles", scenario, "biorbd EKF")
        bars.append((ours < best, f"{scenario}: ekf {ours:.2f} deg, below biorbd's best, {best:.2f} ({which})"))
    ours = least("angles", "noise 20 mm", "ekf")[0]
    other = least("angles", "noise 20 mm", "OpenSim IK, as it comes")[0]
    tuned_best, _ = least("angles", "noise 20 mm", "OpenSim IK")
    bars.append(
        (
            ours <= 0.5 * other,
            f"noise 20 mm: ekf {ours:.2f} deg, at most half of OpenSim IK as it comes, {other:.2f} (ratio "
            f"{ours / other:.2f}; of the tuned one, {tuned_best:.2f}: {ours / tuned_best:.2f})",
        )
    )
    ours = least("hidden", "20 mm, dropout", "ekf")[0]
    for peer in ("biorbd EKF", "OpenSim IK"):
        best, which = least("hidden", "20 mm, dropout", peer)
        bars.append((ours < best, f"hidden arm: ekf {ours:.2f} deg, below {best:.2f} ({which})"))
    times = {name: time_of(name) for name in ("ekf", "biorbd EKF", "OpenSim IK")}
    ours, biorbd, opensim = times.values()
    bars += [
        (ours <= 2.0 * biorbd, f"time: ekf {ours:.2f} ms, at most twice biorbd's {biorbd:.2f} ({ours / biorbd:.2f})"),
        (
            ours <= opensim / 3.0,
            f"time: ekf {ours:.2f} ms, at most a third of OpenSim's {opensim:.2f} ({ours / opensim:.2f})",
        ),
    ]
    return bars


if __name__ == "__main__":
    main()

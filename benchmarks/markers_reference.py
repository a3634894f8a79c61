"""A Kinect evaluated by the marker system, beside the truth: simulated people, and a real pendulum.

``people``: a simulated person in front of one Kinect wears targets on thorax, clavicle, upper arm and forearm; the
poses have a noise of 0.15 degrees. The clock of the marker system is off by 1.7 s and 50 ppm; rig and mountings are
random. The recording is replayed with each filter and evaluated as by ``body_tracking evaluate EST --truth MARKERS``.

- ``by markers``: RMS error of an angle by the reference, with its interval.
- ``true``: RMS of the same angle's true error without its mean.
- ``not absorbed``: RMS of the true error left by constant rotations of each segment and of the rig and by the clock,
  after the same fit to the exact orientations of the whole recording: the part of the error that markers can show.
- ``inside``: share of angles whose error lies in the interval, among those for which the reference is good enough; for
  ``not absorbed``, and for ``true``.
- ``refused``: recordings without a result, because the estimate contains too little movement.
- ``clock``: error of the offset, which includes the filter's delay, in ms, beside its stated standard deviation.

``pendulum``: orientations of a real pendulum's links from raw inertial data (RepoIMU), evaluated by Vicon as if its
clusters were targets. Every link turns about one axis only, so that the fit has to be refused (``refused``). With the
mounting from one half, in which the free rotation about that axis is arbitrary, world and clock are fitted to that half
and the difference is computed on the other. ``imu_pendulum`` fits mounting and world to the whole recording: compare
with ``1 offset`` there; its smaller figures follow Vicon's wandering clock, which this fit cannot.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import common
import numpy as np
from imu_pendulum import LINKS, SETTLING_S, fit, one_offset, record
from worn_targets import ARM, wear_targets, write_targets

from body_tracking.core import so3
from body_tracking.core.orientation import SEGMENT_NUMBER
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.estimated_segments import joint_chains, read_segments, split_near
from body_tracking.evaluation.hand_eye import HandEyeError, Mounting, Track, fit_hand_eye
from body_tracking.evaluation.marker_reference import read_marker_reference
from body_tracking.evaluation.reading import EvaluationError, read_truth
from body_tracking.evaluation.reference_comparison import ReferenceEvaluation, evaluate_by_markers
from body_tracking.inertial.clock import clock_offset, turning
from body_tracking.recording.replay import ReplaySettings, replay
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.scene import Setup, simulate

OFFSET, DRIFT = 1.7, 50e-6
SECONDS = 40.0
MOTIONS = ("reaching", "arm_raises", "punching")
FILTERS = ("lkf_constant_velocity", "ekf")
FIRST_SEED = 700
"""Other people than in the tests."""
SHOWN = ("shoulder_abduction_left", "elbow_flexion_left", "forearm_pronation_left")


@dataclass(frozen=True)
class Job:
    """One person in one motion with one filter."""

    motion: str
    filter: str
    seed: int


@dataclass(frozen=True)
class Angle:
    """Figures of one angle, degrees."""

    name: str
    true: float
    not_absorbed: float
    error: float
    low: float
    high: float


@dataclass(frozen=True)
class Case:
    """Result of a job; clock figures in milliseconds."""

    job: Job
    clock_error: float
    clock_stddev: float
    angles: tuple[Angle, ...]


def judge(job: Job) -> Case | None:
    """Simulate, replay, evaluate; None if refused."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        recording = simulate(Setup(job.motion, seconds=SECONDS, seed=FIRST_SEED + job.seed))
        write_bag(recording, folder / "in")
        replay(folder / "in", folder / "out", ReplaySettings((), filter_name=job.filter))
        truth = read_truth(folder / "in")
        person = recording.truths[0]
        q = np.stack([person.estimate(k).q for k in range(len(person.stamps_ns))])
        times = truth.seconds(int(truth.stamps_ns[0]))
        rng = np.random.default_rng([job.seed, 3])
        worn = wear_targets(times, q, rng, segments=("upper_trunk", *ARM), offset=OFFSET, drift=DRIFT)
        write_targets(worn, folder / "markers", int(truth.stamps_ns[0]))
        estimate = read_segments(folder / "out")
        try:
            result = evaluate_by_markers(estimate, read_marker_reference(folder / "markers"))
        except EvaluationError as error:
            common.progress(f"{job}: {error}")
            return None
        rotations = MODEL.forward(q, MODEL.default_lengths()).rotations
        everywhere = np.zeros((len(times), 3, 3))
        true = {segment: Track(times, rotations[:, SEGMENT_NUMBER[segment]], everywhere) for segment in worn.segments}
        elapsed = int(estimate.stamps_ns[0] - truth.stamps_ns[0]) / NANOSECONDS
        return Case(job, *_clock(result, int(truth.stamps_ns[0])), tuple(_angles(result, true, elapsed)))


def _clock(result: ReferenceEvaluation, zero_ns: int) -> tuple[float, float]:
    """Error of the clock's offset at the middle, and its standard deviation, ms."""
    elapsed = result.fit.middle + (int(result.estimate.stamps_ns[0]) - zero_ns) / NANOSECONDS
    return 1e3 * (result.offset_s - OFFSET - DRIFT * elapsed), 1e3 * result.clock_stddev


def _angles(result: ReferenceEvaluation, true: dict[str, Track], elapsed: float) -> list[Angle]:
    """Angles by the markers beside the true ones at the same instants; of equivalent triples the nearest is taken.

    Args:
        result: by the markers.
        true: orientations of the segments by seconds since the truth begins.
        elapsed: seconds from the start of the truth to that of the estimate.
    """
    found = []
    mounted = _mounted(result, true, elapsed)
    curves, judged = result.curves, {each.name: each for each in result.angles}
    for chain in joint_chains(result.estimate.convention, frozenset(true), MODEL):
        named = [name for name in chain.names if name in curves.names]
        near = np.zeros((len(curves.times), 3))
        for place, name in enumerate(chain.names):
            if name in named:
                near[:, place] = curves.found[:, curves.names.index(name)]
        parent, child = (true[each].at(curves.times + elapsed) for each in (chain.parent, chain.child))
        near = np.nan_to_num(near)
        angles, _ = split_near(chain, parent.rotations.swapaxes(-1, -2) @ child.rotations, near)
        fitted, _ = split_near(chain, mounted[chain.parent].swapaxes(-1, -2) @ mounted[chain.child], near)
        for place, name in enumerate(chain.names):
            if name in named and name in judged:
                compared = np.isfinite(curves.true[:, curves.names.index(name)]) & parent.known & child.known
                error, left = (wrapped(near[:, place] - other[:, place])[compared] for other in (angles, fitted))
                each, rms = judged[name], np.sqrt((left**2).mean())
                found.append(Angle(name, *np.degrees([error.std(), rms, each.error, each.low, each.high]).tolist()))
    return found


def _mounted(result: ReferenceEvaluation, true: dict[str, Track], elapsed: float) -> dict[str, FloatArray]:
    """(n, 3, 3) true orientations by segment at the compared times, after the fit of constant mountings and clock."""
    segments = [result.reference.segments[target] for target in result.targets]
    times, rows = result.curves.times, np.searchsorted(result.estimate.seconds, result.curves.times)
    rotations = result.estimate.rotations[rows][:, [SEGMENT_NUMBER[segment] for segment in segments]]
    tracks = [true[segment] for segment in segments]
    fit = fit_hand_eye(times, rotations, tracks, segments, np.array([elapsed, 0.0]), middle=result.fit.middle)
    sampled = [track.at(fit.to_reference(times)).rotations for track in tracks]
    return {
        segment: fit.world @ each @ mounting.T
        for segment, each, mounting in zip(segments, sampled, fit.mountings, strict=True)
    }


@dataclass(frozen=True)
class Pendulum:
    """Figures of a link, degrees and milliseconds."""

    link: int
    refused: bool
    offset_ms: float
    offset_stddev_ms: float
    other_half: float
    one_offset: float


def pendulum(folder: Path) -> list[Pendulum]:
    """Each link alone: Vicon's cluster is the target, the inertial sensor is the segment."""
    names = [f"Pendulum_Test02a_Trial1_Segment_{link}.csv.gz" for link in LINKS]
    return [judge_link(*each) for each in zip(LINKS, common.recordings(folder, names), strict=True)]


def judge_link(link: int, path: Path) -> Pendulum:
    """One link."""
    recording, name = record(path), f"link {link}"
    zeros = np.zeros((int(recording.kept.sum()), 3, 3))
    target = Track(recording.times[recording.kept], recording.vicon[recording.kept], zeros)
    settled = np.flatnonzero(recording.stamps > recording.stamps[0] + SETTLING_S)[::2]
    times, ours = recording.stamps[settled], recording.ours[settled].as_matrix()
    own = Track(times, ours, np.zeros((len(times), 3, 3)))
    speeds = [turning(each.times, np.linalg.norm(each.rates(each.times), axis=1)) for each in (own, target)]
    # the pendulum swings for three minutes at one frequency: only a narrow search is unambiguous
    clock = clock_offset(*speeds, window=0.5)
    middle = float(times.mean())
    start = np.zeros(2) if clock is None else np.array([clock.offset, 0.0])
    refused = False
    try:
        fit_hand_eye(times, ours[:, None], [target], [name], start, middle=middle)
    except HandEyeError:
        refused = True
    left, offsets = [], []
    for half in (times < middle, times >= middle):
        sampled = target.at(times[~half] + start[0])
        _, mounting = fit(ours[~half][sampled.known], sampled.rotations[sampled.known], 100)
        known = {name: Mounting(mounting, 1e-8 * np.eye(3))}
        solved = fit_hand_eye(
            *(times[~half], ours[~half, None], [target], [name], start), middle=middle, known_mountings=known
        )
        offsets.append((solved.clock[0], solved.covariance[-2, -2]))
        here = target.at(solved.to_reference(times[half]))
        there = solved.world @ here.rotations @ mounting.T
        left.append(so3.rotation_vectors(there.swapaxes(-1, -2) @ ours[half])[here.known])
    constant = one_offset(recording)
    offset, variance = np.mean(offsets, axis=0)
    return Pendulum(
        link,
        refused,
        1e3 * float(offset),
        1e3 * float(np.sqrt(variance / 2.0)),
        _rms(np.concatenate(left)),
        constant.total,
    )


def _rms(vectors: FloatArray) -> float:
    return float(np.degrees(np.sqrt((vectors**2).sum(axis=1).mean())))


def row_of(case: Case) -> dict[str, object]:
    """Degrees and milliseconds; for some angles [error by markers, bounds of its interval, not absorbed, true]."""
    shown = {
        angle.name: [angle.error, angle.low, angle.high, angle.not_absorbed, angle.true]
        for angle in case.angles
        if angle.name in SHOWN
    }
    return {"clock": case.clock_error, "+-": case.clock_stddev, **shown}


def main() -> None:
    """The benchmark."""
    args = common.parser(__doc__, seeds=2, jobs=True, data=True).parse_args()
    jobs = [Job(*each) for each in product(MOTIONS, FILTERS, range(args.seeds))]
    cases = [case for case in common.mapped(judge, jobs, args.jobs) if case is not None]
    folder = args.data / "imu" / "pendulum_with_reference"
    links = pendulum(folder) if folder.is_dir() else []
    stated = [angle for case in cases for angle in case.angles if np.isfinite(angle.error)]
    ratios = np.array([angle.error / angle.not_absorbed for angle in stated])
    figures = {
        "stated of all angles": [len(stated), sum(len(case.angles) for case in cases)],
        "refused": len(jobs) - len(cases),
        "inside: not absorbed": np.mean([angle.low <= angle.not_absorbed <= angle.high for angle in stated]),
        "inside: true": np.mean([angle.low <= angle.true <= angle.high for angle in stated]),
        "by markers / not absorbed, 10, 50 and 90 %": np.percentile(ratios, [10.0, 50.0, 90.0]),
        "people": {f"{each.job.motion}, {each.job.filter} {each.job.seed}": row_of(each) for each in cases},
        "pendulum": links,
    }
    common.report(args, figures)


if __name__ == "__main__":
    main()

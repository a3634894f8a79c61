"""Joint angles when an inertial sensor fails: in the whole graph, by its published messages.

A simulated person in front of one Kinect v2 wears five inertial sensors (chest, upper arms, forearms; raw data and
magnetic fields of a consumer's chip on a strap, ``inertial.simulated``, each with its own clock). The recording passes
as messages through calibration, fusion, ``imu_skeleton``, the filter ``ekf`` and its estimates, as in ``body_tracking
replay``, all at their defaults. From second 30 on

  disturbed   a magnet lies beside the person for 30 s: at the hanging right hand it adds as much as the earth's field
  off         the right forearm's sensor is switched off for 10 s, and returns with another heading and other biases
  slipped     the right forearm's sensor slips about the arm by 20 degrees, and stays so
  bent        it slips across the arm by 20 degrees, and stays so
  exchanged   the sensors of both forearms are on each other's arm (from the beginning)

For each fault: the time of its first line in the diagnostics; RMS errors of the right arm's angles before the fault,
from its start on, and in the last 20 s; and the share of right angles among all ten (per side the upper arm against the
chest about three axes, elbow, pronation) in all frames from its start on. An angle is right if its error is
below 10 degrees or below 1.96 stated standard deviations. The bars: diagnostics name the fault, and not before it; and
the share of right angles is at least 95 %, or at most 2 % below that of the same recording without a fault.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import common
import numpy as np
from imu_only import ANGLES, Angles, angle_errors, angle_variances, true_configurations
from offline_graph import OfflineGraph

from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.inertial.simulated import SimulatedImu, Slip, usual_mounting
from body_tracking.inertial.stage import ImuStage
from body_tracking.inertial.surroundings import Iron, Surroundings
from body_tracking.messages.codecs import ModelCovariance, ModelState
from body_tracking.pipeline import graph
from body_tracking.recording.replay import ReplaySettings
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.layouts import Layout, around
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, Setup, SimulatedRecording, draw_clock, simulate

SEGMENTS = ("upper_trunk", "upper_arm_left", "forearm_left", "upper_arm_right", "forearm_right")
FAULTY = "forearm_right"
FAULTS = ("none", "disturbed", "off", "slipped", "bent", "exchanged")
NAMED = {
    "disturbed": "magnetic field disturbed",
    "off": f"{FAULTY}: silent",
    "slipped": f"{FAULTY}: its sensor has slipped",
    "bent": f"{FAULTY}: its sensor has slipped",
    "exchanged": f"{FAULTY}: its sensor is on forearm_left",
}
"""Line of the diagnostics for each fault."""
MOTIONS = ("reaching", "arm_raises")
BEGIN, DISTURBED, OFF, SLIP = 30.0, 30.0, 10.0, float(np.radians(20.0))
SETTLED, LAST, LOOKED = 8.0, 20.0, 0.2
"""Seconds at the beginning that are not evaluated, seconds at the end with their own figures, and seconds between two
readings of the diagnostics."""
ENOUGH, RIGHT, LESS = float(np.radians(10.0)), 0.95, 0.02
_FIRST_SEED = 6500
_RIGHT_ARM = [place for place, name in enumerate(ANGLES) if name.endswith("right")]
_MOMENT = 30.0
"""Magnetic moment of the magnet, A m2: 48 uT at 0.5 m on its axis."""


@dataclass(frozen=True, slots=True)
class Run:
    """A motion, a person by seed, and a fault."""

    motion: str
    seed: int
    fault: str
    seconds: float

    def recording(self) -> SimulatedRecording:
        """Simulate it."""
        layout = around((0.0,))
        imus = []
        for number, segment in enumerate(SEGMENTS):
            clock = draw_clock(np.random.default_rng([self.seed, 7, number]))
            imu = SimulatedImu(segment, segment, usual_mounting(segment), 50.0, clock=clock)
            imus.append(self._failing(imu) if segment == FAULTY else imu)
        if self.fault == "exchanged":
            imus = [self._exchanged(imu) for imu in imus]
        return simulate(
            Setup(
                self.motion,
                layout,
                imus=tuple(imus),
                seconds=self.seconds,
                seed=self.seed,
                surroundings=self._surroundings(layout),
            )
        )

    def _failing(self, imu: SimulatedImu) -> SimulatedImu:
        if self.fault == "off":
            return replace(imu, off=((BEGIN, BEGIN + OFF),))
        turns = {"slipped": [0.0, 0.0, SLIP], "bent": [SLIP, 0.0, 0.0]}
        return replace(imu, slips=(Slip(BEGIN, np.array(turns[self.fault])),)) if self.fault in turns else imu

    @staticmethod
    def _exchanged(imu: SimulatedImu) -> SimulatedImu:
        other = {"forearm_left": "forearm_right", "forearm_right": "forearm_left"}.get(imu.segment, imu.segment)
        return replace(imu, segment=other, mounting=usual_mounting(other))

    def _surroundings(self, layout: Layout) -> Surroundings:
        if self.fault != "disturbed":
            return Surroundings()
        left = np.array([-np.sin(layout.yaw), np.cos(layout.yaw), 0.0])
        place = layout.position - 0.6 * left + [0.0, 0.0, 0.8]
        since = BEGIN + 0.5  # the magnet approaches over the half second before
        return Surroundings(iron=(Iron(place, _MOMENT * left, 0.1, since, BEGIN + DISTURBED),))


@dataclass(frozen=True, slots=True, eq=False)
class Figures(Angles):
    """Angles of one run, with the diagnostics.

    Attributes:
        named: time of each line's first appearance in the diagnostics, seconds.
        oriented: time of the last orientation of the faulty sensor's segment, seconds.
    """

    named: dict[str, float]
    oriented: float

    def right(self, since: float) -> FloatArray:
        """(10,) share of the frames from ``since`` (s) with an error below ``ENOUGH`` or 1.96 stated deviations."""
        error, stddev = (np.abs(each[self.times >= since]) for each in (self.error, self.stddev))
        return np.asarray(((error < ENOUGH) | (error < common.NORMAL * stddev)).mean(axis=0), dtype=float)

    def arm(self, since: float, until: float = np.inf) -> float:
        """RMS error of the right arm's angles, degrees."""
        return common.rms_deg(self.error[(self.times >= since) & (self.times < until)][:, _RIGHT_ARM])

    def first(self, words: str) -> float:
        """Time of the first line with these words, seconds; infinite without one."""
        return min((when for line, when in self.named.items() if words in line), default=np.inf)


def measure(run: Run) -> Figures:
    """Simulate a run, and pass it through the graph."""
    recording = run.recording()
    configurations: list[FloatArray] = []
    states: list[tuple[int, FloatArray, FloatArray]] = []  # stamp, configuration and covariance of each estimate
    oriented = 0

    def take(topic: str, cdr: bytes, at_ns: int) -> None:
        nonlocal oriented
        if topic == graph.orientation_topic(FAULTY):
            oriented = at_ns
        elif topic == graph.MODEL_STATE:
            configurations.append(ModelState(MODEL).decode(cdr, BAG_WIRE)[2])
        elif topic == graph.MODEL_COVARIANCE:
            stamp_ns, spread = ModelCovariance(MODEL).decode(cdr, BAG_WIRE)
            states.append((stamp_ns, configurations[-1], spread))

    settings = ReplaySettings(("kinect1",), filter_name="ekf", imus=SEGMENTS, convention="model")
    named: dict[str, float] = {}
    looked = 0.0
    with tempfile.TemporaryDirectory() as folder:
        write_bag(recording, Path(folder) / "bag")
        with BagReader(Path(folder) / "bag") as bag:
            topics = [graph.skeleton_topic("kinect1"), *graph.played_imu_topics(SEGMENTS, bag.topics)]
            whole = OfflineGraph(settings, take, topics)
            stage = whole.stages["imu_skeleton"]
            assert isinstance(stage, ImuStage)
            whole.start(bag.start_ns)
            for raw in bag.messages(topics):
                whole.push(raw.topic, raw.cdr, raw.log_time_ns)
                now = (raw.log_time_ns - RECEIVED_FROM_NS) / NANOSECONDS
                if now - looked > LOOKED:
                    looked = now
                    for line in stage.tracker.problems(raw.log_time_ns):
                        named.setdefault(line, now)
    times = np.array([(stamp_ns - START_NS) / NANOSECONDS for stamp_ns, _, _ in states])
    judged = times >= SETTLED
    q = np.array([each[1] for each in states])[judged]
    variances = [angle_variances(*each[1:]) for each, is_judged in zip(states, judged, strict=True) if is_judged]
    return Figures(
        times[judged],
        angle_errors(q, true_configurations(recording, times[judged])),
        np.sqrt(np.array(variances)),
        named,
        (oriented - RECEIVED_FROM_NS) / NANOSECONDS,
    )


def judge(fault: str, results: list[Figures], usual: list[Figures]) -> tuple[dict[str, Any], bool]:
    """Figures of runs with a fault, beside those without: degrees, percent; and whether the bars are met."""
    since = SETTLED if fault == "exchanged" else BEGIN
    until = max(float(each.times[-1]) for each in results)
    right, as_usual = (float(np.mean([each.right(since) for each in some])) for some in (results, usual))
    spans = {"before": (SETTLED, BEGIN), "after": (since,), f"last {LAST:.0f} s": (until - LAST,)}
    figures: dict[str, Any] = {
        **{name: float(np.mean([each.arm(*span) for each in results])) for name, span in spans.items()},
        "right": 100.0 * right,
        "without": 100.0 * as_usual,
    }
    if fault == "none":
        named = sorted({f"{line} ({when:.0f} s)" for each in results for line, when in each.named.items()})
        return figures | {"named": "; ".join(named)}, True
    first = [each.first(NAMED[fault]) for each in results]
    begin = 0.0 if fault == "exchanged" else BEGIN
    figures["named"] = f"after {', '.join(f'{when - begin:.1f}' for when in first)} s"
    figures["runs with orientations at the end"] = sum(each.oriented > until - 1.0 for each in results)
    return figures, all(begin <= when < np.inf for when in first) and right >= min(RIGHT, as_usual - LESS)


def main() -> int:
    """The benchmark: 1 where a bar is missed."""
    parser = common.parser(__doc__, seeds=2, motions=MOTIONS, jobs=True)
    parser.add_argument("--faults", type=common.names, default=FAULTS[1:], metavar="A,B", help="(default: all)")
    parser.add_argument("--seconds", type=float, default=90.0, metavar="S", help="of each run (default: %(default)g)")
    args = parser.parse_args()
    faults = ["none", *args.faults]
    if unknown := set(faults) - set(FAULTS):
        parser.error(f"unknown: {', '.join(sorted(unknown))}; there are {', '.join(FAULTS)}")
    people = [(motion, _FIRST_SEED + seed) for seed in range(args.seeds) for motion in args.motions]
    runs = [Run(motion, seed, fault, args.seconds) for fault in faults for motion, seed in people]
    results = common.mapped(measure, runs, args.jobs)
    by_fault = {
        fault: [each for run, each in zip(runs, results, strict=True) if run.fault == fault] for fault in faults
    }
    judged = {fault: judge(fault, each, by_fault["none"]) for fault, each in by_fault.items()}
    common.report(args, {"degrees RMS of the right arm": {fault: figures for fault, (figures, _) in judged.items()}})
    return common.verdicts(args, {fault: judged[fault][1] for fault in faults[1:]})


if __name__ == "__main__":
    sys.exit(main())

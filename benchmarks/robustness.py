"""Does the extended filter survive everything? Many random runs that are made hard on purpose.

Each run draws a body, a motion (half of them with a special posture, a third with full turns) and what is done to the
filter: a start up to 60 degrees wrong in every angle, noise of 2 to 60 mm, dropouts of up to 2 s (of limbs, of the
trunk, of everything), frame gaps of up to 1 s, 5 % outliers of up to 1 m. No joint is absent for more than 2 s on end.
All of that ends 2 s before the run does; from then on only the noise remains. Default settings; the filter
knows neither body nor noise nor what happened.

back       the RMS error of the 19 points is no more than that of the raw measurements, sqrt(3) times the noise, plus
           30 mm, from then on to the end; the time to it counts from the first frame of good data. A steady filter has
           about half the raw error, so that this is well above its steady state at any noise.
diverged   not back at the end, or some point is wrong by more than 3 times the noise + 80 mm there (median of the last
           0.5 s; the raw measurements' own median is 1.5 times the noise)
excess     greatest angle beyond a range of motion at any frame (ranges.excess)
surprise   greatest error of an observed angle over its stated standard deviation, median of the last 0.5 s: shows
           runs that fit the points with a wrong pose

With ``--standing`` instead a person who stands still: by how much each angle that nothing observes, averaged over a
second, leaves its average over the first one. White noise of 20 mm is measured.

  python benchmarks/robustness.py                  1,000 runs
  python benchmarks/robustness.py --only 123       that run alone, frame by frame
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import common
import numpy as np
from honesty import NAMES, OBSERVED, all_runs, new_filter

from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint
from body_tracking.filters.ekf import EkfParameters, ExtendedKalmanFilter
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.random_people import (
    MODEL,
    POSTURES,
    Dropout,
    MeasurementErrors,
    Observation,
    RandomMotion,
    RandomPerson,
    Truth,
    capture_times,
    draw_dropouts,
    observe,
    truth_of,
)

GOOD = 2.0
"""Seconds of good data at the end."""
BACK_WITHIN = 1.0
"""Seconds of good data after which the filter must be back."""
EXCESS_BAR = 15.0
"""Degrees."""
DRIFT_BAR, STANDING_NOISE, STANDING_RATE = 10.0, 0.02, 30.0
"""Of a person who stands still: degrees, metres, Hz."""
WRONG_START = np.radians(60.0)
LONGEST_DROPOUT, LONGEST_GAP = 2.0, 1.0
"""Seconds."""
_GRID = 0.01
END = 0.5
"""Seconds at the end over which medians are taken."""
RANGES = Ranges(MODEL)
POINTS = [Joint(joint).name.lower() for joint in MODEL.joints]


@dataclass(frozen=True)
class Settings:
    """What all runs share; see the command line's help."""

    seed: int
    seconds: float
    overlap: bool
    parameters: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Scenario:
    """What is done to the filter in one run.

    Attributes:
        noise: metres.
        wrong_start: degrees by which the worst angle is wrong at the start, 0 for a start by the filter itself.
        postures, full_turns: of the motion.
        trouble: (begin, end) seconds of dropouts, gaps and outliers.
        errors: all of them.
    """

    noise: float
    wrong_start: float
    postures: tuple[str, ...]
    full_turns: int
    trouble: tuple[float, float]
    errors: MeasurementErrors

    def __str__(self) -> str:
        parts = [f"noise {1e3 * self.noise:.0f} mm"]
        if self.wrong_start:
            parts.append(f"start {self.wrong_start:.0f} deg wrong")
        parts += [posture.replace("_", " ") for posture in self.postures]
        if self.full_turns:
            parts.append("full turn")
        for dropout in self.errors.dropouts:
            names = (
                "everything" if len(dropout.joints) == 25 else "+".join(joint.name.lower() for joint in dropout.joints)
            )
            parts.append(f"{names} lost {dropout.begin:.1f}-{dropout.end:.1f} s")
        parts += [f"gap {begin:.1f}-{end:.1f} s" for begin, end in self.errors.gaps]
        if self.errors.outliers:
            parts.append(f"{100 * self.errors.outliers:.0f} % outliers {self.trouble[0]:.1f}-{self.trouble[1]:.1f} s")
        return ", ".join(parts)


@dataclass(frozen=True)
class Outcome:
    """How one run went; see the module's text.

    Attributes:
        back_after: seconds of good data; infinity for never.
        start_back_after: seconds from a wrong start to being back, where good data follow it; NaN elsewhere.
        end_error, end_noise: metres, RMS over the 19 points of the estimate and of the measurements.
        end_worst: metres, of the worst point, and which point it is.
    """

    number: int
    scenario: str
    nan: bool
    diverged: bool
    back_after: float
    start_back_after: float
    excess: float
    excess_at: str
    end_error: float
    end_noise: float
    end_worst: float
    end_worst_point: str
    surprise: float
    surprise_at: str
    frames_without: int
    counters: dict[str, int]

    @property
    def failed(self) -> bool:
        """Any bar is missed."""
        slow = self.back_after > BACK_WITHIN or self.start_back_after > BACK_WITHIN
        return self.nan or self.diverged or self.excess > EXCESS_BAR or slow


def _longest(missing: BoolArray) -> float:
    """Seconds of the longest run of true values along the first axis of (n, k) steps of _GRID."""
    now, longest = np.zeros(missing.shape[1]), 0.0
    for row in missing:
        now = np.where(row, now + _GRID, 0.0)
        longest = max(longest, float(now.max()))
    return longest


def _bearable(dropouts: Sequence[Dropout], gaps: Sequence[tuple[float, float]], seconds: float) -> bool:
    """No gap, and no absence of any joint by gaps and dropouts together, is longer than it may be."""
    times = np.arange(0.0, seconds, _GRID)
    frames = np.zeros(len(times), dtype=np.bool_)
    for begin, end in gaps:
        frames |= (times >= begin) & (times < end)
    joints = np.tile(frames[:, None], (1, len(MODEL.joints)))
    for dropout in dropouts:
        during = (times >= dropout.begin) & (times < dropout.end)
        joints |= during[:, None] & np.isin(MODEL.joints, dropout.joints)
    return _longest(frames[:, None]) <= LONGEST_GAP + _GRID and _longest(joints) <= LONGEST_DROPOUT + _GRID


def draw_scenario(rng: np.random.Generator, seconds: float, overlap: bool) -> Scenario:
    """What happens in a run; ``overlap``: see the command line's help."""
    noise = 0.002 * 30.0 ** rng.random()
    # half of the wrong starts are followed by good data, so that the way back from them is seen alone
    trouble = (0.0 if rng.random() < 0.5 else 1.5, seconds - GOOD)
    while True:
        dropouts = draw_dropouts(rng, int(rng.integers(0, 4)), trouble, longest=LONGEST_DROPOUT, everything=0.15)
        gaps = []
        for _ in range(rng.integers(0, 3)):
            length = rng.uniform(0.1, LONGEST_GAP)
            begin = rng.uniform(trouble[0], trouble[1] - length)
            gaps.append((begin, begin + length))
        if overlap or _bearable(dropouts, gaps, seconds):
            break
    outliers = 0.05 if rng.random() < 0.6 else 0.0
    return Scenario(
        noise=noise,
        wrong_start=rng.uniform(20.0, np.degrees(WRONG_START)) if rng.random() < 0.7 else 0.0,
        postures=(str(rng.choice(POSTURES)),) if rng.random() < 0.5 else (),
        full_turns=int(rng.random() < 0.35),
        trouble=trouble,
        errors=MeasurementErrors(noise, None, dropouts, tuple(gaps), outliers, 1.0, trouble),
    )


def wrong_start(q: FloatArray, degrees: float, rng: np.random.Generator) -> FloatArray:
    """(35,) a configuration within all ranges of which every joint is wrong by up to so many degrees.

    The base and the shoulders are turned by up to this angle about any axis, the base is 0.1 m off its place per axis.
    """
    scalars = np.isin(np.arange(MODEL.nv), MODEL.scalar_v)
    wrong = q
    for share in np.linspace(1.0, 0.0, 41):
        v = np.radians(degrees) * rng.uniform(-1.0, 1.0, MODEL.nv)
        v[:3] = 0.1 * rng.normal(size=3)
        balls = np.flatnonzero(~scalars)[3:].reshape(-1, 3)
        direction = rng.normal(size=balls.shape)
        size = np.radians(degrees) * rng.random((len(balls), 1)) ** (1 / 3)
        v[balls] = size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        v[balls[1:]] *= share
        wrong = MODEL.integrate(q, v)
        wrong[MODEL.scalar_q] = np.clip(
            wrong[MODEL.scalar_q], RANGES.low[MODEL.scalar_v - 6], RANGES.high[MODEL.scalar_v - 6]
        )
        if RANGES.excess(wrong).max() == 0.0:
            break
    return wrong


@dataclass(frozen=True, eq=False)
class Course:
    """What the filter said in one run, n frames that arrived.

    Attributes:
        frames: (n,) of the truth.
        q, stddev: (n, 35) and (n, 32); NaN before the first estimate.
        error: (n, 19) metres, of the points.
        nan: something that must be a number was none.
        without: frames without an estimate.
        counters: of the filter.
    """

    frames: IntArray
    q: FloatArray
    stddev: FloatArray
    error: FloatArray
    nan: bool
    without: int
    counters: dict[str, int]


def track(scenario: Scenario, truth: Truth, seen: Observation, parameters: Mapping[str, float], start: Any) -> Course:
    """The filter over one run; ``start`` is a configuration to begin with, or None."""
    estimator = new_filter(parameters)
    count = len(seen.frames)
    q, stddev = np.full((count, MODEL.nq), np.nan), np.full((count, MODEL.nv), np.nan)
    error = np.full((count, len(MODEL.joints)), np.nan)
    nan, without = False, 0
    if start is not None:
        estimator.start(start, stamp_ns=seen.skeletons[0].stamp_ns - 33_000_000)
    for k, (skeleton, frame) in enumerate(zip(seen.skeletons, seen.frames, strict=True)):
        output, estimate = estimator.update(skeleton), estimator.estimate
        if output is None or estimate is None:
            without += 1
            continue
        variance = np.diag(estimate.covariance)
        tracked = output.states[MODEL.joints] > 0
        nan |= not (np.isfinite(estimate.q).all() and np.isfinite(estimate.velocity).all())
        nan |= not np.isfinite(estimate.lengths).all() or bool(np.isnan(estimate.covariance).any())
        nan |= bool((variance < 0.0).any()) or not np.isfinite(output.positions[MODEL.joints][tracked]).all()
        q[k], stddev[k] = estimate.q, np.sqrt(np.maximum(variance[: MODEL.nv], 0.0))
        positions = MODEL.forward(estimate.q, estimate.lengths).positions
        error[k] = np.linalg.norm(positions - truth.positions[frame], axis=1)
    return Course(seen.frames, q, stddev, error, nan, without, dict(estimator.counters))


def prepare(number: int, settings: Settings) -> tuple[Scenario, Truth, Observation, FloatArray | None]:
    """Everything that is drawn for a run, from its number."""
    rng = np.random.default_rng([settings.seed, number])
    scenario = draw_scenario(rng, settings.seconds, settings.overlap)
    person = RandomPerson.draw(rng)
    motion = RandomMotion(rng, settings.seconds, postures=scenario.postures, full_turns=scenario.full_turns)
    truth = truth_of(person, motion, capture_times(settings.seconds, rng))
    seen = observe(truth, scenario.errors, rng)
    start = wrong_start(truth.q[seen.frames[0]], scenario.wrong_start, rng) if scenario.wrong_start else None
    return scenario, truth, seen, start


def first_lasting(times: FloatArray, good: BoolArray, begin: float, end: float) -> float:
    """Seconds from the first frame after ``begin`` until it is good and stays so to ``end``; infinity for never."""
    where = np.flatnonzero((times >= begin) & (times < end))
    if not len(where) or not good[where[-1]]:
        return np.inf
    bad = np.flatnonzero(~good[where])
    return float(times[where[bad[-1] + 1 if len(bad) else 0]] - times[where[0]])


def run(settings: Settings, number: int) -> Outcome:
    """One run from its number."""
    scenario, truth, seen, start = prepare(number, settings)
    course = track(scenario, truth, seen, settings.parameters, start)
    times = truth.times[course.frames]
    rms = np.sqrt((course.error**2).mean(axis=1))
    good = rms <= bound(scenario)
    last = times >= settings.seconds - END
    worst = np.median(course.error[last], axis=0)
    back_after = first_lasting(times, good, scenario.trouble[1], np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # runs in which the filter said nothing at all
        excess = np.degrees(np.nan_to_num(np.abs(RANGES.excess(course.q)), nan=0.0))
        surprise = np.abs(MODEL.difference(course.q[last], truth.q[course.frames[last]])) / course.stddev[last]
        surprise = np.median(surprise, axis=0)[OBSERVED]
    frame, coordinate = np.unravel_index(excess.argmax(), excess.shape)
    measured = np.stack([skeleton.positions for skeleton in seen.skeletons])[:, MODEL.joints]
    raw = np.linalg.norm(measured - truth.positions[seen.frames], axis=2)
    return Outcome(
        number=number,
        scenario=str(scenario),
        nan=course.nan,
        diverged=not (np.isfinite(back_after) and worst.max() <= 3.0 * scenario.noise + 0.08),
        back_after=back_after,
        start_back_after=first_lasting(times, good, 0.0, scenario.trouble[0])
        if scenario.wrong_start and scenario.trouble[0] > 0.0
        else np.nan,
        excess=float(excess.max()),
        excess_at=f"{NAMES[6 + int(coordinate)]} at {times[frame]:.2f} s",
        end_error=float(np.sqrt((course.error[last] ** 2).mean())),
        end_noise=float(np.sqrt((raw[last] ** 2).mean())),
        end_worst=float(worst.max()),
        end_worst_point=POINTS[int(np.argmax(worst))],
        surprise=float(surprise.max()),
        surprise_at=NAMES[int(OBSERVED[surprise.argmax()])],
        frames_without=course.without,
        counters=course.counters,
    )


def standing(minutes: float, seed: int, parameters: Mapping[str, float]) -> dict[str, float]:
    """Greatest departure of each unobserved angle from its start, degrees, for a person who stands still."""
    rng = np.random.default_rng(seed)
    lengths, times = RandomPerson.draw(rng).lengths, capture_times(60.0 * minutes, rng, STANDING_RATE)
    # upright to some degrees, the arms hanging with slightly bent elbows
    tangent = np.zeros(MODEL.nv)
    tangent[6:12] = np.radians(rng.normal(scale=4.0, size=6))
    tangent[[NAMES.index(f"elbow_flexion_{side}") for side in ("left", "right")]] = np.radians(rng.uniform(5, 25, 2))
    q = np.tile(MODEL.integrate(MODEL.neutral(), tangent), (len(times), 1))
    positions = MODEL.forward(q, lengths).positions
    truth = Truth(times, q, np.zeros((len(times), MODEL.nv)), lengths, positions, np.zeros(positions.shape[:2]))
    estimator = ExtendedKalmanFilter(EkfParameters(**parameters))
    columns, second = [NAMES.index(each) for each in UNOBSERVED], round(STANDING_RATE)
    history = []
    for skeleton in observe(truth, MeasurementErrors(STANDING_NOISE), rng).skeletons:
        estimator.update(skeleton)
        if estimator.estimate is not None:
            history.append(np.degrees(MODEL.difference(MODEL.neutral(), estimator.estimate.q)[columns]))
    averages = np.array(history[: len(history) // second * second]).reshape(-1, second, len(columns)).mean(axis=1)
    return dict(zip(UNOBSERVED, np.abs(averages - averages[0]).max(axis=0).tolist(), strict=True))


def bound(scenario: Scenario) -> float:
    """Metres: greatest RMS error of the 19 points of a filter that is back."""
    return float(np.sqrt(3.0) * scenario.noise + 0.03)


def frame_by_frame(number: int, settings: Settings) -> None:
    """What happened in one run."""
    scenario, truth, seen, start = prepare(number, settings)
    course = track(scenario, truth, seen, settings.parameters, start)
    print(f"run {number}: {scenario}")
    print(f"good data from {scenario.trouble[1]} s; back is below {1e3 * bound(scenario):.0f} mm")
    print(f"{'time, s  points  outliers  rms, mm  worst, mm':62}{'excess, deg':34}largest error, deg")
    for k, frame in enumerate(course.frames):
        line = f"{truth.times[frame]:7.3f} {seen.seen[frame].sum():7} {seen.outlier[frame].sum():9}  "
        if np.isnan(course.q[k]).any():
            print(line + "no estimate")
            continue
        point, error = int(course.error[k].argmax()), course.error[k]
        excess = np.degrees(np.abs(RANGES.excess(course.q[k])))
        wrong = np.degrees(MODEL.difference(course.q[k], truth.q[frame]))
        wrong[:3] = 0.0
        angle = int(np.abs(wrong).argmax())
        print(
            line + f"{1e3 * np.sqrt((error**2).mean()):7.0f} {1e3 * error[point]:7.0f} {POINTS[point]:16}"
            f" {excess.max():6.1f} {NAMES[6 + int(excess.argmax())] if excess.max() > 0.0 else '':26}"
            f" {wrong[angle]:7.1f} +- {np.degrees(course.stddev[k, angle]):5.1f} {NAMES[angle]}"
        )
    print(f"counters: {course.counters}\n{run(settings, number)}")


def quantiles(values: list[float]) -> str:
    """Median, 95 %, 99 % and greatest."""
    if not values:
        return "none"
    ordered = np.sort(values)
    picks = [ordered[min(int(share * len(ordered)), len(ordered) - 1)] for share in (0.5, 0.95, 0.99, 1.0)]
    return "median {:.2f}, 95 % {:.2f}, 99 % {:.2f}, greatest {:.2f}".format(*picks)


def show(outcomes: list[Outcome], broken: dict[int, str], worst: int) -> None:
    """The figures, and the runs to look into."""
    back = [outcome.back_after for outcome in outcomes]
    start = [outcome.start_back_after for outcome in outcomes if not np.isnan(outcome.start_back_after)]
    ratio = [outcome.end_error / outcome.end_noise for outcome in outcomes]
    print(f"{len(outcomes) + len(broken)} runs")
    print(f"  ended in an error                  {len(broken)}")
    print(f"  NaN                                {sum(outcome.nan for outcome in outcomes)}")
    apart = sum(outcome.diverged and np.isfinite(outcome.back_after) for outcome in outcomes)
    print(f"  diverged                           {sum(outcome.diverged for outcome in outcomes)}"
          f" ({apart} of them by single points only)")  # fmt: skip
    over = sum(outcome.excess > EXCESS_BAR for outcome in outcomes)
    print(f"  beyond a range by over {EXCESS_BAR:.0f} deg      {over}")
    print(f"  not back within {BACK_WITHIN:g} s of good data  {sum(not after <= BACK_WITHIN for after in back)}")
    late = sum(not after <= BACK_WITHIN for after in start)
    print(f"  nor within {BACK_WITHIN:g} s of a wrong start   {late} of {len(start)}")
    print(f"excess, deg:                  {quantiles([outcome.excess for outcome in outcomes])}")
    print(f"back after, s:                {quantiles(back)}")
    print(f"back after a wrong start, s:  {quantiles(start)}")
    print(f"error at the end / raw error: {quantiles(ratio)}")
    print(f"surprise, standard deviations: {quantiles([outcome.surprise for outcome in outcomes])}")

    def listed(title: str, value: Callable[[Outcome], float], text: Callable[[Outcome], str], beyond: float) -> None:
        chosen = [outcome for outcome in outcomes if not value(outcome) <= beyond and not np.isnan(value(outcome))]
        if chosen:
            print(f"\n{title}")
        for outcome in sorted(chosen, key=lambda each: -value(each))[:worst]:
            print(f"  --only {outcome.number:<5} {text(outcome)}; {outcome.scenario}")

    listed(
        "diverged or NaN:",
        lambda o: float(o.diverged or o.nan),
        lambda o: (
            f"rms {1e3 * o.end_error:.0f} mm (raw {1e3 * o.end_noise:.0f}), "
            f"{o.end_worst_point} {1e3 * o.end_worst:.0f} mm"
        ),
        0.0,
    )
    listed("longest until back:", lambda o: o.back_after, lambda o: f"{o.back_after:.2f} s", BACK_WITHIN)
    listed(
        "longest until back from a wrong start:",
        lambda o: o.start_back_after,
        lambda o: f"{o.start_back_after:.2f} s",
        BACK_WITHIN,
    )
    listed("greatest excess:", lambda o: o.excess, lambda o: f"{o.excess:.1f} deg, {o.excess_at}", -1.0)
    listed(
        "greatest surprise:",
        lambda o: float(np.nan_to_num(o.surprise, nan=np.inf)),
        lambda o: f"{o.surprise:.1f} standard deviations, {o.surprise_at}",
        -1.0,
    )
    for number, problem in sorted(broken.items())[:worst]:
        print(f"\n--only {number} ended in an error:\n{problem}")


def main() -> int:
    """The benchmark; exit code 1 where any run misses a bar."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--runs", type=int, default=1000, metavar="N", help="random runs (default: %(default)s)")
    parser.add_argument("--only", type=int, metavar="N", help="this run alone, frame by frame")
    parser.add_argument("--seed", type=int, default=0, help="of all chance (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=6.0, help="length of a run (default: %(default)g)")
    parser.add_argument("--worst", type=int, default=5, metavar="N", help="runs to list of a kind (default: 5)")
    parser.add_argument("--overlap", action="store_true", help="dropouts and gaps may add up to longer ones: harder")
    parser.add_argument("--standing", type=float, metavar="MINUTES", help="a person who stands still, instead")
    common.add_set(parser)
    args = parser.parse_args()
    if args.seconds < GOOD + 3.0:
        parser.error(f"--seconds {args.seconds:g}: at least {GOOD + 3.0:g}")
    settings = Settings(args.seed, args.seconds, args.overlap, dict(args.set))
    new_filter(settings.parameters)  # a wrong parameter ends the benchmark here
    if args.standing is not None:
        drift = standing(args.standing, args.seed, settings.parameters)
        text = "\n".join(f"{name}: up to {value:.1f} deg from its first second" for name, value in drift.items())
        common.report(args, drift, lambda: print(text))
        return common.verdicts(args, {f"{name} below {DRIFT_BAR:g} deg": x <= DRIFT_BAR for name, x in drift.items()})
    if args.only is not None:
        frame_by_frame(args.only, settings)
        return 0
    outcomes, broken = all_runs(run, settings, list(range(args.runs)), args.jobs)
    common.report(args, {"runs": outcomes, "broken": broken}, lambda: show(outcomes, broken, args.worst))
    return bool(broken) or any(outcome.failed for outcome in outcomes)


if __name__ == "__main__":
    sys.exit(main())

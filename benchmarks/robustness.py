"""Does the extended filter survive everything? Many random runs that are made hard on purpose.

Each run draws a body, a motion (half of them with a special posture, a third with full turns) and the disturbances: a
start up to 60 degrees wrong in every angle, noise of 2 to 60 mm, dropouts of up to 2 s (of limbs, of the trunk, of
everything), frame gaps of up to 1 s, 5 % outliers of up to 1 m. No joint is absent for more than 2 s at a time. All
disturbances end 2 s before the run; from then on only the noise remains. The filter has default settings; it knows
neither body nor noise nor disturbances.

back       the RMS error of the 19 points is at most that of the raw measurements, sqrt(3) times the noise, plus 30 mm,
           until the end; the time to it counts from the first frame of good data. A steady filter has about half the
           raw error, so that this limit is well above its steady state at any noise.
diverged   not back at the end, or the error of some point there exceeds 3 times the noise + 80 mm (median of the last
           0.5 s; the raw measurements' own median is 1.5 times the noise)
excess     largest angle beyond a range of motion at any frame (ranges.excess)
surprise   largest error of an observed angle over its stated standard deviation, median of the last 0.5 s: shows
           runs that fit the points with a wrong pose
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import common
import numpy as np
from honesty import NAMES, OBSERVED, Settings, all_runs, new_filter
from random_people import (
    Dropout,
    MeasurementErrors,
    Observation,
    RandomPerson,
    Truth,
    capture_times,
    draw_dropouts,
    observe,
    truth_of,
)

from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.kinematics.ranges import Ranges
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import POSTURES, RandomMotion

GOOD = 2.0
"""Seconds of good data at the end."""
BACK_WITHIN = 1.0
"""Seconds of good data after which the filter must be back."""
EXCESS_BAR = 15.0
"""Largest angle beyond a range of motion, degrees."""
WRONG_START = np.radians(60.0)
LONGEST_DROPOUT, LONGEST_GAP = 2.0, 1.0
"""Longest absence of a joint, and of frames, seconds."""
_GRID = 0.01
END, WORST = 0.5, 5
"""Seconds at the end for medians; number of listed runs of each kind."""
RANGES = Ranges(MODEL)


@dataclass(frozen=True, eq=False)
class Scenario:
    """Disturbances of one run.

    Attributes:
        noise: standard deviation per axis, metres.
        wrong_start: largest error of an angle at the start, degrees; 0 for a start by the filter itself.
        postures, full_turns: of the motion.
        trouble: (begin, end) of dropouts, gaps and outliers, seconds.
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
    """Result of one run; see the module's docstring. Angles in degrees, errors in millimetres.

    Attributes:
        back_after: seconds of good data until back; infinity for never.
        start_back_after: seconds from a wrong start until back, if good data follow the start; NaN otherwise.
        end_error, end_noise: RMS over the 19 points of the estimate and of the measurements.
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
    surprise: float
    surprise_at: str


def _longest(missing: BoolArray) -> float:
    """Duration of the longest run of true values along the first axis of (n, k), steps of _GRID; seconds."""
    now, longest = np.zeros(missing.shape[1]), 0.0
    for row in missing:
        now = np.where(row, now + _GRID, 0.0)
        longest = max(longest, float(now.max()))
    return longest


def _bearable(dropouts: Sequence[Dropout], gaps: Sequence[tuple[float, float]], seconds: float) -> bool:
    """Whether no gap, and no absence of any joint by gaps and dropouts together, is too long."""
    times = np.arange(0.0, seconds, _GRID)
    frames = np.zeros(len(times), dtype=np.bool_)
    for begin, end in gaps:
        frames |= (times >= begin) & (times < end)
    joints = np.tile(frames[:, None], (1, len(MODEL.joints)))
    for dropout in dropouts:
        during = (times >= dropout.begin) & (times < dropout.end)
        joints |= during[:, None] & np.isin(MODEL.joints, dropout.joints)
    return _longest(frames[:, None]) <= LONGEST_GAP + _GRID and _longest(joints) <= LONGEST_DROPOUT + _GRID


def draw_scenario(rng: np.random.Generator, seconds: float) -> Scenario:
    """Draw the disturbances of a run."""
    noise = 0.002 * 30.0 ** rng.random()
    # half of the wrong starts are followed by good data, to see the recovery from the start alone
    trouble = (0.0 if rng.random() < 0.5 else 1.5, seconds - GOOD)
    while True:
        dropouts = draw_dropouts(rng, int(rng.integers(0, 4)), trouble, longest=LONGEST_DROPOUT, everything=0.15)
        gaps = []
        for _ in range(rng.integers(0, 3)):
            length = rng.uniform(0.1, LONGEST_GAP)
            begin = rng.uniform(trouble[0], trouble[1] - length)
            gaps.append((begin, begin + length))
        if _bearable(dropouts, gaps, seconds):
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
    """(35,) configuration within all ranges, with an error of up to this number of degrees in every joint.

    The base and the shoulders are turned by up to this angle about any axis; the base is displaced by 0.1 m per axis
    (standard deviation).
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
    """Output of the filter in one run with n received frames.

    Attributes:
        q, stddev: (n, 35) and (n, 32); NaN before the first estimate.
        error: (n, 19) of the points, metres.
        nan: whether a value that must be finite was not.
    """

    q: FloatArray
    stddev: FloatArray
    error: FloatArray
    nan: bool


def track(truth: Truth, seen: Observation, parameters: Mapping[str, float], start: Any) -> Course:
    """Run the filter; ``start`` is the initial configuration, or None."""
    estimator = new_filter(parameters)
    count = len(seen.frames)
    q, stddev = np.full((count, MODEL.nq), np.nan), np.full((count, MODEL.nv), np.nan)
    error = np.full((count, len(MODEL.joints)), np.nan)
    nan = False
    if start is not None:
        estimator.start(start, stamp_ns=seen.skeletons[0].stamp_ns - 33_000_000)
    for k, (skeleton, frame) in enumerate(zip(seen.skeletons, seen.frames, strict=True)):
        output, estimate = estimator.update(skeleton), estimator.estimate
        if output is None or estimate is None:
            continue
        variance = np.diag(estimate.covariance)
        tracked = output.states[MODEL.joints] > 0
        nan |= not (np.isfinite(estimate.q).all() and np.isfinite(estimate.velocity).all())
        nan |= not np.isfinite(estimate.lengths).all() or bool(np.isnan(estimate.covariance).any())
        nan |= bool((variance < 0.0).any()) or not np.isfinite(output.positions[MODEL.joints][tracked]).all()
        q[k], stddev[k] = estimate.q, np.sqrt(np.maximum(variance[: MODEL.nv], 0.0))
        positions = MODEL.forward(estimate.q, estimate.lengths).positions
        error[k] = np.linalg.norm(positions - truth.positions[frame], axis=1)
    return Course(q, stddev, error, nan)


def first_lasting(times: FloatArray, good: BoolArray, begin: float, end: float) -> float:
    """Seconds from the first frame after ``begin`` to the first from which all are good to ``end``, or infinity."""
    where = np.flatnonzero((times >= begin) & (times < end))
    if not len(where) or not good[where[-1]]:
        return np.inf
    bad = np.flatnonzero(~good[where])
    return float(times[where[bad[-1] + 1 if len(bad) else 0]] - times[where[0]])


def run(settings: Settings, number: int) -> Outcome:
    """One run; its number seeds all draws."""
    rng = np.random.default_rng([0, number])
    scenario = draw_scenario(rng, settings.seconds)
    person = RandomPerson.draw(rng)
    motion = RandomMotion(rng, settings.seconds, postures=scenario.postures, full_turns=scenario.full_turns)
    truth = truth_of(person, motion, capture_times(settings.seconds, rng))
    seen = observe(truth, scenario.errors, rng)
    start = wrong_start(truth.q[seen.frames[0]], scenario.wrong_start, rng) if scenario.wrong_start else None
    course = track(truth, seen, settings.parameters, start)
    times = truth.times[seen.frames]
    rms = np.sqrt((course.error**2).mean(axis=1))
    good = rms <= np.sqrt(3.0) * scenario.noise + 0.03
    last = times >= settings.seconds - END
    worst = np.median(course.error[last], axis=0)
    back_after = first_lasting(times, good, scenario.trouble[1], np.inf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # for runs without any estimate
        excess = np.degrees(np.nan_to_num(np.abs(RANGES.excess(course.q)), nan=0.0))
        surprise = np.abs(MODEL.difference(course.q[last], truth.q[seen.frames[last]])) / course.stddev[last]
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
        end_error=1e3 * common.rms(course.error[last]),
        end_noise=1e3 * common.rms(raw[last]),
        surprise=float(surprise.max()),
        surprise_at=NAMES[int(OBSERVED[surprise.argmax()])],
    )


def summary(outcomes: list[Outcome]) -> dict[str, Any]:
    """Quantiles over all runs, and the worst runs of each kind."""
    ratio = [outcome.end_error / outcome.end_noise for outcome in outcomes]
    columns = {
        name: np.array([getattr(each, name) for each in outcomes]) for name in ("excess", "back_after", "surprise")
    }
    columns |= {
        "start_back_after": np.array(
            [each.start_back_after for each in outcomes if not np.isnan(each.start_back_after)]
        ),
        "error at the end / raw error": np.array(ratio),
    }
    shares = {"median": 0.5, "95 %": 0.95, "99 %": 0.99, "greatest": 1.0}
    quantiles = {
        name: {key: float(np.quantile(values, share, method="higher")) for key, share in shares.items()}
        for name, values in columns.items()
        if len(values)
    }
    worst = {
        f"greatest {name}": {
            f"run {outcomes[k].number}": {
                "": columns[name][k],
                "at": getattr(outcomes[k], f"{name}_at", ""),
                "scenario": outcomes[k].scenario,
            }
            for k in np.argsort(-np.nan_to_num(columns[name], nan=np.inf))[:WORST]
        }
        for name in ("excess", "back_after", "surprise")
    }
    return {"quantiles": quantiles, **worst}


def main() -> int:
    """The benchmark; exit code 1 where any run misses a bar."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--runs", type=int, default=1000, metavar="N", help="random runs (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=6.0, help="length of a run (default: %(default)g)")
    common.add_set(parser)
    args = parser.parse_args()
    if args.seconds < GOOD + 3.0:
        parser.error(f"--seconds {args.seconds:g}: at least {GOOD + 3.0:g}")
    settings = Settings(args.seconds, dict(args.set))
    new_filter(settings.parameters)  # an unknown parameter ends the benchmark here
    outcomes, broken = all_runs(run, settings, range(args.runs), args.jobs)
    common.report(args, summary(outcomes) | {"broken runs": list(broken)})
    started = [each for each in outcomes if not np.isnan(each.start_back_after)]
    missed = {
        "ended in an error": len(broken),
        "NaN": sum(each.nan for each in outcomes),
        "diverged": sum(each.diverged for each in outcomes),
        f"beyond a range by over {EXCESS_BAR:.0f} deg": sum(each.excess > EXCESS_BAR for each in outcomes),
        f"not back within {BACK_WITHIN:g} s of good data": sum(each.back_after > BACK_WITHIN for each in outcomes),
        f"nor within {BACK_WITHIN:g} s of a wrong start": sum(each.start_back_after > BACK_WITHIN for each in started),
    }
    return common.verdicts(args, {f"{count} of {args.runs} runs {name}": not count for name, count in missed.items()})


if __name__ == "__main__":
    sys.exit(main())

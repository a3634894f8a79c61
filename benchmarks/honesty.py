"""Is the uncertainty of the extended filter true? Normalised errors over many simulated people.

Each run draws a body, a motion, a noise level and dropouts, and filters what is measured at default settings; the
filter knows neither body nor noise. Every error is divided by what the filter states of it. Where the filter is
honest, the normalised error squared e^2 / P of one coordinate follows chi-square(1), and that of all observed joint
angles together (all but upper_body.UNOBSERVED, with their marginal covariance) chi-square(22), or chi-square(28) with
the six coordinates of the base, which are no angles of a joint; 95 % of the time steps lie inside the 95 % band. "in
band" is the two-sided band, "below" the one-sided upper bound, "mean" the mean divided by its dimension: 1 is honest,
more is too sure, less too modest. Beside that the classical test: the average over all runs at each time step against
the band of that average (Bar-Shalom, Li and Kirubarajan 2001, chapter 5.4.2).

  python benchmarks/honesty.py                              200 runs
  python benchmarks/honesty.py --runs 20 --set gate_probability=0.999
  python benchmarks/honesty.py --only 17                    that run alone, to look into
"""

from __future__ import annotations

import functools
import itertools
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import common
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from body_tracking.core.skeleton import N_JOINTS, FloatArray
from body_tracking.filters.ekf import EkfParameters, ExtendedKalmanFilter
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.random_people import (
    MODEL,
    MeasurementErrors,
    RandomMotion,
    RandomPerson,
    capture_times,
    draw_dropouts,
    observe,
    truth_of,
)

NAMES = MODEL.coordinate_names
OBSERVED = np.array([number for number, name in enumerate(NAMES) if name not in UNOBSERVED])
ANGLES = OBSERVED[OBSERVED >= 6]
TOGETHER = {"joint": ANGLES, "whole": OBSERVED}
"""Which coordinates are taken together: the observed joint angles (the bar is theirs), and these with the base."""
BAND = 0.95
BAR = 0.90
"""Share of the time steps that must lie inside the band."""
STILL = 0.1
"""m/s: a person of whom no point is faster is still."""
AFTER = 1.0
"""Seconds for which a dropout is looked after."""


def new_filter(parameters: Mapping[str, float]) -> ExtendedKalmanFilter:
    """The filter under test; the only place that knows how to make it."""
    # its people take poses at random over their ranges of motion: no posture is known of them
    return ExtendedKalmanFilter(EkfParameters(**({"posture": False} | parameters)))


@dataclass(frozen=True)
class Settings:
    """What all runs share; see the command line's help."""

    seed: int
    seconds: float
    noise: tuple[float, float]
    joint_factor: float
    dropouts: int
    outliers: float
    parameters: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Run:
    """One run: n estimates.

    Attributes:
        number: of the run.
        noise: metres.
        frame: (n,) which frame of the run each estimate is of.
        times: (n,) seconds.
        still: (n,) nothing moves faster than STILL.
        lost: (n,) 2 while a modelled joint is not measured, 1 for AFTER seconds later, else 0.
        error, stddev: (n, 32) tangent.
        position, velocity: (n, 32) normalised errors squared.
        joint, whole: (n,) of the coordinates in TOGETHER; NaN where the covariance allows none.
        without: frames of which there was no estimate.
        seconds_per_frame: what an update took.
    """

    number: int
    noise: float
    frame: NDArray[np.int64]
    times: FloatArray
    still: NDArray[np.bool_]
    lost: NDArray[np.int64]
    error: FloatArray
    stddev: FloatArray
    position: FloatArray
    velocity: FloatArray
    joint: FloatArray
    whole: FloatArray
    without: int
    seconds_per_frame: float


def simulate(settings: Settings, number: int) -> Run:
    """One run from its number."""
    rng = np.random.default_rng([settings.seed, number])
    low, high = settings.noise
    noise = low * (high / low) ** rng.random()
    person = RandomPerson.draw(rng)
    motion = RandomMotion(rng, settings.seconds)
    truth = truth_of(person, motion, capture_times(settings.seconds, rng))
    factors = settings.joint_factor ** rng.uniform(-1.0, 1.0, N_JOINTS)
    count = int(rng.integers(0, settings.dropouts + 1))
    dropouts = draw_dropouts(rng, count, (0.5, settings.seconds), longest=1.5, everything=0.1)
    gaps: tuple[tuple[float, float], ...] = ()
    if count and rng.random() < 0.3:
        begin = rng.uniform(0.5, settings.seconds - 1.0)
        gaps = ((begin, begin + rng.uniform(0.1, 0.5)),)
    errors = MeasurementErrors(noise, factors, dropouts, gaps, settings.outliers)
    observation = observe(truth, errors, rng)

    estimator = new_filter(settings.parameters)
    kept, estimates, elapsed = [], [], 0.0
    for skeleton, frame in zip(observation.skeletons, observation.frames, strict=True):
        begin = time.perf_counter()
        estimator.update(skeleton)
        elapsed += time.perf_counter() - begin
        estimate = estimator.estimate
        if estimate is not None and estimate.stamp_ns == skeleton.stamp_ns:
            kept.append(int(frame))
            estimates.append(estimate)
    if not estimates:
        raise RuntimeError("the filter never said anything")

    nv = MODEL.nv
    frames = np.array(kept)
    error = MODEL.difference(np.stack([each.q for each in estimates]), truth.q[frames])
    error_rate = truth.velocity[frames] - np.stack([each.velocity for each in estimates])
    covariance = np.stack([each.covariance for each in estimates])
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    together = {what: np.full(len(frames), np.nan) for what in TOGETHER}
    for what, columns in TOGETHER.items():
        for k, each in enumerate(covariance):
            part = each[np.ix_(columns, columns)]
            if np.isfinite(part).all() and np.linalg.eigvalsh(part)[0] > 0.0:
                together[what][k] = error[k, columns] @ np.linalg.solve(part, error[k, columns])
    incomplete = ~observation.seen.all(axis=1)
    ago = np.where(incomplete, truth.times, -np.inf)
    after = truth.times - np.maximum.accumulate(ago) < AFTER
    return Run(
        number=number,
        noise=noise,
        frame=frames,
        times=truth.times[frames],
        still=(truth.speeds.max(axis=1) < STILL)[frames],
        lost=np.where(incomplete, 2, np.where(after, 1, 0))[frames],
        error=error,
        stddev=np.sqrt(variance[:, :nv]),
        position=error**2 / variance[:, :nv],
        velocity=error_rate**2 / variance[:, nv:],
        **together,
        without=len(observation.frames) - len(frames),
        seconds_per_frame=elapsed / len(observation.frames),
    )


def all_runs(
    work: Callable[[Any, int], Any], settings: Any, numbers: Sequence[int], processes: int
) -> tuple[list[Any], dict[int, str]]:
    """The results of the runs in their order, and what went wrong in the others."""
    found = common.mapped(functools.partial(common.attempt, functools.partial(work, settings)), numbers, processes)
    broken = {number: problem for number, (_, problem) in zip(numbers, found, strict=True) if problem}
    return [result for result, problem in found if not problem], broken


def shares(normalised: FloatArray, dimension: int) -> tuple[float, float, float]:
    """Of (n,) normalised errors squared: share in the two-sided band, below the upper bound, and mean / dimension."""
    if not len(normalised):
        return np.nan, np.nan, np.nan
    low, high = chi2.ppf([0.5 - BAND / 2, 0.5 + BAND / 2], dimension)
    inside = float(((normalised >= low) & (normalised <= high)).mean())
    below = float((normalised <= chi2.ppf(BAND, dimension)).mean())
    known = normalised[np.isfinite(normalised)]
    return inside, below, float(known.mean() / dimension) if len(known) else np.nan


def average_over_runs(runs: list[Run], pick: Callable[[Run], FloatArray], dimension: int) -> dict[str, Any]:
    """The classical test: the mean over the runs at each frame against the 95 % band of that mean.

    ``pick`` gives the (n,) normalised errors squared of a run.
    """
    size = max(int(run.frame.max()) for run in runs) + 1
    total, count = np.zeros(size), np.zeros(size)
    for run in runs:
        values = pick(run)
        good = np.isfinite(values)
        np.add.at(total, run.frame[good], values[good])
        np.add.at(count, run.frame[good], 1.0)
    filled = count > 0
    mean = total[filled] / count[filled] / dimension
    freedom = dimension * count[filled]
    low, high = (chi2.ppf(p, freedom) / freedom for p in (0.5 - BAND / 2, 0.5 + BAND / 2))
    return {
        "inside": float(((mean >= low) & (mean <= high)).mean()),
        "below": float((mean <= high).mean()),
        "median": float(np.median(mean)),
    }


def splits(runs: list[Run], seconds: float) -> dict[str, list[NDArray[np.bool_]]]:
    """For each part of the time steps a mask per run."""
    levels = np.array([run.noise for run in runs])
    low, high = np.quantile(levels, [1 / 3, 2 / 3]) if len(runs) > 2 else (levels.min(), levels.max())
    parts: dict[str, Callable[[Run], NDArray[np.bool_]]] = {
        "all": lambda run: run.times >= 0.0 - 1.0,
        f"noise up to {1e3 * low:.1f} mm": lambda run: np.full(len(run.times), run.noise <= low),
        f"noise to {1e3 * high:.1f} mm": lambda run: np.full(len(run.times), low < run.noise <= high),
        f"noise above {1e3 * high:.1f} mm": lambda run: np.full(len(run.times), run.noise > high),
    }
    edges = [0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 7.0, 10.0, 20.0, 40.0, np.inf]
    for begin, end in itertools.pairwise(edges):
        if begin < seconds:
            # the first frame may be stamped a little before 0
            since = -1.0 if begin == 0.0 else begin
            parts[f"{begin:g} to {min(end, seconds):g} s"] = lambda run, since=since, end=end: (
                (run.times >= since) & (run.times < end)
            )
    parts["still"] = lambda run: run.still
    parts["moving"] = lambda run: ~run.still
    parts["in a dropout"] = lambda run: run.lost == 2
    parts[f"{AFTER:g} s after a dropout"] = lambda run: run.lost == 1
    parts["no dropout"] = lambda run: run.lost == 0
    return {name: [choose(run) for run in runs] for name, choose in parts.items()}


def pooled(runs: list[Run], masks: list[NDArray[np.bool_]], what: str) -> FloatArray:
    """The time steps of all runs that the masks choose, one after the other."""
    result: FloatArray = np.concatenate([getattr(run, what)[mask] for run, mask in zip(runs, masks, strict=True)])
    return result


def summarise(runs: list[Run], settles: list[float], seconds: float) -> dict[str, Any]:
    """All figures, ready for JSON."""
    keys = ("in_band", "below", "mean")
    summary: dict[str, Any] = {
        "runs": len(runs),
        "steps": sum(len(run.times) for run in runs),
        "frames_without_estimate": sum(run.without for run in runs),
        "steps_without_joint_covariance": int(sum(np.isnan(run.joint).sum() for run in runs)),
        "median_ms_per_frame": 1e3 * float(np.median([run.seconds_per_frame for run in runs])),
        "settled": {},
    }
    for settle in settles:
        masks = [run.times >= (settle if settle > 0.0 else -1.0) for run in runs]
        figures: dict[str, Any] = {"coordinates": {}}
        for what in ("position", "velocity"):
            values = pooled(runs, masks, what)
            for number, name in enumerate(NAMES):
                figures["coordinates"].setdefault(name, {})[what] = dict(
                    zip(keys, shares(values[:, number], 1), strict=True)
                )
        rms = np.sqrt((pooled(runs, masks, "error") ** 2).mean(axis=0))
        stated = np.sqrt((pooled(runs, masks, "stddev") ** 2).mean(axis=0))
        for number, name in enumerate(NAMES):
            figures["coordinates"][name].update(rms_error=float(rms[number]), rms_stddev=float(stated[number]))
        for what, columns in TOGETHER.items():
            figures[what] = dict(zip(keys, shares(pooled(runs, masks, what), len(columns)), strict=True))
        summary["settled"][f"{settle:g}"] = figures
    summary["splits"] = {}
    for name, masks in splits(runs, seconds).items():
        each = pooled(runs, masks, "position")
        summary["splits"][name] = {
            "steps": len(each),
            **{
                what: dict(zip(keys, shares(pooled(runs, masks, what), len(columns)), strict=True))
                for what, columns in TOGETHER.items()
            },
            "observed": dict(zip(keys, shares(each[:, OBSERVED].ravel(), 1), strict=True)),
            "velocity": dict(zip(keys, shares(pooled(runs, masks, "velocity")[:, OBSERVED].ravel(), 1), strict=True)),
        }
    summary["average_over_runs"] = {
        what: average_over_runs(runs, lambda run, w=what: getattr(run, w), len(columns))
        for what, columns in TOGETHER.items()
    }
    for number, name in enumerate(NAMES):
        summary["average_over_runs"][name] = average_over_runs(runs, lambda run, n=number: run.position[:, n], 1)
    summary["each_run"] = [
        {
            "number": run.number,
            "noise": run.noise,
            "mean": float(np.nanmean(run.whole)) / len(OBSERVED) if np.isfinite(run.whole).any() else np.inf,
            "worst": NAMES[OBSERVED[run.position[:, OBSERVED].mean(axis=0).argmax()]],
        }
        for run in runs
    ]
    first = summary["settled"][f"{settles[0]:g}"]
    summary["missed"] = [
        name for name, figures in first["coordinates"].items() if not figures["position"]["in_band"] >= BAR
    ]
    if not first["joint"]["in_band"] >= BAR:
        summary["missed"].append("joint")
    return summary


def show(summary: dict[str, Any]) -> None:
    """The tables."""
    settled = summary["settled"]
    print(
        f"{summary['runs']} runs, {summary['steps']} time steps, {summary['frames_without_estimate']} frames without an"
        f" estimate, {summary['steps_without_joint_covariance']} without a joint covariance,"
        f" {summary['median_ms_per_frame']:.2f} ms a frame"
    )
    print("in band: two-sided 95 %; below: one-sided 95 %; mean: of the normalised error squared (1 is honest)\n")
    heads = "".join(f"from {settle:>3} s               " for settle in settled)
    print(f"{'':27}{heads}error  stated   rates, from {next(iter(settled))} s      average over runs")
    heads = "in band  below  mean    " * len(settled)
    print(f"{'':27}{heads}rms, mm or deg  in band  below  mean    in band  median")
    for number, name in enumerate((*NAMES, *TOGETHER)):
        line = f"{name:27}"
        for figures in settled.values():
            of = figures[name] if name in TOGETHER else figures["coordinates"][name]["position"]
            line += f"{100 * of['in_band']:6.1f} {100 * of['below']:6.1f} {of['mean']:6.2f}    "
        if name in TOGETHER:
            line += " " * 39
        else:
            figures = next(iter(settled.values()))["coordinates"][name]
            unit = 1e3 if number < 3 else np.degrees(1.0)
            rate = figures["velocity"]
            line += f"{unit * figures['rms_error']:6.1f} {unit * figures['rms_stddev']:6.1f}  "
            line += f"{100 * rate['in_band']:7.1f} {100 * rate['below']:6.1f} {rate['mean']:6.2f}  "
        average = summary["average_over_runs"][name]
        print(line + f"{100 * average['inside']:7.1f} {average['median']:8.2f}")
    print(
        "\n                            joint angles             with the base            each of them            rates"
    )
    print("                        steps" + 4 * "  in band  below  mean   ")
    for name, figures in summary["splits"].items():
        line = f"{name:22}{figures['steps']:7}"
        for what in (*TOGETHER, "observed", "velocity"):
            of = figures[what]
            line += f"  {100 * of['in_band']:7.1f} {100 * of['below']:6.1f} {of['mean']:6.2f}"
        print(line)
    ordered = sorted(summary["each_run"], key=lambda run: -run["mean"])
    levels = np.quantile([run["mean"] for run in ordered], [0.1, 0.5, 0.9])
    print("\nmean of a run, with the base: 10 % below {:.2f}, half below {:.2f}, 90 % below {:.2f}".format(*levels))
    worst = [f"{run['number']} ({1e3 * run['noise']:.0f} mm: {run['mean']:.1f}, {run['worst']})" for run in ordered[:8]]
    print(f"most over-confident runs (--only N): {', '.join(worst)}")
    if summary["missed"]:
        print(f"in band in less than {100 * BAR:.0f} % of the time steps: " + ", ".join(summary["missed"]))
    else:
        print(f"all are in band in at least {100 * BAR:.0f} % of the time steps")
    if summary["broken_runs"]:
        print(f"ended in an error: {', '.join(map(str, summary['broken_runs']))}")


def main() -> int:
    """The benchmark; exit code 1 where the bar is missed or a run ended in an error."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--runs", type=int, default=200, metavar="N", help="simulated runs (default: %(default)s)")
    parser.add_argument("--only", type=int, metavar="N", help="this run alone")
    parser.add_argument("--seed", type=int, default=0, help="of all chance (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a run (default: %(default)g)")
    parser.add_argument("--noise", type=float, nargs=2, default=(5.0, 40.0), metavar=("LOW", "HIGH"),
                        help="mm, standard deviation per axis, log-uniform between (default: 5 40)")  # fmt: skip
    parser.add_argument("--joint-factor", type=float, default=1.0, metavar="F",
                        help="each joint's noise is that times 1/F to F, log-uniform (default: 1)")  # fmt: skip
    parser.add_argument("--dropouts", type=int, default=3, metavar="N", help="at most so many (default: %(default)s)")
    parser.add_argument("--outliers", type=float, default=0.0, metavar="SHARE",
                        help="of the joint samples, displaced by up to 1 m (default: 0)")  # fmt: skip
    parser.add_argument("--settle", type=float, nargs="+", default=[0.0, 1.0], metavar="S",
                        help="leave out the first S seconds; one column each, the bar is for the first")  # fmt: skip
    common.add_set(parser)
    args = parser.parse_args()
    noise = 1e-3 * args.noise[0], 1e-3 * args.noise[1]
    settings = Settings(args.seed, args.seconds, noise, args.joint_factor, args.dropouts, args.outliers, dict(args.set))
    new_filter(settings.parameters)  # a wrong parameter ends the benchmark here
    numbers = [args.only] if args.only is not None else list(range(args.runs))
    runs, broken = all_runs(simulate, settings, numbers, args.jobs)
    for number, problem in itertools.islice(broken.items(), 3):
        common.progress(f"run {number} ended in an error:\n{problem}")
    if not runs:
        raise SystemExit("no run came to its end")
    summary = summarise(runs, args.settle, args.seconds)
    summary["broken_runs"] = list(broken)
    common.report(args, summary, lambda: show(summary))
    return bool(summary["missed"] or broken)


if __name__ == "__main__":
    sys.exit(main())

"""Is the uncertainty of the extended filter true? Normalised errors over many simulated people.

Each run draws a body, a motion, a noise level and dropouts, and filters the measurements at default settings; the
filter knows neither body nor noise. Every error is divided by its stated standard deviation. If the filter is honest,
the normalised error squared e^2 / P of one coordinate follows chi-square(1). For all observed joint angles together
(all but upper_body.UNOBSERVED, with their marginal covariance) it follows chi-square(22), with the six coordinates of
the base chi-square(28); 95 % of the time steps lie inside the 95 % band (Bar-Shalom, Li and Kirubarajan 2001, chapter
5.4.2). "in band" is the two-sided band, "below" the one-sided upper bound, both in percent; "mean" is the mean divided
by its dimension: 1 is honest, more is overconfident, less is conservative.
"""

from __future__ import annotations

import functools
import itertools
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import common
import numpy as np
from numpy.typing import NDArray
from random_people import MeasurementErrors, RandomPerson, capture_times, draw_dropouts, observe, truth_of
from scipy.stats import chi2

from body_tracking.core.skeleton import N_JOINTS, FloatArray
from body_tracking.filters.ekf.filter import ExtendedKalmanFilter
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.kinematics.upper_body import UNOBSERVED
from body_tracking.simulation.people import MODEL
from body_tracking.simulation.random_motion import RandomMotion

NAMES = MODEL.coordinate_names
OBSERVED = np.array([number for number, name in enumerate(NAMES) if name not in UNOBSERVED])
TOGETHER = {"joint": OBSERVED[OBSERVED >= 6], "whole": OBSERVED}
"""Groups of coordinates: the observed joint angles (the bar applies to them), and these with the base."""
BAND, BAR = 0.95, 90.0
"""The band, and the least percentage of the time steps inside it."""
NOISE = 0.005, 0.040
"""Bounds of the log-uniform standard deviation per axis, metres."""
DROPOUTS = 3
"""Largest number of dropouts in a run."""
STILL, AFTER = 0.1, 1.0
"""m/s: a person is still if no point is faster. Seconds after a dropout that are evaluated separately."""


def new_filter(parameters: Mapping[str, float]) -> ExtendedKalmanFilter:
    """The filter under test; the only place that constructs it."""
    # the people take random poses over their ranges of motion: no posture prior
    return ExtendedKalmanFilter(EkfParameters(**({"posture": False} | parameters)))


@dataclass(frozen=True)
class Settings:
    """Settings of all runs: length of a run in seconds, parameters of the filter."""

    seconds: float
    parameters: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class Run:
    """One run with n estimates.

    Attributes:
        noise: standard deviation per axis, metres.
        times: (n,) seconds.
        still: (n,) whether no point is faster than STILL.
        lost: (n,) 2 while a modelled joint is not measured, 1 for AFTER seconds later, else 0.
        error, stddev: (n, 32) in the tangent space.
        position, velocity: (n, 32) normalised errors squared.
        joint, whole: (n,) the same for the groups in TOGETHER; NaN for a covariance that is not positive definite.
        without: number of frames without an estimate.
    """

    noise: float
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


def simulate(settings: Settings, number: int) -> Run:
    """One run; its number seeds all draws."""
    rng, (low, high) = np.random.default_rng([0, number]), NOISE
    noise = low * (high / low) ** rng.random()
    person = RandomPerson.draw(rng)
    truth = truth_of(person, RandomMotion(rng, settings.seconds), capture_times(settings.seconds, rng))
    rng.random(N_JOINTS)  # unused draw of former versions: a number still gives the same person
    count = int(rng.integers(0, DROPOUTS + 1))
    dropouts = draw_dropouts(rng, count, (0.5, settings.seconds), longest=1.5, everything=0.1)
    gaps: tuple[tuple[float, float], ...] = ()
    if count and rng.random() < 0.3:
        begin = rng.uniform(0.5, settings.seconds - 1.0)
        gaps = ((begin, begin + rng.uniform(0.1, 0.5)),)
    observation = observe(truth, MeasurementErrors(noise, None, dropouts, gaps), rng)

    estimator = new_filter(settings.parameters)
    kept, estimates = [], []
    for skeleton, frame in zip(observation.skeletons, observation.frames, strict=True):
        estimator.update(skeleton)
        estimate = estimator.estimate
        if estimate is not None and estimate.stamp_ns == skeleton.stamp_ns:
            kept.append(int(frame))
            estimates.append(estimate)
    if not estimates:
        raise RuntimeError("the filter never said anything")

    nv, frames = MODEL.nv, np.array(kept)
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
    after = truth.times - np.maximum.accumulate(np.where(incomplete, truth.times, -np.inf)) < AFTER
    return Run(
        noise=noise,
        times=truth.times[frames],
        still=(truth.speeds.max(axis=1) < STILL)[frames],
        lost=np.where(incomplete, 2, np.where(after, 1, 0))[frames],
        error=error,
        stddev=np.sqrt(variance[:, :nv]),
        position=error**2 / variance[:, :nv],
        velocity=error_rate**2 / variance[:, nv:],
        **together,
        without=len(observation.frames) - len(frames),
    )


def all_runs(
    work: Callable[[Any, int], Any], settings: Any, numbers: Sequence[int], processes: int
) -> tuple[list[Any], dict[int, str]]:
    """The results of the runs in their order, and the tracebacks of failed runs by number."""
    found = common.mapped(functools.partial(common.attempt, functools.partial(work, settings)), numbers, processes)
    broken = {number: problem for number, (_, problem) in zip(numbers, found, strict=True) if problem}
    for number, problem in itertools.islice(broken.items(), 3):
        common.progress(f"run {number} ended in an error:\n{problem}")
    return [result for result, problem in found if not problem], broken


def shares(normalised: FloatArray, dimension: int, name: str = "") -> dict[str, float]:
    """Percentages of (n,) normalised errors squared in the two-sided band and below the upper bound, and the mean."""
    low, high = chi2.ppf([0.5 - BAND / 2, 0.5 + BAND / 2], dimension)
    inside, below = (normalised >= low) & (normalised <= high), normalised <= chi2.ppf(BAND, dimension)
    mean = np.nanmean(normalised) / dimension if len(normalised) else np.nan
    figures = {"in band": 100.0 * np.mean(inside), "below": 100.0 * np.mean(below), "mean": mean}
    return {f"{name} {key}".strip(): float(figure) for key, figure in figures.items()}


def splits(runs: list[Run]) -> dict[str, list[NDArray[np.bool_]]]:
    """For each part of the time steps, one mask per run."""
    low, high = np.quantile([run.noise for run in runs], [1 / 3, 2 / 3])
    parts: dict[str, Callable[[Run], NDArray[np.bool_]]] = {
        "all": lambda run: np.isfinite(run.times),
        f"noise up to {1e3 * low:.1f} mm": lambda run: np.full(len(run.times), run.noise <= low),
        f"noise above {1e3 * high:.1f} mm": lambda run: np.full(len(run.times), run.noise > high),
        "first second": lambda run: run.times < 1.0,
        "later": lambda run: run.times >= 1.0,
        "still": lambda run: run.still,
        "moving": lambda run: ~run.still,
        "in a dropout": lambda run: run.lost == 2,
        f"{AFTER:g} s after a dropout": lambda run: run.lost == 1,
        "no dropout": lambda run: run.lost == 0,
    }
    return {name: [choose(run) for run in runs] for name, choose in parts.items()}


def pooled(runs: list[Run], masks: list[NDArray[np.bool_]], what: str) -> FloatArray:
    """The time steps of all runs that the masks select, concatenated."""
    result: FloatArray = np.concatenate([getattr(run, what)[mask] for run, mask in zip(runs, masks, strict=True)])
    return result


def summarise(runs: list[Run]) -> dict[str, Any]:
    """All figures; errors and stated standard deviations of coordinates are RMS, in mm and degrees."""
    parts = splits(runs)
    position, velocity, error, stddev = (
        pooled(runs, parts["all"], what) for what in ("position", "velocity", "error", "stddev")
    )
    coordinates = {}
    for number, name in enumerate(NAMES):
        unit = 1e3 if number < 3 else np.degrees(1.0)
        coordinates[name] = {
            **shares(position[:, number], 1),
            "error": unit * common.rms(error[:, number]),
            "stated": unit * common.rms(stddev[:, number]),
            **shares(velocity[:, number], 1, "rate"),
        }
    return {
        "runs": len(runs),
        "steps": len(position),
        "frames without an estimate": sum(run.without for run in runs),
        "steps without a joint covariance": int(sum(np.isnan(run.joint).sum() for run in runs)),
        "coordinates": coordinates,
        "parts": {
            name: {
                "steps": int(sum(mask.sum() for mask in masks)),
                **{
                    key: figure
                    for what, columns in TOGETHER.items()
                    for key, figure in shares(pooled(runs, masks, what), len(columns), what).items()
                },
                **shares(pooled(runs, masks, "position")[:, OBSERVED].ravel(), 1, "each"),
                **shares(pooled(runs, masks, "velocity")[:, OBSERVED].ravel(), 1, "rate"),
            }
            for name, masks in parts.items()
        },
    }


def main() -> int:
    """The benchmark; exit code 1 where the bar is missed or a run ended in an error."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--runs", type=int, default=200, metavar="N", help="simulated runs (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="length of a run (default: %(default)g)")
    common.add_set(parser)
    args = parser.parse_args()
    settings = Settings(args.seconds, dict(args.set))
    new_filter(settings.parameters)  # an unknown parameter ends the benchmark here
    runs, broken = all_runs(simulate, settings, range(args.runs), args.jobs)
    if not runs:
        raise SystemExit("no run came to its end")
    summary = summarise(runs)
    common.report(args, summary | {"broken runs": list(broken)})
    in_band = {name: figures["in band"] for name, figures in summary["coordinates"].items()}
    in_band["all joint angles together"] = summary["parts"]["all"]["joint in band"]
    worst = min(in_band, key=in_band.__getitem__)
    return common.verdicts(
        args,
        {
            f"in band in {BAR:.0f} % of the time steps or more, least {worst} {in_band[worst]:.1f} %": in_band[worst]
            >= BAR,
            "every run came to its end": not broken,
        },
    )


if __name__ == "__main__":
    sys.exit(main())

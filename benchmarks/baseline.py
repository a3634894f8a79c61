"""The thesis's baseline tests on rendered recordings: a robot arm's red balls, a pendulum's frequency.

``arm``: three trials of one motion for each injected delay of the camera's stamps; colour and depth images with the
errors of the depth simulator, 15 a second, 10 % lost, capture times irregular by 10 ms. Delay and registration are
fitted to the first trial; the figures are the worst axis and trial of the two others, and the error of the delay.

``pendulum``: five lengths, 20 s at 30 Hz; mean and largest absolute error of the frequency, and the share within 3 mHz.
``images`` are rendered (infrared of 8 bits, a ball of 20 mm at 1.5 m), the others add noise of 0.2 pixels to the true
pixels; each row but the first loses 10 % of the frames and has capture times irregular by 10 ms. ``stamps``: stamps
with 10 ms more noise. ``floor``: the least standard deviation (Cramer-Rao) of a frequency by that noise of the pixels.
Methods not recommended: fits ``without amplitude``, as if the period did not depend on it, at ``even steps`` of 1/30 s
from one frame to the next, and the highest ``peak`` of the spectrum.

``vicon``: the pendulum of Szczesna et al. (2016) after each release, by Vicon and by the gyroscope on each link.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import common
import numpy as np
from scipy.signal import lombscargle

from body_tracking.core.skeleton import FloatArray
from body_tracking.evaluation.balls import bright_balls, red_balls
from body_tracking.evaluation.pendulum import fit_swing, natural_frequency, sines, vicon_decays
from body_tracking.evaluation.robot_arm import Trial, compare
from body_tracking.mesh.depth import to_metres
from body_tracking.simulation.baseline_bags import LENGTHS, capture_times
from body_tracking.simulation.baseline_scenes import RADIUS, ArmScene, PendulumScene

DELAYS = (-0.1, 0.04, 0.2)
ERROR_BAR, REPEATABILITY_BAR, DELAY_BAR, FREQUENCY_BAR = 10.0, 2.0, 5.0, 3.0
"""Bars: arm error and repeatability, mm; delay, ms; frequency, mHz."""
SECONDS, PIXEL_NOISE, JITTER = 20.0, 0.2, 0.01
ARM_RATE = 15.0
"""Frame rate of the arm's images, Hz; they take most of the benchmark's time."""


def trial(seed: int, delay: float) -> Trial:
    """One trial; each image is rendered and evaluated."""
    scene, rng = ArmScene(seed=seed), np.random.default_rng([seed, 71])
    lead = rng.uniform(0.0, 0.8)
    times = capture_times(scene.seconds + lead, rng, ARM_RATE)
    kept, found = [], []
    for number, time in enumerate(times.tolist()):
        colour, depth = scene.images(time - lead, number)
        balls = red_balls(colour, to_metres(depth), scene.colour, scene.depth, RADIUS).centres
        if len(balls) == 3:
            kept.append(time)
            found.append(balls)
    robot = np.arange(-0.5, scene.seconds + lead + 0.5, 0.01)
    return Trial(f"trial {seed}", np.array(kept) + delay, np.array(found), len(times), robot, scene.balls(robot - lead))


def arm(job: tuple[int, float]) -> dict[str, float]:
    """Three trials with one delay."""
    seed, delay = job
    trials = [trial(100 * seed + k, delay) for k in range(3)]
    result = compare(trials)
    others = result.errors[1:]
    return {
        "delay error, ms": 1e3 * max(abs(each.delay - delay) for each in result.errors),
        "MAE, mm": 1e3 * max(float(each.mae.max()) for each in others),
        "max, mm": 1e3 * max(float(each.largest.max()) for each in others),
        "MAD, mm": 1e3 * max(float(each.deviation.max()) for each in others),
        "max deviation, mm": 1e3 * max(float(each.largest_deviation.max()) for each in others),
        "images, %": 1e2 * min(len(each.times) / each.images for each in trials),
    }


def seen(scene: PendulumScene, times: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(n,) sines from the true pixels with noise."""
    pixels = scene.camera.project(scene.balls(times)) + rng.normal(0.0, PIXEL_NOISE, (len(times), 2))
    return sines(scene.camera.undistort(pixels))


def rendered(scene: PendulumScene, times: FloatArray) -> FloatArray:
    """(n,) sines from rendered images; NaN unless exactly one ball is found."""
    pixels = np.full((len(times), 2), np.nan)
    for number, ball in enumerate(scene.balls(times)):
        infrared, depth = scene.images(ball, number)
        found = bright_balls(infrared, to_metres(depth)).pixels
        if len(found) == 1:
            pixels[number] = found[0]
    return sines(scene.camera.undistort(pixels))


def peak(times: FloatArray, values: FloatArray) -> float:
    """Frequency of the spectrum's highest peak, Hz."""
    grid = np.arange(0.1, 2.0, 1e-3)
    return float(grid[np.argmax(lombscargle(times, values - values.mean(), 2.0 * np.pi * grid))])


def frequency(times: FloatArray, values: FloatArray) -> float:
    """Frequency as in ``evaluate baseline``, Hz."""
    return fit_swing(times, values, "sine").frequency


WAYS: dict[str, Callable[[PendulumScene, FloatArray, np.random.Generator], float]] = {
    "even frames": lambda scene, times, rng: frequency(times, seen(scene, times, rng)),
    "lost, irregular": lambda scene, times, rng: frequency(times, seen(scene, times, rng)),
    "stamps": lambda scene, times, rng: frequency(times + rng.normal(0.0, JITTER, len(times)), seen(scene, times, rng)),
    "images": lambda scene, times, _: frequency(times, rendered(scene, times)),
    "without amplitude": lambda scene, times, rng: frequency(times, 1e-3 * seen(scene, times, rng)),
    "even steps": lambda scene, times, rng: frequency(np.arange(len(times)) / 30.0, seen(scene, times, rng)),
    "peak": lambda scene, times, rng: peak(times, seen(scene, times, rng)),
}
"""The frequency (Hz) by frames at (n,) seconds."""
JUDGED = ("even frames", "lost, irregular", "stamps", "images")


def pendulum(job: tuple[str, int]) -> dict[str, float]:
    """Errors of one method for the frequency, over all lengths, with this number of seeds."""
    name, seeds = job
    errors = []
    for length in LENGTHS:
        for seed in range(seeds):
            rng = np.random.default_rng([seed, round(100.0 * length), 72])
            scene = PendulumScene(length, np.radians(rng.uniform(5.0, 20.0)), rng.uniform(0.0, 0.04), seed=seed)
            even = name == "even frames"
            times = np.arange(round(30.0 * SECONDS)) / 30.0 if even else capture_times(SECONDS, rng)
            errors.append(1e3 * (WAYS[name](scene, times, rng) - natural_frequency(length)))
    off = np.abs(errors)
    return {
        "runs": len(off),
        "mean, mHz": float(off.mean()),
        "worst, mHz": float(off.max()),
        "within 3 mHz, %": 1e2 * float((off < FREQUENCY_BAR).mean()),
    }


def floor() -> float:
    """Cramer-Rao bound of the frequency for a sinusoid of 5 degrees on the shortest pendulum with the noise, mHz."""
    scene = PendulumScene(min(LENGTHS))
    amplitude = scene.length * np.sin(np.radians(5.0)) / scene.distance * scene.camera.matrix[0, 0]
    samples = 0.9 * 30.0 * SECONDS
    return float(1e3 * np.sqrt(6.0 / samples) * PIXEL_NOISE / (amplitude * np.pi * SECONDS))


def vicon(data: Path) -> dict[str, dict[str, float]]:
    """Figures per link; empty where the recordings are absent."""
    found = {}
    for link in (1, 2, 3):
        path = data / "imu" / "pendulum_with_reference" / f"Pendulum_Test02a_Trial1_Segment_{link}.csv.gz"
        if not path.is_file():
            return {}
        decays = vicon_decays(path)
        by_vicon, by_gyroscope = (
            np.array([getattr(each, by).frequency for each in decays]) for by in ("vicon", "gyroscope")
        )
        found[f"link {link}"] = {
            "releases": len(decays),
            "Vicon, Hz": float(by_vicon.mean()),
            "gyroscope, Hz": float(by_gyroscope.mean()),
            "mean difference, mHz": 1e3 * float(np.abs(by_vicon - by_gyroscope).mean()),
            "scatter of Vicon, mHz": 1e3 * float(by_vicon.std(ddof=1)),
            "of the gyroscope, mHz": 1e3 * float(by_gyroscope.std(ddof=1)),
        }
    return found


def main() -> int:
    """The benchmark; exit code 1 where a bar is missed."""
    parser = common.parser(__doc__, seeds=20, jobs=True, data=True)
    parser.add_argument("--images", type=int, default=1, metavar="N", help="seeds of rendered images (%(default)s)")
    args = parser.parse_args()
    delays = [(seed, delay) for delay in DELAYS for seed in range(args.images)]
    trials = common.mapped(arm, delays, args.jobs)
    arms = {f"{1e3 * delay:.0f} ms, seed {seed}": each for (seed, delay), each in zip(delays, trials, strict=True)}
    jobs = [(name, args.images if name == "images" else args.seeds) for name in WAYS]
    pendulums = dict(zip([name for name, _ in jobs], common.mapped(pendulum, jobs, args.jobs), strict=True))
    figures: dict[str, Any] = {"arm": arms, "pendulum": pendulums, "floor, mHz": floor(), "vicon": vicon(args.data)}
    common.report(args, figures)
    met = {
        f"arm: mean error at most {ERROR_BAR:g} mm per axis": all(each["MAE, mm"] <= ERROR_BAR for each in trials),
        f"arm: repeatability at most {REPEATABILITY_BAR:g} mm": all(
            each["MAD, mm"] <= REPEATABILITY_BAR for each in trials
        ),
        f"arm: delay to {DELAY_BAR:g} ms": all(each["delay error, ms"] <= DELAY_BAR for each in trials),
    }
    met |= {
        f"pendulum, {name}: at most {FREQUENCY_BAR:g} mHz in every run": pendulums[name]["worst, mHz"] <= FREQUENCY_BAR
        for name in JUDGED
    }
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

"""The frequency of a pendulum: laws of the physics, and rates over many seeds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from body_tracking.evaluation.pendulum import (
    PendulumError,
    fit_swing,
    natural_frequency,
    sines,
    vicon_decays,
)
from body_tracking.simulation.baseline_bags import capture_times
from body_tracking.simulation.baseline_scenes import PendulumScene
from draws import draws, some

BAR = 0.003
"""Hz, over 20 s at 30 Hz."""


@pytest.mark.parametrize("degrees", some([30.0, 3.0, 15.0], 2))
@pytest.mark.parametrize("length", [0.25, 1.0])
def test_frequency_does_not_depend_on_the_amplitude(length: float, degrees: float) -> None:
    """The equation of motion, integrated: at 30 degrees its own frequency is 1.7 % lower."""
    scene = PendulumScene(length, np.radians(degrees), damping=0.03)
    times = np.arange(600) / 30.0
    found = fit_swing(times, np.sin(scene.angles(times)), "sine")
    assert found.frequency == pytest.approx(natural_frequency(length), rel=3e-4)
    assert np.degrees(found.amplitude) == pytest.approx(degrees, rel=0.01)
    assert found.damping == pytest.approx(0.03, abs=0.002)


def test_angle_and_rate_give_the_frequency_of_the_sine() -> None:
    scene = PendulumScene(0.5, np.radians(15.0))
    times = np.arange(600) / 30.0
    angle = scene.angles(times)
    # central differences lower a rate's amplitude, not its frequency
    for signal, values in (("angle", angle), ("rate", np.gradient(angle, times))):
        found = fit_swing(times, values, signal)  # type: ignore[arg-type]
        assert found.frequency == pytest.approx(natural_frequency(0.5), rel=2e-4), signal


@pytest.mark.parametrize("distance", [1.0, 2.0])
@pytest.mark.parametrize("roll", [0.0, 0.2])
def test_the_arc_gives_the_angle_whatever_the_distance_and_the_roll_of_the_camera(distance: float, roll: float) -> None:
    scene = PendulumScene(0.5, np.radians(15.0), distance=distance)
    times = np.arange(300) / 30.0
    balls = scene.balls(times)
    flat = balls[:, :2] / balls[:, 2:]
    turned = flat @ np.array([[np.cos(roll), np.sin(roll)], [-np.sin(roll), np.cos(roll)]])
    turned[::40] = np.nan
    found = sines(turned)
    assert np.ptp(found[np.isfinite(found)]) == pytest.approx(np.ptp(np.sin(scene.angles(times))), rel=0.02)
    assert np.isnan(found[::40]).all()


def test_frequency_is_within_the_bar_for_every_seed() -> None:
    """10 % lost, times of capture and stamps that are off by 10 ms each, 0.2 pixels of noise, and single outliers."""
    for seed in (*range(draws(2, 200)), 34, 155):  # in two of which an outlier bent the arc
        rng = np.random.default_rng(seed)
        scene = PendulumScene(rng.uniform(0.25, 1.0), rng.uniform(0.05, 0.35), rng.uniform(0.0, 0.05))
        times = capture_times(20.0, rng)
        pixels = scene.camera.project(scene.balls(times)) + rng.normal(0.0, 0.2, (len(times), 2))
        outliers = rng.random(len(times)) < 0.01
        pixels[outliers] = rng.uniform(0.0, 400.0, (np.count_nonzero(outliers), 2))
        stamps = times + rng.normal(0.0, 0.01, len(times))
        found = fit_swing(stamps, sines(scene.camera.undistort(pixels)), "sine")
        assert abs(found.frequency - natural_frequency(scene.length)) < BAR, seed
        assert found.stddev < 0.1 * BAR, seed


@pytest.mark.parametrize(
    ("values", "text"),
    [
        (np.zeros(600), "stands still"),
        (np.full(600, np.nan), "0 samples"),
        (np.sin(0.2 * np.arange(600) / 30.0), "periods"),
        (np.random.default_rng(1).normal(size=600), "nothing swings"),
    ],
    ids=["still", "unknown", "less than a period", "noise"],
)
def test_what_is_no_pendulum_is_refused(values: np.ndarray, text: str) -> None:
    with pytest.raises(PendulumError, match=text):
        fit_swing(np.arange(600) / 30.0, values, "sine")


@pytest.mark.slow
def test_vicon_and_the_gyroscope_on_a_real_pendulum_agree(shared_data: Path) -> None:
    for link in (1, 2, 3):
        decays = vicon_decays(
            shared_data / "imu" / "pendulum_with_reference" / f"Pendulum_Test02a_Trial1_Segment_{link}.csv.gz"
        )
        # it is let go nine times
        assert len(decays) == 9
        apart = [each.vicon.frequency - each.gyroscope.frequency for each in decays]
        assert np.mean(np.abs(apart)) < BAR
        assert np.std([each.gyroscope.frequency for each in decays]) < BAR


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("a;b\n", "header"),
        ("Time;Vicon Orientation;;;;\ns\n1;2\n", "columns"),
        ("Time;Vicon Orientation;;;;\ns\n1;x\n", "could not convert"),
        ("Time;Vicon Orientation;;;;\ns\n" + "".join(f"{n};1{';0' * 12}\n" for n in range(50)), "never swings"),
    ],
)
def test_files_without_a_pendulum_are_refused(tmp_path: Path, text: str, match: str) -> None:
    file = tmp_path / "pendulum.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(PendulumError, match=match):
        vicon_decays(file)

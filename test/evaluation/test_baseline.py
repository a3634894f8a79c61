"""``body_tracking simulate baseline`` and ``evaluate baseline``: figures from bags, and bad input in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from body_tracking.camera.topics import BALLS, COMPRESSED
from body_tracking.cli import main
from body_tracking.recording.rosbag2 import BagReader, BagWriter
from body_tracking.simulation.baseline_bags import write_arm, write_pendulum
from body_tracking.simulation.baseline_scenes import ArmScene, PendulumScene
from body_tracking.simulation.depth_scene import kinect_camera

SMALL = kinect_camera(2)


class Painted(ArmScene):
    """An arm with some grey balls."""

    def images(self, time: float, number: int) -> Any:
        image, depth = super().images(time, number)
        places = (self.balls(np.array([time]))[0] - self.pose.translation) @ self.pose.rotation
        for x, y in self.colour.project(places[:1]):
            cv2.circle(image, (round(x), round(y)), 24, (128, 128, 128), -1)
        return image, depth


class Blind(ArmScene):
    """An arm without depth."""

    def images(self, time: float, number: int) -> Any:
        image, depth = super().images(time, number)
        return image, np.zeros_like(depth)


def without(bag: Path, topic: str, folder: Path) -> Path:
    """A copy of a bag without a topic."""
    with BagReader(bag) as source, BagWriter(folder) as copy:
        for name, info in source.topics.items():
            if name != topic:
                copy.add_topic(name, info.type_name, info.offered)
        for raw in source.messages():
            if raw.topic != topic:
                copy.write(raw.topic, raw.cdr, raw.log_time_ns)
    return folder


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags of a few images: ``arm``, ``painted``, ``blind``; and ``pendulum``, ``shiny``, ``pair`` of some seconds."""
    folder = tmp_path_factory.mktemp("few")
    for name, kind in (("arm", ArmScene), ("painted", Painted), ("blind", Blind)):
        write_arm(kind(), folder / name, rate=0.25)
    write_pendulum(PendulumScene(0.25, camera=SMALL, diameter=0.04), folder / "pendulum", 4.0)
    write_pendulum(PendulumScene(0.25, camera=SMALL, diameter=0.04, depth_at_ball=True), folder / "shiny", 1.0)
    write_pendulum(PendulumScene(0.25, camera=SMALL, diameter=0.04, seed=1), folder / "short", 1.0)
    return folder


def test_a_pendulum_in_a_bag(few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "made" / "pendulum.png"
    arguments = ["evaluate", "baseline", "pendulum", f"{few / 'pendulum'}=0.25", "-o", str(picture)]
    assert main([*arguments, "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    row = content["tables"]["pendulums"]["rows"]["pendulum"]
    assert abs(row["error"]) < 3.0
    assert row["amplitude"] == pytest.approx(12.0, abs=1.0)
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert main(arguments[:-2]) == 0
    text = capsys.readouterr().out
    assert f"{row['measured']:.4f}" in text
    assert f"{abs(row['error']):.3f} mHz, mean of absolute errors" in text  # in hertz it would be 0.0000


@pytest.mark.slow
def test_trials_of_an_arm_in_bags(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for number in range(3):
        write_arm(ArmScene(seed=number), tmp_path / f"trial{number}", 0.07, rate=10.0)
    trials = [str(tmp_path / f"trial{number}") for number in range(3)]
    picture = tmp_path / "arm.png"
    assert main(["evaluate", "baseline", "arm", *trials, "--json", "-o", str(picture)]) == 0
    content = json.loads(capsys.readouterr().out)
    assert content["delay_ms"] == pytest.approx(70.0, abs=5.0)
    errors, deviations = (content["tables"][key]["rows"] for key in ("errors", "deviations"))
    for name in ("trial1", "trial2"):
        assert all(errors[name][f"mean_{axis}"] < 10.0 for axis in "xyz")
        assert all(deviations[name][f"mean_{axis}"] < 2.0 for axis in "xyz")
    assert picture.read_bytes().startswith(b"\x89PNG")


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    """The line with which a command ends."""
    assert main(arguments) == 2
    captured = capsys.readouterr()
    assert not captured.out
    assert len(captured.err.strip().splitlines()) == 1
    return captured.err


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda few, _: few / "painted", "2 red balls in"),
        (lambda few, _: few / "blind", "no depth at the red balls in"),
        (lambda few, to: without(few / "arm", BALLS, to), f"nothing on {BALLS}"),
        (
            lambda few, to: without(few / "arm", "/camera1/color/camera_info", to),
            "nothing on /camera1/color/camera_info",
        ),
        (lambda few, to: without(few / "arm", "/camera1/depth/image_raw", to), "nothing on /camera1/depth/image_raw"),
        (
            lambda few, to: without(few / "arm", "/camera1/color/image_raw" + COMPRESSED, to),
            "nothing on /camera1/color",
        ),
        (lambda few, _: few / "arm", "images show the balls"),
        (lambda few, _: few / "nowhere", "nowhere"),
    ],
    ids=["two balls", "no depth", "no truth", "no camera_info", "no depth images", "no colour", "few", "no bag"],
)
def test_unusable_trials_are_refused_in_one_line(
    few: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], make: Callable[[Path, Path], Path], text: str
) -> None:
    bag = str(make(few, tmp_path / "copy"))
    assert text in refused(["evaluate", "baseline", "arm", bag, bag], capsys)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["shiny=0.25"], "has depth in"),
        (["short=0.25"], "periods"),
        (["arm=0.25"], "nothing on /camera1/infrared/image_raw"),
        (["pendulum=long"], "no length in metres"),
        (["pendulum=-1"], "no length in metres"),
        (["pendulum=0.25", "--infrared", "/camera1/depth/image_raw"], "nothing on /camera1/depth/camera_info"),
        (["pendulum=0.25", "--gravity", "0"], "--gravity 0.0"),
        (["pendulum", "file.csv"], "not both"),
        (["nowhere.csv"], "nowhere.csv"),
    ],
)
def test_unusable_pendulums_are_refused_in_one_line(
    few: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    text: str,
) -> None:
    monkeypatch.chdir(few)
    assert text in refused(["evaluate", "baseline", "pendulum", *arguments], capsys)


def test_unusable_simulations_are_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (["arm", "--trials", "0"], ["pendulum", "--lengths", "a"], ["pendulum", "--lengths", "9"]):
        assert "expected" in refused(["simulate", "baseline", *arguments, "-o", str(tmp_path / "bag")], capsys)
    assert not list(tmp_path.iterdir())


def test_pendulums_are_simulated_with_a_bag_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", "baseline", "pendulum", "--lengths", "0.3", "--seconds", "1", "-o", str(tmp_path)]) == 0
    assert "length_0.3" in capsys.readouterr().out
    with BagReader(tmp_path / "length_0.3") as bag:
        assert 20 < bag.topics["/camera1/infrared/image_raw"].count < 32

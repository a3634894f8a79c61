"""``kinect_sender`` as a command: alone, as it is copied to a Windows computer, and with a recording."""

from __future__ import annotations

import shutil
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from senders import KEY

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect import kinect_protocol, kinect_sender
from body_tracking.kinect.live import SourceSettings
from body_tracking.kinect.network import NetworkSource
from body_tracking.recording import source as source_of_file
from body_tracking.recording.source import RecordingSource
from draws import some
from patience import PATIENCE

BAG = Path(__file__).resolve().parents[2] / "bags" / "tpose_wave"
COMMAND = [sys.executable, "-m", "body_tracking.kinect.kinect_sender"]


@pytest.fixture
def alone(tmp_path: Path) -> list[str]:
    """The command as two plain files, in a Python that knows neither this package nor any other."""
    for module in (kinect_protocol, kinect_sender):
        shutil.copy(str(module.__file__), tmp_path)
    return [sys.executable, "-S", "-E", str(tmp_path / "kinect_sender.py")]


def run(command: list[str], *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*command, *arguments], capture_output=True, text=True, timeout=PATIENCE, check=False)


def test_two_copied_files_are_enough(alone: list[str], tmp_path: Path) -> None:
    assert "--key-file" in run(alone, "--help").stdout
    file = tmp_path / "new.key"
    assert run(alone, "--make-key", str(file)).returncode == 0
    assert len(kinect_protocol.read_key(str(file))) == 64
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    again = run(alone, "--make-key", str(file))
    assert again.returncode == 2
    assert "exists" in again.stderr


ALONE = [
    ([], "PyKinect2 cannot be used here (ModuleNotFoundError"),
    (["--replay", "x.csv"], "--replay needs the package body_tracking"),
    (["--to", "somewhere"], "--to somewhere: expected HOST:PORT"),
    (["--to", "a:99999"], "expected HOST:PORT"),
    (["--sensor", "a b"], "sensor name 'a b'"),
    (["--key-file", "nowhere"], "nowhere: cannot be read"),
]
INSTALLED = [
    (["--replay", "/nowhere.csv"], "/nowhere.csv: no such file"),
    (["--replay", str(BAG), "--sensor", "kinect7"], "no topic /kinect7/skeleton"),
    (["--replay", str(BAG), "--to", "192.0.2.1:7525"], "192.0.2.1 is another computer"),
]


@pytest.mark.parametrize(("arguments", "reported"), [*ALONE, *some(INSTALLED)])
def test_missing_or_invalid_input_is_reported_in_one_line(
    alone: list[str], arguments: list[str], reported: str
) -> None:
    done = run(alone if (arguments, reported) in ALONE else COMMAND, *arguments)
    assert done.returncode == 2
    assert done.stderr.startswith("kinect_sender: ") and done.stderr.count("\n") == 1
    assert reported in done.stderr


def test_a_recording_comes_through_as_it_is_and_the_sender_survives_the_receiver(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(source_of_file, "LATE_NS", 1000 * NANOSECONDS)  # the player leaves out no frame
    file = tmp_path / "key"
    file.write_bytes(KEY)
    file.chmod(0o600)
    settings = SourceSettings("left", device="kinect1", port=0, key_file=str(file))
    source = NetworkSource(settings)
    host, port = source.address
    arguments = ["--replay", str(BAG), "--loop", "--to", f"{host}:{port}", "--key-file", str(file)]
    with (tmp_path / "log").open("wb") as log:
        process = subprocess.Popen([*COMMAND, *arguments], stderr=log)
    try:
        first = received(source, 15)
        source.close()
        source.read(0.0)
        time.sleep(0.3)
        source = NetworkSource(SourceSettings("left", device="kinect1", port=port, key_file=str(file)))
        second = received(source, 15)
    finally:
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
        source.close()
        source.read(0.0)
    player = RecordingSource(SourceSettings("kinect1", file=str(BAG), rate=100.0))
    recorded = {}
    while not player.ended:
        frame = player.read(1.0)
        if frame is not None:
            recorded[frame.skeletons[0].positions.astype(np.float32).tobytes()] = frame.skeletons[0]
    for frames in (first, second):
        # exactly the recorded skeletons, and their stamps as far from each other as there, 100 times as fast
        own = [recorded[frame.skeletons[0].positions.astype(np.float32).tobytes()] for frame in frames]
        for frame, each in zip(frames, own, strict=True):
            np.testing.assert_array_equal(frame.skeletons[0].states, each.states)
        steps = np.diff([frame.skeletons[0].stamp_ns for frame in frames])
        assert np.abs(steps - 100 * np.diff([each.stamp_ns for each in own])).max() <= steps.max() // 50


def received(source: NetworkSource, count: int) -> list[RecordedFrame]:
    frames: list[RecordedFrame] = []
    end = time.monotonic() + PATIENCE
    while len(frames) < count and time.monotonic() < end:
        frame = source.read(0.2)
        frames += [frame] if frame is not None else []
    assert len(frames) == count, source.problem
    return frames

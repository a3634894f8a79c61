"""Another package adds a system: one folder, no other file; it runs live and offline, and is shown and documented."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from body_tracking.core.skeleton import Joint
from body_tracking.messages.base import MessageError, to_nanoseconds
from body_tracking.messages.cdr import decode_skeletons
from body_tracking.messages.images import array_to_image
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BAG_WIRE, BagReader, deserialize
from domains import domain

pytest.importorskip("rclpy", reason="ROS is not installed")

ROOT = Path(__file__).resolve().parent.parent
HEIGHT = "/humans/height"


class _Nobody:
    """A target for the page's controls without effect."""

    def __getattr__(self, name: str) -> Any:
        return lambda *given: ""


def command(*words: str | Path) -> str:
    """The output of a command of ours, with the system installed."""
    path = os.pathsep.join([str(ROOT), str(ROOT / "examples" / "fifth_system")])
    environment = {**os.environ, "PYTHONPATH": path, "ROS_DOMAIN_ID": str(domain())}
    done = subprocess.run(
        [sys.executable, "-m", *map(str, words)], env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def heights(bag: Path, margin: float) -> dict[int, float]:
    """The published heights by stamp; each agrees with the filtered skeleton of the recording."""
    with BagReader(bag) as reader:
        type_name = reader.topics[HEIGHT].type_name
        messages = [deserialize(type_name, raw.cdr) for raw in reader.messages([HEIGHT])]
        filtered = {
            s[0].stamp_ns: s[0] for raw in reader.messages([graph.FILTERED]) if (s := decode_skeletons(raw.cdr))
        }
    found = {to_nanoseconds(m.header.stamp): float(np.frombuffer(bytes(m.data), np.float32)[0]) for m in messages}
    for stamp_ns, height in found.items():
        up = filtered[stamp_ns].positions[:, 2]
        assert height == pytest.approx(up[Joint.HEAD] - np.nanmin(up) + margin, abs=1e-5)
    return found


def test_a_folder_is_a_system_live_and_offline(tmp_path: Path, t_pose: Path) -> None:
    command("body_tracking.cli", "replay", t_pose, "-o", tmp_path / "offline")
    offline = heights(tmp_path / "offline", 0.1)
    words = ("--bag", t_pose, "--record", tmp_path / "live", "--height-margin", "0.2", "--reliable")
    assert "heights" in command("body_tracking.cli", "up", *words, "--log-dir", tmp_path).splitlines()[0]
    live = heights(tmp_path / "live", 0.2)
    assert len(offline) > 100 and len(live) > 0.7 * len(offline)


def test_its_topic_parameter_option_and_layer_are_among_the_graphs() -> None:
    script = (
        "from body_tracking import cli, systems as s; print(s.config_text()); "
        "print('@', [t.name for t in s.TOPICS], [x.name for x in s.LAYERS], flush=True); cli.main(['up', '--help'])"
    )
    path = os.pathsep.join([str(ROOT), str(ROOT / "examples" / "fifth_system")])
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=True,
    )
    parameters, _, after = done.stdout.partition("\n@ ")
    names, _, options = after.partition("\n")
    assert "heights:" in parameters
    assert HEIGHT in names and names.endswith("['heights']")
    assert "--height-margin METRES" in options


def test_an_image_that_is_no_height_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "fifth_system"))
    from heights.stage import Height

    assert Height().decode(Height().encode((5, 1.75), BAG_WIRE), BAG_WIRE) == (5, 1.75)
    for wrong in (np.zeros((1, 1), np.uint8), np.zeros((2, 1), np.float32)):
        encoding = "32FC1" if wrong.dtype == np.float32 else ""
        image = array_to_image(wrong, 5, "world", BAG_MESSAGES, encoding)
        with pytest.raises(MessageError, match="expected"):
            Height().decode(BAG_WIRE.serialize("sensor_msgs/msg/Image", image), BAG_WIRE)


def test_a_broken_system_is_named_and_left_out(tmp_path: Path) -> None:
    folder = tmp_path / "broken-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: broken\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text("[body_tracking.systems]\nbroken = nowhere.system:SYSTEM\n")
    path = os.pathsep.join([str(ROOT), str(tmp_path)])
    line = [sys.executable, "-m", "body_tracking.cli", "--help"]
    done = subprocess.run(line, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True)
    assert "replay" in done.stdout
    assert done.stderr.count("\n") == 1
    assert done.stderr.startswith("body_tracking: system broken (nowhere.system:SYSTEM) is left out: ")


def test_its_layer_is_drawn_and_can_be_switched_off(monkeypatch: pytest.MonkeyPatch) -> None:
    viser = pytest.importorskip("viser")
    monkeypatch.syspath_prepend(str(ROOT / "examples" / "fifth_system"))
    from heights.system import SYSTEM

    from body_tracking.viewing.page import Page
    from body_tracking.viewing.snapshot import Seen, Snapshot

    shown: list[tuple[str, bool]] = []
    monkeypatch.setattr(
        viser.SceneApi, "add_label", lambda self, name, text, visible=True, **rest: shown.append((text, visible))
    )
    page = Page("127.0.0.1", 0, (), cast(Any, _Nobody()), ("ekf",), ("model",), 5.0, SYSTEM.layers)
    try:
        empty_view = Seen((), stale=True)
        empty = np.empty((0, 3)), np.empty((0, 4))
        page.draw(Snapshot({}, {}, empty_view, empty_view, *empty, {"heights": (0, 1.75)}))
        page.draw(Snapshot({}, {}, empty_view, empty_view, *empty))
    finally:
        page.close()
    assert shown == [("1.75 m", True), ("", False)]

"""The shipped recording of five systems at once, and ``body_tracking compare`` over it."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import pytest

from body_tracking.cli import main
from body_tracking.evaluation.compare import read_systems
from body_tracking.recording import replay
from body_tracking.recording.rig import RigReader

ROOT = Path(__file__).resolve().parents[2]
BAG, SYSTEMS = ROOT / "bags" / "five_systems", ROOT / "config" / "five_systems.yaml"


def test_every_system_of_the_list_is_in_the_recording() -> None:
    systems = read_systems(SYSTEMS)
    assert set(systems) == {"kinects", "imus", "mesh", "camera", "markers", "all"}
    parser = argparse.ArgumentParser(exit_on_error=False)
    replay.add_parser(parser.add_subparsers())
    for arguments in systems.values():
        replay.settings_from(parser.parse_args(["replay", str(BAG), "-o", "out", *arguments]))
    with RigReader(BAG) as bag:
        topics = set(bag.topics)
    assert {f"/{each}/skeleton" for each in ("kinect1", "kinect2")} <= topics
    assert {"/kinect1/depth/image_raw", "/camera1/color/image_raw/compressed", "/left/balls"} <= topics
    assert {"/forearm_left/imu/data", "/ground_truth/model_state"} <= topics


@pytest.mark.slow
def test_every_system_is_compared_with_the_truth(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(ROOT)  # config/five_systems.yaml names the setup from there
    assert main(["compare", str(BAG), "--systems", str(SYSTEMS), "-o", str(tmp_path), "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)["tables"]
    differences, covered = (tables[name]["rows"]["truth"] for name in ("differences", "covered"))
    assert all(differences[name] < 12.0 for name in ("kinects", "imus", "mesh", "camera", "all")), differences
    assert differences["markers"] < 0.2
    assert all(covered[name] > 90.0 for name in ("kinects", "imus", "mesh", "camera", "markers", "all")), covered
    known = tables["known"]["rows"]["forearm_pronation_left"]
    assert known["kinects"] < 20.0 < 60.0 < min(known["imus"], known["all"])

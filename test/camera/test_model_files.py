"""The networks' files: whole ones are not fetched again."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from body_tracking.camera import model_files
from body_tracking.camera.pose_model import DETECTOR_FILE, LANDMARKS_FILE
from body_tracking.cli import main
from pose_networks import FOLDER


def test_files_that_are_missing_or_cut_off_are_fetched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fetched: list[Path] = []
    monkeypatch.setattr(model_files, "fetch", fetched.append)
    assert main(["camera", "model", str(tmp_path / "nowhere")]) == 0
    for name in (DETECTOR_FILE, LANDMARKS_FILE):
        (tmp_path / name).write_bytes(b"\x1c\0\0\0TFL3")
    assert main(["camera", "model", str(tmp_path)]) == 0
    assert fetched == [tmp_path / "nowhere", tmp_path]


@pytest.mark.skipif(not model_files.are_whole(FOLDER), reason=f"the networks are not in {FOLDER}")
def test_whole_files_are_not_fetched_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in (DETECTOR_FILE, LANDMARKS_FILE):
        shutil.copy(FOLDER / name, tmp_path / name)
    monkeypatch.setattr(model_files, "fetch", lambda folder: pytest.fail("fetched again"))
    assert main(["camera", "model", str(tmp_path)]) == 0
    assert capsys.readouterr().out == f"networks: {tmp_path}\n"
    with (tmp_path / LANDMARKS_FILE).open("r+b") as file:
        file.truncate(1_000_000)
    assert not model_files.are_whole(tmp_path)

"""``body_tracking evaluate``: its output agrees with the bags."""

from __future__ import annotations

import base64
import contextlib
import html
import io
import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from body_tracking.cli import main
from body_tracking.core.message_types import JOINT_STATE, POINT_CLOUD
from body_tracking.core.skeleton import JOINT_NAMES, N_JOINTS, Skeleton, TrackingState
from body_tracking.evaluation.comparison import Evaluation, evaluate
from body_tracking.evaluation.metrics import Curve
from body_tracking.evaluation.reading import read_estimate, read_markers, read_truth
from body_tracking.evaluation.report import Column, report_of, tables
from body_tracking.messages.skeletons import skeletons_to_cloud
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def result(replayed_wave: Path, wave: Path) -> Evaluation:
    return evaluate(read_estimate(replayed_wave), read_truth(wave))


@pytest.fixture(scope="module")
def reported(replayed_wave: Path, wave: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """What the command shows with ``-v``, and its page."""
    page, shown = tmp_path_factory.mktemp("page") / "report.html", io.StringIO()
    with contextlib.redirect_stdout(shown):
        assert main(["evaluate", str(replayed_wave), "--truth", str(wave), "-v", "--html", str(page)]) == 0
    return shown.getvalue(), page.read_text(encoding="utf-8")


def bag_of(folder: Path, skeletons: int, topic: str = "/filtered/skeleton", kind: str = POINT_CLOUD) -> Path:
    """A bag with one topic and nothing else."""
    states = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
    with BagWriter(folder) as bag:
        bag.add_topic(topic, kind)
        for number in range(skeletons):
            skeleton = Skeleton(10**9 + number, "world", np.ones((N_JOINTS, 3)), states)
            bag.write_message(topic, skeletons_to_cloud((skeleton,), BAG_MESSAGES), number)
    return folder


@pytest.mark.parametrize(("value", "text"), [(-0.04, "0.0"), (-0.06, "-0.1"), (np.nan, "-"), (np.inf, "inf")])
def test_numbers_of_a_table(value: float, text: str) -> None:
    assert Column("bias", "bias", "deg", np.array([value])).text(0) == text


def test_the_table_holds_the_results(reported: tuple[str, str], result: Evaluation) -> None:
    shown, _ = reported
    wrist = JOINT_NAMES.index("WristLeft")
    line = next(line for line in shown.splitlines() if line.startswith("WristLeft "))
    errors = result.comparisons[0].joints
    expected = [*errors.mae[wrist], *errors.largest[wrist], errors.mean[wrist], errors.rms[wrist]]
    assert [float(each) for each in line.split()[1:9]] == pytest.approx(1e3 * np.array(expected), abs=0.06)
    ten = next(line for line in shown.splitlines() if line.startswith("of the thesis's ten (10) "))
    assert 5.0 < float(ten.split()[5]) < 100.0
    assert "kinect2" in shown and "elbow_flexion_left" in shown and "ElbowLeft-WristLeft" in shown
    assert f"delay     {1e3 * result.delay:.1f} ms" in shown


def test_a_dozen_lines_say_how_good_the_estimate_is(
    replayed_wave: Path, wave: Path, result: Evaluation, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(replayed_wave), "--truth", str(wave)]) == 0
    shown = capsys.readouterr().out
    assert len(shown.splitlines()) <= 16 and "-v prints" in shown
    named = result.comparisons[0].named
    assert named is not None
    known = np.median(named.stddev, axis=0) < np.radians(30.0)
    errors = np.degrees(named.errors.rmse[known])
    assert f"angles    {known.sum()} of {len(known)} known " in shown
    best, worst = (np.array(named.names)[known][pick] for pick in (errors.argmin(), errors.argmax()))
    assert (
        f"median RMS error {np.median(errors):.1f} deg, best {best} {errors.min():.1f} deg, "
        f"worst {worst} {errors.max():.1f} deg" in shown
    )
    inside = np.abs(named.found - named.true)[:, known] <= 1.96 * named.stddev[:, known]
    (stated,) = re.findall(r"truth within 1\.96 standard deviations in (\d+) % of the frames", shown)
    assert float(stated) == pytest.approx(100.0 * inside.mean(), abs=1.0)
    rms = 1e3 * result.comparisons[0].joints.rms
    assert f"median RMS error {np.nanmedian(rms):.1f} mm, " in shown


def test_the_lines_are_of_the_aligned_estimate_where_its_frame_is_another(
    wave: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(wave), "--topic", "/kinect1/skeleton"]) == 0
    shown = capsys.readouterr().out
    assert "joints    25, after alignment in time and space\n" in shown and "no standard deviations are stated" in shown
    assert "'as it is' compares 'kinect1_optical_frame' with 'world'" in shown
    (error,) = re.findall(r"median RMS error ([\d.]+) mm", shown)
    assert float(error) < 150.0


def test_json_and_tables_agree(replayed_wave: Path, result: Evaluation, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(replayed_wave), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported["delay_ms"] == pytest.approx(1e3 * result.delay, abs=1e-5)
    for table in tables(result):
        rows = reported["tables"][table.key]["rows"]
        assert tuple(rows) == table.names
        for column in table.columns:
            found = [np.nan if rows[name][column.key] is None else rows[name][column.key] for name in rows]
            assert found == pytest.approx(column.values, rel=1e-4, abs=1e-5, nan_ok=True)
    assert set(reported["tables"]) == {table.key for table in tables(result)}


def test_the_report_has_every_table_and_picture_in_one_file(reported: tuple[str, str], result: Evaluation) -> None:
    _, shown = reported
    made = report_of(result)
    assert made.lines() in html.unescape(shown) and made.text() in html.unescape(shown)
    addresses = re.findall(r'<img alt="" src="data:image/png;base64,([A-Za-z0-9+/=]+)">', shown)
    assert [base64.b64decode(each)[:8] for each in addresses] == [b"\x89PNG\r\n\x1a\n"] * 3
    assert "http" not in shown and shown.count("src=") == 3


def test_fused_skeletons_are_judged_where_asked_or_where_there_are_no_others(
    replayed_wave: Path, tmp_path: Path
) -> None:
    fused = read_estimate(replayed_wave, "/fused/skeleton")
    assert fused.topic == "/fused/skeleton" and fused.frame_id == "world"
    alone = read_estimate(bag_of(tmp_path / "fused", 3, "/fused/skeleton"))
    assert alone.topic == "/fused/skeleton" and alone.angles is None and len(alone.stamps_ns) == 3


@pytest.fixture(scope="module")
def places(replayed_wave: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Recordings and files by name."""
    folder = tmp_path_factory.mktemp("places")
    (folder / "notes.txt").write_text("no recording")
    return {
        "wave": replayed_wave,
        "twist": BAGS / "tpose_torso_twist",
        "reaching": BAGS / "camera_reaching",
        "text": folder / "notes.txt",
        "nowhere": folder / "nowhere",
        "empty": bag_of(folder / "empty", 0),
        "one": bag_of(folder / "one", 1),
        "two": bag_of(folder / "two", 2),
        "angles": bag_of(folder / "angles", 1, "/humans/bodies/markers/joint_states", JOINT_STATE),
    }


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{empty}"], r"empty: /filtered/skeleton is empty"),
        (["{one}"], r"one: 1 skeleton\(s\) .* at least 2"),
        (["{wave}", "--truth", "{two}"], r"two: none of the 2 skeletons of /filtered/skeleton has a trunk"),
        (["{wave}", "--truth", "{reaching}", "--own-clock"], r"do not show the same movement: best correlation"),
        (
            ["{two}", "--truth", "{twist}"],
            r"do not overlap in time: .*two from 1\.000 to 1\.000 s, .*from 17500000",
        ),
        (
            ["{wave}", "--truth", "{twist}"],
            r"twist: is another recording than .*: no frame of /kinect1/skeleton is in both",
        ),
        (["{twist}"], r"no topic /filtered/skeleton \(skeletons there: /ground_truth/skeleton, /kinect1"),
        (["{angles}"], r"angles: joint angles without skeletons, .*`body_tracking show \S*angles` prints them"),
        (["{wave}", "--topic", "/calibration"], r"/calibration holds geometry_msgs/msg/TransformStamped, expected"),
        (["{wave}", "--body", "bob"], r"no joint angles of 'bob' \(there: body1\)"),
        (["{text}"], r"notes\.txt: not an mcap file"),
        (["{wave}", "--truth", "{text}"], r"notes\.txt: not an mcap file"),
        (["{wave}", "--truth", "{nowhere}.c3d"], r"nowhere\.c3d"),
        (["{wave}", "--truth", "{nowhere}"], r"nowhere: no such recording"),
        (["{wave}", "--html", "{text}/page.html"], r"notes\.txt"),
        (["{wave}", "--truth", "{twist}", "--subject", "bob"], r"--subject: of a C3D file; the truth is .*twist"),
        (["{wave}", "--measurements", "{text}"], r"--measurements: of a C3D file; the truth is .*wave"),
    ],
)
def test_bad_input_is_reported_in_one_line(
    arguments: list[str], message: str, places: dict[str, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", *(argument.format(**places) for argument in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("body_tracking: ") and captured.err.count("\n") == 1
    assert re.search(message, captured.err), captured.err
    assert not captured.out


def test_a_note_says_that_only_the_first_of_several_people_is_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made = str(tmp_path / "three")
    assert main(["simulate", "-o", made, "--motion", "standing_still", "--seconds", "2", "--people", "3"]) == 0
    assert main(["evaluate", made, "--topic", "/kinect1/skeleton", "--json"]) == 0
    reported = json.loads(capsys.readouterr().out.partition("\n")[2])["notes"]
    for topic in ("/kinect1/skeleton", "/ground_truth/skeleton"):
        assert f"{made}: {topic} holds 3 people, only the first is compared" in reported


def test_a_topic_of_another_type_is_no_skeleton(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = bag_of(tmp_path / "typed", 0, "/filtered/skeleton", JOINT_STATE)
    assert main(["evaluate", str(folder)]) == 2
    assert f"/filtered/skeleton holds {JOINT_STATE}, expected {POINT_CLOUD}" in capsys.readouterr().err


def test_markers_have_a_clock_and_a_frame_of_their_own(
    shared_data: Path, wave: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """An estimate that is the markers' own joint centres, elsewhere, at another time, 30 times a second, with noise."""
    file = shared_data / "plug_in_gait" / "cgm__Test_Files__Movement_trial.c3d"
    if not file.is_file():
        pytest.skip(f"{file} is absent")
    markers = read_markers(file)
    times = markers.seconds(int(markers.stamps_ns[0]))
    shown = Curve(times, markers.positions, 0.15).at(np.arange(0.2, times[-1] - 0.1, 1.0 / 30.0))
    turn = Rotation.from_euler("zyx", [1.0, 0.2, -0.1]).as_matrix()
    shown = shown @ turn.T + np.random.default_rng(1).normal(0.0, 0.01, shown.shape)
    with BagWriter(tmp_path / "estimate") as bag:
        bag.add_topic("/filtered/skeleton", POINT_CLOUD)
        for number, positions in enumerate(shown):
            states = np.where(np.isfinite(positions).all(axis=1), 2, 0).astype(np.uint8)
            skeleton = Skeleton(10**12 + number * 33_333_333, "world", positions, states)
            bag.write_message("/filtered/skeleton", skeletons_to_cloud((skeleton,), BAG_MESSAGES), number)
    assert main(["evaluate", str(tmp_path / "estimate"), "--truth", str(file), "--json"]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert set(reported["tables"]) == {"joints_aligned", "angles_aligned", "lengths"} and reported["delay_ms"] is None
    rows = reported["tables"]["joints_aligned"]["rows"]
    # 10 mm of noise along each axis, less by the lines between the frames; every joint within its own scatter
    assert 10.0 < next(row for name, row in rows.items() if name.startswith("all"))["rms"] < 20.0
    assert rows["WristLeft"]["jitter"] == pytest.approx(10.0, rel=0.3)
    assert rows["WristLeft"]["off_track"] == 0.0
    assert main(["evaluate", str(wave), "--topic", "/kinect1/skeleton", "--truth", str(file)]) == 2
    assert "do not show the same movement" in capsys.readouterr().err

"""``body_tracking compare`` and ``evaluate EST --truth ANOTHER_ESTIMATE``: both errors count, and both clocks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_errors import NOISY, START_NS, Scene, correlated_noise, scene
from worn_targets import write_targets

from body_tracking.cli import main
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.evaluation.compare import report_of
from body_tracking.evaluation.estimated_segments import EstimatedSegments, read_true_segments
from body_tracking.evaluation.mutual_comparison import compare_estimates
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.messages.model import estimate_to_joint_state
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter
from body_tracking.simulation.people import MODEL

ELBOW = "elbow_flexion_left"


@pytest.fixture(scope="module")
def one() -> Scene:
    return scene(11, seconds=18.0, error_deg=3.0)


@pytest.fixture(scope="module")
def other(one: Scene) -> Scene:
    """Another estimate of the same motion, with twice the error and a bias of the elbow."""
    columns = [MODEL.coordinate_names.index(name) for name in NOISY]
    drawn = np.zeros((len(one.times), MODEL.nv))
    noise = correlated_noise(np.random.default_rng(3), (len(one.times), len(columns)), 0.3)
    drawn[:, columns] = 2.0 * one.stddev * noise
    drawn[:, MODEL.coordinate_names.index(ELBOW)] += np.radians(5.0)
    return replace(one, found=MODEL.integrate(one.true, drawn), stddev=2.0 * one.stddev)


def elbow_errors(made: Scene) -> np.ndarray:
    """(n,) degrees."""
    return np.degrees(MODEL.difference(made.true, made.found)[:, MODEL.coordinate_names.index(ELBOW)])


def later(estimate: EstimatedSegments, seconds: float) -> EstimatedSegments:
    """By a clock that is ahead."""
    ahead = round(seconds * NANOSECONDS)
    angles = replace(estimate.angles, stamps_ns=estimate.angles.stamps_ns + ahead)
    return replace(estimate, stamps_ns=estimate.stamps_ns + ahead, angles=angles)


def test_two_estimates_differ_by_the_errors_of_both(one: Scene, other: Scene) -> None:
    result = compare_estimates(one.estimate(), later(other.estimate(), 0.7))
    assert abs(result.offset_s - 0.7) < max(4.0 * result.clock_stddev, 0.005) < 0.1
    rows = {row.name: row for row in result.angles}
    elbow = rows[ELBOW]
    both = elbow_errors(one) - elbow_errors(other)
    assert np.degrees(elbow.measured) == pytest.approx(np.sqrt((both**2).mean()), rel=0.05)
    assert np.degrees(elbow.offset) == pytest.approx(both.mean(), abs=0.5)
    assert np.degrees(elbow.reference) == pytest.approx(6.0, rel=0.1)  # as stated
    assert rows["forearm_pronation_left"].covered == pytest.approx(0.95, abs=0.05)
    assert rows["neck_flexion"].measured < np.radians(0.3)  # no error in either; between frames interpolated


def test_estimates_of_other_conventions_or_times_are_not_compared(one: Scene) -> None:
    estimate = one.estimate()
    with pytest.raises(EvaluationError, match="replay both with the same --convention"):
        compare_estimates(estimate, replace(estimate, convention="isb"))
    still = replace(estimate, rotations=np.broadcast_to(estimate.rotations[:1], estimate.rotations.shape))
    with pytest.raises(EvaluationError, match="their stamps do not overlap"):
        compare_estimates(estimate, later(still, 1000.0))


@pytest.fixture(scope="module")
def folder(one: Scene, other: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags ``one`` and ``other`` of estimates, ``markers`` of targets, and ``true`` with the true states."""
    where = tmp_path_factory.mktemp("compared")
    one.write_estimate(where / "one")
    other.write_estimate(where / "other")
    write_targets(one.worn, where / "markers", START_NS)
    exact = replace(one, found=one.true)
    with BagWriter(where / "true", flush_interval_s=float("inf")) as bag:
        bag.add_topic(graph.TRUE_MODEL_STATE, JOINT_STATE)
        for state in exact.states:
            bag.write_message(
                graph.TRUE_MODEL_STATE, estimate_to_joint_state(state, MODEL, BAG_MESSAGES), state.stamp_ns
            )
    return where


def test_every_system_is_compared_with_every_other_and_the_truth(
    folder: Path, one: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = [str(folder / name) for name in ("one", "other", "markers")]
    assert main(["compare", *arguments, "--truth", str(folder / "true"), "--json"]) == 0
    tables = json.loads(capsys.readouterr().out)["tables"]
    differences = tables["differences"]["rows"]
    assert differences["one"]["one"] is None
    assert differences["one"]["other"] == differences["other"]["one"]
    assert differences["one"]["truth"] < differences["other"]["truth"] < differences["one"]["other"]
    assert differences["markers"]["truth"] < 1.0 < differences["markers"]["one"]
    assert tables["errors"]["rows"][ELBOW]["one"] == pytest.approx(np.sqrt((elbow_errors(one) ** 2).mean()), rel=0.05)
    # always stated, while the targets were seen for a second longer
    assert tables["known"]["rows"][ELBOW] == {
        "one": pytest.approx(97.0, abs=3.0),
        "other": pytest.approx(97.0, abs=3.0),
    }
    true = read_true_segments(folder / "true")
    assert true is not None and not true.angles.stddev.any()


def test_systems_of_two_recordings_are_not_compared(one: Scene) -> None:
    bags = Path(__file__).parents[2] / "bags"
    sides = {name: replace(one.estimate(), source=bags / name) for name in ("tpose_wave", "tpose_slow_down")}
    with pytest.raises(EvaluationError, match=r"tpose_slow_down: is another recording than .*tpose_wave"):
        report_of(sides)


def test_another_estimate_is_a_reference_that_errs_itself(
    folder: Path, other: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["evaluate", str(folder / "other"), "--truth", str(folder / "one"), "--json"]) == 0
    content = json.loads(capsys.readouterr().out)
    row = content["tables"]["reference_angles"]["rows"][ELBOW]
    # without the reference's own 3 degrees
    true = np.sqrt((elbow_errors(other) ** 2).mean())
    assert row["low"] < true < row["high"] and true < row["difference"]
    assert ELBOW not in content["too_poor"]
    assert main(["evaluate", str(folder / "other"), "--truth", str(folder / "one")]) == 0
    shown, rows = capsys.readouterr().out, content["tables"]["reference_angles"]["rows"]
    assert f"angles    {len(rows) - len(content['too_poor'])} of {len(rows)} for which the reference is good" in shown
    assert f"worst {ELBOW} {row['error']:.1f} deg" in shown and "-v prints" in shown and "RMSE-o" not in shown


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{one}"], "expected two or more recordings"),
        (["{one}", "{one}"], "with different names"),
        (["{one}", "--systems", "{yaml}"], "expected one RECORDING and -o FOLDER"),
        (["{one}", "--systems", "{yaml}", "-o", "{one}_out"], "expected a name and a list of arguments"),
        (["{one}", "--systems", "{one}.yaml", "-o", "{one}_out"], "one.yaml"),
        (["{one}", "--systems", "{other}", "-o", "{one}_out"], "kinects: replay does not take --bogus"),
        (["{one}", "--systems", "{lack}", "-o", "{one}_out"], "markers: nowhere: no such folder"),
    ],
)
def test_wrong_arguments_are_reported_in_one_line(
    folder: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], message: str
) -> None:
    (folder / "bad.yaml").write_text("kinects: ekf\n")
    (folder / "other.yaml").write_text("kinects: [--filter, ekf, --bogus]\n")
    # refused before the first replay, which would print its arguments
    (folder / "lack.yaml").write_text("markers: [--sensors, none, --marker-setup, nowhere]\n")
    names = {"one": folder / "one", "yaml": folder / "bad.yaml", "other": folder / "other.yaml"}
    names["lack"] = folder / "lack.yaml"
    assert main(["compare", *(each.format(**names) for each in arguments)]) == 2
    reported = capsys.readouterr().err
    assert message in reported and reported.count("\n") == 1

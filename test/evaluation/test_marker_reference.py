"""``body_tracking evaluate EST --truth MARKERS``: known errors are found, poor references and bad input are named."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from known_errors import DRIFT, OFFSET, START_NS, Scene, scene
from worn_targets import ARM, write_targets

from body_tracking.cli import main
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.evaluation.estimated_segments import joint_chains, split_near
from body_tracking.evaluation.hand_eye import Mounting
from body_tracking.evaluation.marker_reference import mounted_on, save_mountings
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.evaluation.reference_comparison import evaluate_by_markers
from body_tracking.evaluation.reference_error import Differences, judge
from body_tracking.kinematics.conventions import CONVENTIONS
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BagWriter
from body_tracking.simulation.people import MODEL
from draws import draws, some

BAGS = Path(__file__).resolve().parents[2] / "bags"


@pytest.fixture(scope="module")
def made() -> Scene:
    return scene(11, seconds=18.0, bias_deg=5.0)


@pytest.fixture(scope="module")
def folder(made: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Bags ``estimate``, ``markers`` and ``short``, of 2 s, and ``true.yaml`` with the true mountings."""
    where = tmp_path_factory.mktemp("judged")
    made.write_estimate(where / "estimate")
    names = ("shoulder_left", "UpperArmLeft", "forearm_left")
    write_targets(made.worn, where / "markers", START_NS, names=names)
    write_targets(made.worn.until(2.0), where / "short", START_NS, names=names)
    close = np.radians(0.3) ** 2 * np.eye(3)
    mountings = {name: Mounting(each, close) for name, each in zip(names, made.worn.mountings, strict=True)}
    save_mountings(where / "true.yaml", mountings, dict(zip(names, ARM, strict=True)))
    return where


def errors_of(made: Scene) -> dict[str, np.ndarray]:
    """(n,) radians, the true error of each angle."""
    exact = Scene(made.times, made.true, made.true, 0.0, made.worn).estimate().angles
    found = made.estimate().angles
    off = np.angle(np.exp(1j * (found.position - exact.position)))
    return dict(zip(found.names, off.T, strict=True))


def judged(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    assert main(["evaluate", *arguments, "--json"]) == 0
    content: dict[str, object] = json.loads(capsys.readouterr().out)
    return content


def test_known_errors_clock_and_scatter_are_found(
    made: Scene, folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    content = judged([str(folder / "estimate"), "--truth", str(folder / "markers"), "--html", str(page)], capsys)
    clock = content["clock"]
    middle = float(np.mean(made.times))
    assert abs(clock["offset_ms"] - 1e3 * (OFFSET + DRIFT * middle)) < 3.0 * clock["stddev_ms"] < 50.0  # type: ignore[index]
    rows = content["tables"]["reference_angles"]["rows"]  # type: ignore[index]
    true = errors_of(made)
    for name in ("elbow_flexion_left", "forearm_pronation_left", "shoulder_abduction_left"):
        # the mounting of the forearm absorbs the elbow's constant 5 degrees
        assert rows[name]["low"] <= np.degrees(true[name].std()) <= rows[name]["high"], name
        assert rows[name]["error"] == pytest.approx(np.degrees(true[name].std()), rel=0.4), name
    assert any("constant offsets of the estimate do not show" in note for note in content["notes"])  # type: ignore[attr-defined]
    assert "elbow_flexion_left" in page.read_text() and "data:image/png" in page.read_text()


@pytest.mark.slow
def test_a_constant_error_shows_with_known_mountings(
    made: Scene, folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = judged(
        [str(folder / "estimate"), "--truth", str(folder / "markers"), "--mountings", str(folder / "true.yaml")], capsys
    )
    row = content["tables"]["reference_angles"]["rows"]["elbow_flexion_left"]  # type: ignore[index]
    true = np.degrees(errors_of(made)["elbow_flexion_left"])
    assert abs(row["offset"] - true.mean()) < 2.0 * row["offset_stddev"] < 3.0
    assert row["low"] <= np.sqrt((true**2).mean()) <= row["high"]


@pytest.mark.slow
def test_mountings_are_saved_as_they_are_read(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    both = [str(folder / "estimate"), "--truth", str(folder / "markers")]
    saved = tmp_path / "mountings.yaml"
    assert main(["evaluate", *both, "--save-mountings", str(saved)]) == 0
    assert f"mountings: {saved}" in capsys.readouterr().out
    rows = judged([*both, "--mountings", str(saved)], capsys)["tables"]["reference_angles"]["rows"]  # type: ignore[index]
    # fitted to the same recording: nothing constant is left
    assert abs(rows["elbow_flexion_left"]["offset"]) < 2.0 * rows["elbow_flexion_left"]["offset_stddev"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["{estimate}", "--truth", "{markers}", "--mounted", "forearm_left=knee"],
            r"expected TARGET=SEGMENT, segments",
        ),
        (
            ["{estimate}", "--truth", "{markers}", "--mounted", "knee=head"],
            r"no such target; there are UpperArmLeft, f",
        ),
        (
            ["{estimate}", "--truth", "{markers}", "--mounted", "forearm_left=UpperArmLeft"],
            r"targets UpperArmLeft and forearm_left are both mounted on upper_arm_left",
        ),
        (["{estimate}", "--truth", "{markers}"], r"no segment's angular speed determines the offset of their clocks"),
        (["{twist}", "--truth", "{markers}"], r"holds neither /filtered/model_state nor skeletons on /filtered/skel"),
        (["{twist}", "--mounted", "a=head"], r"--mounted: of a recording of the marker system; the truth is .*twist"),
        (["{estimate}", "--truth", "{markers}", "--subject", "bob"], r"--subject: of a C3D file"),
        (["{estimate}", "--truth", "{markers}", "--mountings", "{text}"], r"notes\.txt: no mapping of targets"),
        (["{estimate}", "--truth", "{markers}", "--mountings", "{other}"], r"forearm_left is on head there, and on f"),
        (["{angles}", "--truth", "{markers}"], r"angles: holds neither /filtered/model_state nor skeletons"),
    ],
)
def test_bad_input_is_reported_in_one_line(
    arguments: list[str],
    message: str,
    made: Scene,
    folder: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    places = {"angles": tmp_path / "angles", "text": tmp_path / "notes.txt", "twist": BAGS / "tpose_torso_twist"}
    places |= {"estimate": folder / "estimate", "markers": folder / "short"}
    places["other"] = tmp_path / "other.yaml"
    places["text"].write_text("no mountings")
    known = {"forearm_left": Mounting(np.eye(3), np.eye(3))}
    save_mountings(places["other"], known, {"forearm_left": "head"})
    with BagWriter(places["angles"]) as bag:
        bag.add_topic(graph.joint_states_topic(graph.DEFAULT_BODY), JOINT_STATE)
    assert main(["evaluate", *(argument.format(**places) for argument in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.err.startswith("body_tracking: ") and captured.err.count("\n") == 1
    assert re.search(message, captured.err), captured.err


def test_targets_are_on_the_segments_of_their_names() -> None:
    assert mounted_on(("upper_arm_left_target", "ForearmLeft", "marker_chest", "wand"), ()) == {
        "upper_arm_left_target": "upper_arm_left",
        "ForearmLeft": "forearm_left",
        "marker_chest": "upper_trunk",
    }
    assert mounted_on(("a", "b"), ("a=UpperArmRight", "b=hand_right")) == {"a": "upper_arm_right", "b": "hand_right"}
    with pytest.raises(
        EvaluationError, match=r"0 of the targets upper_arm, forearm is on a known segment, 2 are needed"
    ):
        mounted_on(("upper_arm", "forearm"), ())


@pytest.mark.parametrize("name", some(tuple(CONVENTIONS), 2))
def test_angles_of_mounted_segments_are_those_of_the_convention(name: str, made: Scene) -> None:
    """The chains give the convention's own angles, where all segments carry targets and nothing errs."""
    from body_tracking.kinematics.conventions import angles_of

    segments = frozenset(MODEL.segment_names)
    states = replace(made, stddev=1e-6).states[::60]
    exact = [angles_of(state, MODEL, name) for state in states]
    rotations = np.stack([MODEL.forward(state.q, state.lengths).rotations for state in states])
    chains = joint_chains(name, segments, MODEL)
    compared = 0
    for chain in chains:
        parent, child = (MODEL.segment_names.index(each) for each in (chain.parent, chain.child))
        near = np.zeros((len(states), 3))
        for place, angle in enumerate(chain.names):
            if angle in exact[0].names:
                near[:, place] = [each.position[each.names.index(angle)] for each in exact]
        found, _ = split_near(chain, rotations[:, parent].swapaxes(-1, -2) @ rotations[:, child], near)
        for place, angle in enumerate(chain.names):
            if angle in exact[0].names:
                compared += 1
                # angles are held within 0.1 degrees of a singular pose
                assert np.degrees(np.abs(found[:, place] - near[:, place])).max() < 0.1, angle
    assert compared >= 3


def test_the_error_of_the_estimate_is_the_difference_without_the_references() -> None:
    rng = np.random.default_rng(4)
    inside, count = 0, 200
    for _ in range(count):
        mounting = rng.normal(0.0, 1.0, (2, 1))
        parts = [
            Differences(
                1.0 / 30.0,
                rng.normal(0.0, 3.0, (600, 1)) + rng.normal(0.0, 0.5, (600, 1)) + each,
                np.full(600, 0.25),
                np.ones((600, 1, 1)),
            )
            for each in mounting
        ]
        found = judge("angle", parts, mountings_known=False)
        assert found is not None and not found.too_poor
        inside += found.low <= 3.0 <= found.high
    assert inside >= 0.9 * count  # 180 of 200; 95 % less three standard deviations
    poor = judge(
        "angle",
        [Differences(0.03, part.errors, np.full(600, 4.0), part.mounting) for part in parts],
        mountings_known=False,
    )
    assert poor is not None and poor.too_poor and np.isnan(poor.error) and poor.high >= poor.measured


@pytest.mark.slow
def test_errors_that_last_longer_than_half_of_the_recording_are_in_the_interval() -> None:
    """Each half has a constant error beside noise; the mounting is that of the other half, stated to be exact."""
    rng = np.random.default_rng(8)
    lasting, noise, inside = 2.0, 1.0, []
    for _ in range(200):
        means = rng.normal(0.0, lasting, 2)
        parts = []
        for mean, other in (means, means[::-1]):
            errors = mean - other + rng.normal(0.0, noise, (300, 1))
            parts.append(Differences(0.03, errors, np.zeros(300), np.full((300, 1, 1), 1e-6)))
        found = judge("angle", parts, mountings_known=False)
        assert found is not None
        # the error that one mounting for the whole recording leaves
        true = np.hypot(noise, 0.5 * abs(means[0] - means[1]))
        inside.append(found.low <= true <= found.high if not found.too_poor else found.high >= true)
    assert np.mean(inside) > 0.9


@pytest.mark.slow
def test_known_errors_are_in_their_intervals_over_people() -> None:
    """3 degrees of noise in all joints, 5 of bias; noisier markers are named too poor."""
    inside, poor, all_poor = [], [], []
    for seed in range(300, 300 + draws(8, 16)):
        made = scene(seed, bias_deg=5.0)
        true = errors_of(made)
        estimate = made.estimate()
        result = evaluate_by_markers(estimate, made.reference())
        for each in result.angles:
            poor.append(each.too_poor)
            if not each.too_poor:
                inside.append(each.low <= true[each.name].std() <= each.high)
        if seed >= 300 + draws(2, 4):
            continue
        noisy = scene(seed, bias_deg=5.0, markers_deg=4.0)
        all_poor += [each.too_poor for each in evaluate_by_markers(noisy.estimate(), noisy.reference()).angles]
    assert np.mean(inside) > 0.9 and np.mean(poor) < 0.2
    assert np.mean(all_poor) > 0.8

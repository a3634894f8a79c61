"""Laws of joint centres from markers, on postures whose joint centres are known, and Vicon's own results."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import ezc3d
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from body_tracking.core.c3d import MarkerError, read_trial
from body_tracking.core.skeleton import FloatArray, Joint
from body_tracking.evaluation.plug_in_gait import (
    MARKERS,
    MarkerTruth,
    Measurements,
    chord,
    joint_centres,
    read_measurements,
    read_plug_in_gait,
)
from body_tracking.evaluation.smoothing import LONGEST_GAP, fill_gaps, smooth
from draws import draws, some

RATE = 100.0
RADIUS = 0.007
MEASURED = Measurements(
    np.array([0.045, 0.050]),
    np.array([0.080, 0.086]),
    np.array([0.052, 0.056]),
    np.array([0.028, 0.030]),
    np.array([0.880, 0.886]),
    0.230,
)
X, Y, Z = np.eye(3)
ARMS = tuple(
    tuple(Joint[f"{joint}_{side}"] for joint in ("SHOULDER", "ELBOW", "WRIST", "HAND")) for side in ("LEFT", "RIGHT")
)
FILES = (
    "cgm__59993_Frame__59993_Frame_Static.c3d",
    "cgm__ROM__Sample_Static.c3d",
    "cgm__Test_Files__Movement_trial.c3d",
)
SUBJECT_FILE = "cgm__ROM__Sample_SM.vsk"


def unit(vector: FloatArray) -> FloatArray:
    return vector / np.linalg.norm(vector)


def at_angle(axis: FloatArray, towards: FloatArray, component: float, hint: FloatArray) -> FloatArray:
    """The unit vector normal to ``axis`` with this component along ``towards``; of the two, that nearer to ``hint``."""
    axis = unit(axis)
    first = towards - (towards @ axis) * axis
    cosine = component / np.linalg.norm(first)
    first, second = unit(first), np.cross(axis, unit(first))
    assert abs(cosine) < 1.0
    sine = np.sqrt(1.0 - cosine**2) * (1.0 if second @ hint > 0.0 else -1.0)
    return cosine * first + sine * second


def arm_markers(
    side: int, shoulder: FloatArray, elbow: FloatArray, wrist: FloatArray, hand: FloatArray
) -> dict[str, FloatArray]:
    """Markers of an arm with these joint centres, by inverting the chord function.

    The thorax stands at the origin of the world, with its axes.
    """
    letter, sign = ("L", 1.0) if side == 0 else ("R", -1.0)
    offset = MEASURED.shoulder_offset[side] + RADIUS
    half_elbow, half_wrist, half_hand = (
        0.5 * each[side] + RADIUS for each in (MEASURED.elbow_width, MEASURED.wrist_width, MEASURED.hand_thickness)
    )
    # the wand's plane contains what of x is normal to the line from the origin to the marker
    acromion = shoulder + offset * at_angle(shoulder, X, offset * (X @ shoulder) / (shoulder @ shoulder), Z)
    # the middle of the bar sees elbow and wrist under a right angle
    back = np.cross(wrist - elbow, np.cross(shoulder - elbow, wrist - elbow))
    bar_middle = chord(half_wrist, elbow, wrist, wrist + back)
    half_bar = 0.04 * sign * unit(np.cross(wrist - bar_middle, bar_middle - elbow))
    # in the plane of the chord, the normal to the line from shoulder to marker is normal to the forearm
    upper, forearm = shoulder - elbow, bar_middle - elbow
    component = half_elbow * (1.0 - forearm @ upper / (upper @ upper))
    lateral = at_angle(upper, forearm, component, sign * np.cross(upper, forearm))
    along = unit(hand - wrist)
    dorsal = unit(bar_middle - wrist - ((bar_middle - wrist) @ along) * along)
    return {
        f"{letter}SHO": acromion,
        f"{letter}ELB": elbow + half_elbow * lateral,
        f"{letter}WRA": bar_middle + half_bar,
        f"{letter}WRB": bar_middle - half_bar,
        f"{letter}FIN": hand + half_hand * dorsal,
    }


def body(
    elevation: float = 0.6, plane: float = 0.7, bend: float = 0.9, turn: float = 0.3, droop: float = 0.2
) -> tuple[dict[str, FloatArray], dict[Joint, FloatArray]]:
    """Places (3,) of markers and joint centres of a posture; the thorax stands at the origin with the world's axes.

    Args:
        elevation: of the upper arms against the trunk, radians, as the others.
        plane: of the vertical planes in which they are raised, 0 forward.
        bend: of the elbows.
        turn: of the forearms about the upper arms.
        droop: of the hands against the forearms.
    """
    trunk = {
        "CLAV": np.array([0.0, 0.0, 0.0]),
        "STRN": np.array([0.02, 0.0, -0.16]),
        "C7": np.array([-0.13, 0.0, 0.06]),
        "T10": np.array([-0.15, 0.0, -0.20]),
    }
    up = trunk["C7"] + trunk["CLAV"] - trunk["T10"] - trunk["STRN"]
    upright = Rotation.from_euler("y", -np.arctan2(up[0], up[2]))
    markers = {name: upright.apply(place) + RADIUS * X for name, place in trunk.items()}
    joints = {}
    for side, sign in enumerate((1.0, -1.0)):
        outwards = np.cos(plane) * X + sign * np.sin(plane) * Y
        along = np.sin(elevation) * outwards - np.cos(elevation) * Z
        hinge = Rotation.from_rotvec(sign * turn * along).apply(unit(np.cross(along, X + Y)))
        forearm = Rotation.from_rotvec(bend * hinge).apply(along)
        palm = Rotation.from_rotvec(droop * hinge).apply(forearm)
        shoulder = np.array([-0.03, sign * 0.17, -0.02])
        elbow = shoulder + 0.29 * along
        wrist = elbow + 0.25 * forearm
        arm = (shoulder, elbow, wrist, wrist + 0.09 * palm)
        markers |= arm_markers(side, *arm)
        joints |= dict(zip(ARMS[side], arm, strict=True))
        letter = "LR"[side]
        markers[letter + "FHD"] = np.array([0.05, sign * 0.07, 0.28])
        markers[letter + "BHD"] = np.array([-0.13, sign * 0.07, 0.30])
        markers[letter + "ASI"] = np.array([0.02, sign * 0.115, -0.50])
        markers[letter + "PSI"] = np.array([-0.16, sign * 0.04, -0.47])
    return markers, joints


def moving(frames: int = 60, rate: float = RATE) -> tuple[dict[str, FloatArray], FloatArray]:
    """Trajectories (n, 3) of all markers of a body that moves its arms, and (n, 25, 3) joint centres or NaN."""
    times = np.arange(frames) / rate
    postures = [body(elevation=0.8 + 0.4 * np.sin(4.0 * t), bend=0.9 + 0.5 * np.sin(6.0 * t)) for t in times]
    joints = np.full((frames, len(Joint), 3), np.nan)
    for joint in postures[0][1]:
        joints[:, joint] = [posture[1][joint] for posture in postures]
    return {name: np.stack([posture[0][name] for posture in postures]) for name in MARKERS}, joints


def write(
    path: Path,
    markers: Mapping[str, FloatArray],
    *,
    rate: float = RATE,
    prefix: str = "",
    unit: str = "mm",
    up: str = "+Z",
    parameters: Mapping[str, float] | None = None,
    unseen: Mapping[str, Iterable[int]] | None = None,
) -> Path:
    """A C3D file of trajectories (n, 3) in metres; ``unseen`` frames get the residual of a point that is not seen."""
    file = ezc3d.c3d()
    points = np.ones((4, len(markers), len(next(iter(markers.values())))))
    points[:3] = np.stack(list(markers.values())).transpose(2, 0, 1) * {"mm": 1e3, "cm": 1e2, "m": 1.0}.get(unit, 1.0)
    file["parameters"]["POINT"]["RATE"]["value"] = [rate]
    file["parameters"]["POINT"]["LABELS"]["value"] = [prefix + name for name in markers]
    file["parameters"]["POINT"]["UNITS"]["value"] = [unit]
    file.add_parameter("POINT", "Y_SCREEN", [up])
    for name, value in (parameters or {}).items():
        file.add_parameter("PROCESSING", name, [value])
    file["data"]["points"] = points
    if unseen:
        residuals = np.zeros((1, *points.shape[1:]))
        for name, frames in unseen.items():
            residuals[0, list(markers).index(name), list(frames)] = -1.0
        file["data"]["meta_points"]["residuals"] = residuals
        file["data"]["meta_points"]["camera_masks"] = np.zeros((7, *points.shape[1:]), dtype=bool)
    file.write(str(path))
    return path


def elbow_flexion(positions: FloatArray) -> FloatArray:
    """(n, 2) degrees between the lines of upper arm and forearm, left and right, of joints (n, 25, 3)."""
    shoulder, elbow, wrist = (positions[:, [arm[part] for arm in ARMS]] for part in range(3))
    upper, forearm = elbow - shoulder, wrist - elbow
    sine = np.linalg.norm(np.cross(upper, forearm), axis=-1)
    return np.degrees(np.arctan2(sine, (upper * forearm).sum(axis=-1)))


points = st.tuples(*[st.floats(-1.0, 1.0)] * 3).map(np.array)


@given(joint=points, marker=points, towards=points, share=st.floats(0.05, 0.95))
def test_the_chord_sees_joint_and_marker_under_a_right_angle(
    joint: FloatArray, marker: FloatArray, towards: FloatArray, share: float
) -> None:
    normal = np.cross(joint - marker, towards - marker)
    length = float(np.linalg.norm(joint - marker))
    assume(length > 0.05 and np.linalg.norm(normal) > 0.01)
    centre = chord(share * length, joint, marker, towards)
    assert np.linalg.norm(centre - marker) == pytest.approx(share * length)
    assert (joint - centre) @ (marker - centre) == pytest.approx(0.0, abs=1e-9)
    assert (centre - marker) @ normal == pytest.approx(0.0, abs=1e-9)
    assert np.cross(joint - marker, centre - marker) @ normal > 0.0


def test_there_is_no_chord_to_a_joint_that_is_too_near() -> None:
    assert np.isnan(chord(0.2, 0.1 * X, 0.0 * X, Z)).all()


@settings(max_examples=draws(12, 50), deadline=None)
@given(
    elevation=st.floats(0.1, 2.8),
    plane=st.floats(-0.2, 1.8),
    bend=st.floats(0.4, 2.4),  # on a straight arm the elbow is undetermined
    turn=st.floats(-1.5, 1.5),
    droop=st.floats(-0.9, 0.9),
    turned=points,
    shift=points,
)
def test_the_joint_centres_of_a_known_posture_are_found(
    elevation: float,
    plane: float,
    bend: float,
    turn: float,
    droop: float,
    turned: FloatArray,
    shift: FloatArray,
) -> None:
    markers, joints = body(elevation, plane, bend, turn, droop)
    rotation = Rotation.from_rotvec(2.0 * turned)
    positions = joint_centres({name: rotation.apply(place)[None] + shift for name, place in markers.items()}, MEASURED)
    for joint, place in joints.items():
        assert positions[0, joint] == pytest.approx(rotation.apply(place) + shift, abs=1e-9), joint.name
    unknown = np.isnan(positions[0]).all(axis=1)
    assert {Joint(joint) for joint in np.flatnonzero(unknown)} == {
        joint for joint in Joint if joint.name.split("_")[0] in ("NECK", "THUMB", "KNEE", "ANKLE", "FOOT")
    } | {Joint.HAND_TIP_LEFT, Joint.HAND_TIP_RIGHT}


@pytest.mark.parametrize(("bend", "found", "off"), [(0.0, 27.0, 64.0), (30.0, 37.0, 16.0), (90.0, 91.0, 3.0)])
def test_a_straight_arm_in_a_t_pose_looks_bent(bend: float, found: float, off: float) -> None:
    """An error of the convention itself, which the module's docstring states."""
    shoulder, elbow = np.array([-0.03, 0.17, -0.02]), np.array([-0.03, 0.46, -0.02])
    forearm = np.sin(np.radians(bend)) * X + np.cos(np.radians(bend)) * Y  # flexion in the horizontal plane
    wrist = elbow + 0.25 * forearm
    markers = body()[0] | {
        "LSHO": shoulder + (MEASURED.shoulder_offset[0] + RADIUS) * Z,
        "LELB": elbow + (0.5 * MEASURED.elbow_width[0] + RADIUS) * Z,
        "LWRA": wrist + (0.5 * MEASURED.wrist_width[0] + RADIUS) * Z + 0.04 * np.cross(Z, -forearm),
        "LWRB": wrist + (0.5 * MEASURED.wrist_width[0] + RADIUS) * Z - 0.04 * np.cross(Z, -forearm),
    }
    positions = joint_centres({name: place[None] for name, place in markers.items()}, MEASURED)
    assert elbow_flexion(positions)[0, 0] == pytest.approx(found, abs=0.5)
    assert 1e3 * np.linalg.norm(positions[0, Joint.ELBOW_LEFT] - elbow) == pytest.approx(off, abs=0.5)


def test_hips_are_symmetric_behind_and_below_the_spines_of_the_ilium() -> None:
    markers = {name: place[None] for name, place in body()[0].items()}
    for measurements in (MEASURED, replace(MEASURED, leg_length=np.full(2, np.nan))):
        same_legs = replace(measurements, leg_length=np.full(2, measurements.leg_length.mean()))
        positions = joint_centres(markers, same_legs)
        left, right = positions[0, [Joint.HIP_LEFT, Joint.HIP_RIGHT]]
        assert left == pytest.approx(right * [1.0, -1.0, 1.0], abs=1e-12)
        assert 0.06 < left[1] < 0.10
        assert -0.62 < left[2] < -0.55
        assert -0.09 < left[0] < 0.0
        assert positions[0, Joint.SPINE_BASE] == pytest.approx(0.5 * (left + right))


@settings(max_examples=draws(12, 30), deadline=None)
@given(
    coefficients=st.lists(points, min_size=4, max_size=4),
    rate=st.sampled_from((50.0, 100.0, 120.0)),
    first=st.integers(1, 40),
    length=st.floats(0.05, 0.99),
)
def test_short_gaps_in_a_cubic_are_filled_exactly(
    coefficients: list[FloatArray], rate: float, first: int, length: float
) -> None:
    times = np.arange(90) / rate
    curve = sum(place * times[:, None] ** power for power, place in enumerate(coefficients))
    gapped = np.array(curve)
    missing = max(1, int(length * LONGEST_GAP * rate - 1e-6))
    gapped[first : first + missing] = np.nan
    gapped[75] = np.nan
    assert fill_gaps(gapped, rate) == pytest.approx(curve, abs=1e-9)


def test_gaps_of_a_fifth_of_a_second_stay_open() -> None:
    curve = np.sin(np.arange(200)[:, None] / [20.0, 30.0, 40.0])
    for rate, missing in ((100.0, 20), (120.0, 24), (30.0, 6)):
        for longer in (0, 1):
            gapped = curve.copy()
            gapped[50 : 50 + missing - 1 + longer] = np.nan
            gapped[:5] = gapped[-5:] = np.nan
            filled = fill_gaps(gapped, rate)
            assert np.isnan(filled[50 : 50 + missing - 1 + longer]).all() == bool(longer)
            assert np.isnan(filled[:5]).all() and np.isnan(filled[-5:]).all()
            known = np.isfinite(gapped)
            assert np.array_equal(filled[known], gapped[known])


@pytest.mark.parametrize("frames", [60, 400])
def test_smoothing_is_the_spline_of_generalised_cross_validation(frames: int) -> None:
    times = np.arange(frames) / RATE
    noise = np.random.default_rng(4).standard_normal(frames)
    noisy = 300.0 * np.sin(5.0 * times) + 60.0 * np.sin(12.0 * times + 1.0) + noise
    steps = np.arange(frames, dtype=float)
    scipys = make_smoothing_spline(steps, noisy)(steps)
    taken = np.abs(noisy - scipys).max()
    assert smooth(noisy[:, None])[:, 0] == pytest.approx(scipys, abs=0.02 * taken)


def test_smoothing_keeps_a_smooth_curve_and_its_gaps() -> None:
    times = np.arange(500)[:, None] / RATE
    curve = 300.0 * np.sin(times * [3.0, 5.0, 9.0]) + [0.0, 500.0, 1000.0]  # mm
    curve[200:240] = curve[:3] = np.nan
    smoothed = smooth(curve)
    assert np.array_equal(np.isnan(smoothed), np.isnan(curve))
    assert np.nanmax(np.abs(smoothed - curve)) < 0.01


PARAMETERS = {
    f"{letter}{name}": 1e3 * float(values[side])
    for side, letter in enumerate("LR")
    for name, values in (
        ("ShoulderOffset", MEASURED.shoulder_offset),
        ("ElbowWidth", MEASURED.elbow_width),
        ("WristWidth", MEASURED.wrist_width),
        ("HandThickness", MEASURED.hand_thickness),
        ("LegLength", MEASURED.leg_length),
    )
} | {"InterAsisDistance": 1e3 * MEASURED.asis_distance}


def assert_same_joints(truth: MarkerTruth, joints: FloatArray, tolerance: float = 1e-5) -> None:
    """Tolerance in metres; files hold floats of 4 bytes."""
    known = np.isfinite(joints)
    assert truth.positions[known] == pytest.approx(joints[known], abs=tolerance)


@pytest.mark.parametrize(("prefix", "unit_of_length"), some([("Anna:", "mm"), ("", "m"), ("", "mm"), ("", "cm")], 2))
def test_joint_centres_are_read_from_a_file(tmp_path: Path, prefix: str, unit_of_length: str) -> None:
    markers, joints = moving()
    path = write(tmp_path / "a.c3d", markers, prefix=prefix, unit=unit_of_length, parameters=PARAMETERS)
    truth = read_plug_in_gait(path, smoothing=False)
    assert_same_joints(truth, joints)
    assert truth.missing == truth.gaps == truth.estimated == ()
    assert np.diff(truth.stamps) == pytest.approx(1.0 / RATE)
    assert_same_joints(read_plug_in_gait(path), joints, 1e-4)


@pytest.mark.parametrize(("up", "order"), [("+Y", (1, 2, 0)), ("+X", (2, 0, 1))])
def test_the_vertical_axis_of_the_file_becomes_z(tmp_path: Path, up: str, order: tuple[int, ...]) -> None:
    markers, joints = moving(20)
    path = write(
        tmp_path / "a.c3d",
        {name: each[:, order] for name, each in markers.items()},
        up=up,
        parameters=PARAMETERS,
    )
    assert_same_joints(read_plug_in_gait(path, smoothing=False), joints)


def test_points_that_are_not_seen_are_gaps(tmp_path: Path) -> None:
    markers, joints = moving()
    markers["LELB"][20:26] = np.nan
    markers["RSHO"][30:35] = 0.0
    path = write(tmp_path / "a.c3d", markers, parameters=PARAMETERS, unseen={"T10": range(40, 45)})
    truth = read_plug_in_gait(path, smoothing=False)
    assert truth.gaps == ()
    assert_same_joints(truth, joints, 1e-4)
    markers["LELB"][10:40] = np.nan
    truth = read_plug_in_gait(write(path, markers, parameters=PARAMETERS, unseen={"T10": range(40, 45)}))
    assert [str(gap) for gap in truth.gaps] == ["LELB from 0.10 s to 0.39 s"]
    assert np.isnan(truth.positions[10:40, Joint.ELBOW_LEFT]).all()
    assert np.isfinite(truth.positions[10:40, Joint.ELBOW_RIGHT]).all()
    assert np.isfinite(truth.positions[10:40, Joint.SHOULDER_LEFT]).all()


def test_joints_of_missing_markers_are_unknown(tmp_path: Path) -> None:
    markers, joints = moving(20)
    for name in ("LFIN", "RPSI", "RELB", "LBHD"):
        del markers[name]
    truth = read_plug_in_gait(write(tmp_path / "a.c3d", markers, parameters=PARAMETERS), smoothing=False)
    assert truth.missing == ("LBHD", "LFIN", "RELB", "RPSI")
    unknown = {Joint(joint).name for joint in np.flatnonzero(np.isnan(truth.positions[0, :, 0]))}
    assert {"HAND_LEFT", "ELBOW_RIGHT", "WRIST_RIGHT", "HAND_RIGHT", "HIP_LEFT", "SPINE_BASE", "HEAD"} < unknown
    joints[:, [Joint[name] for name in unknown]] = np.nan
    assert np.isfinite(joints[:, Joint.WRIST_LEFT]).all()
    assert_same_joints(truth, joints)


def test_the_sacrum_stands_in_for_the_posterior_spines(tmp_path: Path) -> None:
    markers, _ = moving(20)
    both = read_plug_in_gait(write(tmp_path / "a.c3d", markers, parameters=PARAMETERS), smoothing=False)
    markers["SACR"] = 0.5 * (markers.pop("LPSI") + markers.pop("RPSI"))
    one = read_plug_in_gait(write(tmp_path / "b.c3d", markers, parameters=PARAMETERS), smoothing=False)
    assert one.missing == ()
    assert one.positions == pytest.approx(both.positions, abs=1e-6, nan_ok=True)


def test_missing_measurements_are_estimated_and_named(tmp_path: Path) -> None:
    markers, _ = moving(20)
    given_in_part = {"LElbowWidth": 80.0, "RElbowWidth": 86.0, "LShoulderOffset": 45.0, "RWristWidth": 0.0}
    truth = read_plug_in_gait(write(tmp_path / "a.c3d", markers, parameters=given_in_part))
    assert truth.estimated == ("shoulder_offset", "wrist_width", "hand_thickness", "asis_distance")
    assert truth.measurements.elbow_width == pytest.approx(MEASURED.elbow_width)
    assert truth.measurements.shoulder_offset[0] == pytest.approx(0.045)
    acromia = np.linalg.norm(markers["LSHO"] - markers["RSHO"], axis=1)
    assert truth.measurements.shoulder_offset[1] == pytest.approx(0.12 * np.median(acromia) - RADIUS, abs=1e-6)
    assert truth.measurements.asis_distance == pytest.approx(0.23, abs=1e-6)
    assert np.isfinite(truth.positions[:, Joint.HIP_LEFT]).all()


def test_one_of_several_subjects_is_chosen_by_name(tmp_path: Path) -> None:
    markers, joints = moving(20)
    away = {f"Ben:{name}": each + [2.0, 0.0, 0.0] for name, each in markers.items()}
    two = {f"Anna:{name}": each for name, each in markers.items()} | away
    path = write(tmp_path / "two.c3d", two, parameters=PARAMETERS)
    for subject, x in (("Anna", 0.0), ("Ben", 2.0)):
        truth = read_plug_in_gait(path, subject=subject, smoothing=False)
        assert_same_joints(truth, joints + [x, 0.0, 0.0])
    with pytest.raises(MarkerError, match="2 subjects, choose one of Anna, Ben"):
        read_plug_in_gait(path)
    with pytest.raises(MarkerError, match="no subject 'Eve'; found Anna, Ben"):
        read_plug_in_gait(path, subject="Eve")


def test_markers_that_are_needed_are_asked_for(tmp_path: Path) -> None:
    markers, _ = moving(20)
    lacking = {name: each for name, each in markers.items() if name not in ("C7", "LELB")}
    with pytest.raises(MarkerError, match=r"without the markers C7; needed are .*; found LFHD, .* and 0 other"):
        read_plug_in_gait(write(tmp_path / "a.c3d", lacking))
    del lacking["RWRB"]
    lacking["C7"], lacking["Ball"] = markers["C7"], markers["C7"]
    with pytest.raises(MarkerError, match=r"without the markers LELB, RWRB; .* and 1 other points \(Ball\)"):
        read_plug_in_gait(write(tmp_path / "b.c3d", lacking))
    markers["STRN"][:] = np.nan
    with pytest.raises(MarkerError, match=r"STRN \(STRN: named but never seen\)"):
        read_plug_in_gait(write(tmp_path / "c.c3d", markers))
    with pytest.raises(MarkerError, match=r"found none of Plug-in Gait's and 1 other points \(Ball\)"):
        read_plug_in_gait(write(tmp_path / "d.c3d", {"Anna:Ball": markers["C7"]}))


def test_gaps_that_leave_nothing_are_named(tmp_path: Path) -> None:
    markers, _ = moving(60)
    markers["CLAV"][:30] = np.nan
    markers["LELB"][30:] = markers["RSHO"][30:] = np.nan
    with pytest.raises(MarkerError, match=r"no arm .* 60 frames; .*CLAV from 0\.00 s to 0\.29 s; LELB from 0\.30 s"):
        read_plug_in_gait(write(tmp_path / "a.c3d", markers))


def test_two_points_of_one_name_are_refused(tmp_path: Path) -> None:
    markers, _ = moving(20)
    path = write(tmp_path / "a.c3d", {name.replace("RFIN", "LFIN "): each for name, each in markers.items()})
    with pytest.raises(MarkerError, match="more than one point is called LFIN"):
        read_plug_in_gait(path)


def test_unreadable_recordings_are_refused(tmp_path: Path) -> None:
    markers, _ = moving(20)
    whole = write(tmp_path / "whole.c3d", markers).read_bytes()
    contents = {
        "is empty": b"",
        "not a C3D file": b"stamp,joint,x,y,z\n" * 100,
        "before the end of its parameters": whole[:600],
        r"cut off after \d+ of 20 frames": whole[:-1000],
    }
    for message, content in contents.items():
        path = tmp_path / "bad.c3d"
        path.write_bytes(content)
        with pytest.raises(MarkerError, match=rf"bad\.c3d: .*{message}"):
            read_plug_in_gait(path)
    with pytest.raises(MarkerError, match="No such file"):
        read_plug_in_gait(tmp_path / "none.c3d")
    with pytest.raises(MarkerError, match="not a file"):
        read_plug_in_gait(tmp_path)
    with pytest.raises(MarkerError, match="unit of length 'inch', expected one of mm, cm, m"):
        read_plug_in_gait(write(tmp_path / "inch.c3d", markers, unit="inch"))
    with pytest.raises(MarkerError, match="'-Z', expected"):
        read_plug_in_gait(write(tmp_path / "down.c3d", markers, up="-Z"))


def test_the_extra_is_named_where_ezc3d_is_absent(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.c3d", moving(20)[0])
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(MarkerError, match=r"pip install 'ezc3d>="):
        read_plug_in_gait(path)


def test_a_subject_file_without_measurements_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.vsk"
    path.write_text('<KinematicModel><StaticParameter NAME="Height" VALUE="1760"/></KinematicModel>')
    with pytest.raises(MarkerError, match="no measurements among its 1 parameters"):
        read_measurements(path)
    path.write_text("<KinematicModel>")
    with pytest.raises(MarkerError, match="not a subject file"):
        read_measurements(path)
    with pytest.raises(MarkerError, match="No such file"):
        read_measurements(tmp_path / "b.vsk")


def of_vicon(shared_data: Path, name: str, *, smoothing: bool, measured: bool = True) -> MarkerTruth:
    """A real file, with the measurements that Vicon had."""
    folder = shared_data / "plug_in_gait"
    measurements = None if measured else Measurements.from_parameters({})
    if measured and "ROM" in name:
        measurements = read_measurements(folder / SUBJECT_FILE)
    return read_plug_in_gait(folder / name, measurements=measurements, smoothing=smoothing)


def vicon_centres(shared_data: Path, name: str) -> FloatArray:
    """(n, 25, 3) the joint centres that Vicon wrote into a file: points, or origins of segments; NaN where none."""
    trial = read_trial(shared_data / "plug_in_gait" / name, None, MARKERS)
    unknown = np.full((trial.frames, 3), np.nan)
    centres = np.full((trial.frames, len(Joint), 3), np.nan)
    for letter, side in (("L", "LEFT"), ("R", "RIGHT")):
        for joint, *points in (
            ("SHOULDER", "SJC", "CLO"),
            ("ELBOW", "EJC", "HUO"),
            ("WRIST", "WJC", "RAO"),
            ("HIP", "HJC", "FEP"),
        ):
            found = (trial.points[letter + each] for each in points if letter + each in trial.points)
            centres[:, Joint[f"{joint}_{side}"]] = next(found, unknown)
        # Vicon's hand centre is half way from the wrist to the far end of its segment
        end = trial.points.get(f"{letter}HNO", unknown)
        centres[:, Joint[f"HAND_{side}"]] = 0.5 * (centres[:, Joint[f"WRIST_{side}"]] + end)
    centres[:, Joint.SPINE_BASE] = centres[:, [Joint.HIP_LEFT, Joint.HIP_RIGHT]].mean(axis=1)
    return centres


@pytest.mark.parametrize("name", FILES)
def test_joint_centres_are_those_that_vicon_wrote(shared_data: Path, name: str) -> None:
    # smoothing removes the remaining noise: none where Vicon's software has smoothed before
    for smoothing, metres in ((False, 1e-6), (True, 5e-4)):
        truth, theirs = of_vicon(shared_data, name, smoothing=smoothing), vicon_centres(shared_data, name)
        assert truth.missing == truth.gaps == truth.estimated == ()
        modelled = np.isfinite(theirs[:, :, 0])
        assert modelled[:, [*ARMS[0], *ARMS[1], Joint.HIP_LEFT, Joint.HIP_RIGHT, Joint.SPINE_BASE]].all()
        assert np.linalg.norm(truth.positions - theirs, axis=-1)[modelled].max() < metres


@pytest.mark.parametrize("name", FILES)
def test_estimated_measurements_keep_elbow_flexion_within_six_degrees(shared_data: Path, name: str) -> None:
    truth = of_vicon(shared_data, name, smoothing=False, measured=False)
    assert len(truth.estimated) == 5
    apart = elbow_flexion(truth.positions) - elbow_flexion(vicon_centres(shared_data, name))
    assert np.abs(apart).max() < 6.0


def test_the_stamps_are_those_of_the_trial_that_the_file_is_cut_from(shared_data: Path) -> None:
    truth = of_vicon(shared_data, FILES[2], smoothing=False)
    assert truth.stamps[[0, -1]] == pytest.approx([694 / 120.0, 1016 / 120.0])

"""Reduced curves of angles keep their extremes, and show unknown stretches."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.kinematics.labels import label_of
from body_tracking.viewing.curves import BAND, WIDEST, AngleHistory, extremes, first_choice, heading_of
from draws import draws

NAMES = ("elbow_flexion_left", "trunk_axial")
STEP_NS = NANOSECONDS // 60


def filled(count: int, window: float = 1000.0, stddev: float = 0.01) -> AngleHistory:
    history = AngleHistory(window)
    for k in range(count):
        history.add(k * STEP_NS, NAMES, np.array([np.sin(0.1 * k), 0.5]), np.full(2, stddev))
    return history


def test_a_bag_that_is_continued_at_another_place_begins_new_curves() -> None:
    history = filled(10)
    history.add(500 * STEP_NS, NAMES, np.zeros(2), np.full(2, 0.01), STEP_NS)
    assert len(history) == 1


def test_over_a_gap_the_angles_are_unknown() -> None:
    history = filled(10)
    history.add(500 * STEP_NS, NAMES, np.zeros(2), np.full(2, 0.01), 490 * STEP_NS)
    curve = history.curve(NAMES[0], 200)
    assert curve is not None and len(curve.times) == 13
    np.testing.assert_allclose(curve.high[10:12] - curve.values[10:12], WIDEST)
    assert curve.values[11] == curve.values[9]


# --- decimation


@given(st.integers(0, 2**32 - 1), st.integers(1, 3), st.integers(1, 400), st.integers(8, 60), st.booleans())
@settings(max_examples=draws(12, 60))
def test_of_many_samples_the_extremes_and_the_ends_are_kept(seed: int, k: int, n: int, count: int, ties: bool) -> None:
    series = np.random.default_rng(seed).normal(scale=2.0, size=(k, n))
    series = np.round(series) if ties else series
    kept = extremes(series, count)
    assert len(kept) <= count
    assert (np.diff(kept) > 0).all()
    assert kept[0] == 0 and kept[-1] == n - 1
    assert (series[:, kept].max(axis=1) == series.max(axis=1)).all()
    assert (series[:, kept].min(axis=1) == series.min(axis=1)).all()
    if n <= count:
        assert len(kept) == n


# --- the band


def test_the_band_has_95_percent_of_a_normal_distribution() -> None:
    curve = filled(50, stddev=0.02).curve(NAMES[0], 200)
    assert curve is not None
    assert curve.high - curve.values == pytest.approx(np.degrees(BAND * 0.02))
    assert curve.values - curve.low == pytest.approx(np.degrees(BAND * 0.02))
    samples = np.random.default_rng(0).normal(size=100_000)
    assert (np.abs(samples) < BAND).mean() == pytest.approx(0.95, abs=0.003)


def test_unobserved_angles_have_a_wide_band_and_no_invented_value() -> None:
    history = filled(10)
    history.add(10 * STEP_NS, NAMES, np.array([0.3, 0.5]), np.array([np.inf, 0.01]))
    history.add(11 * STEP_NS, NAMES, np.array([np.nan, 0.5]), np.array([np.nan, 0.01]))
    curve = history.curve(NAMES[0], 200)
    assert curve is not None
    assert np.isfinite([curve.values, curve.low, curve.high]).all()
    assert curve.values[-1] == curve.values[-2] == pytest.approx(np.degrees(0.3))
    assert curve.high[-2:] - curve.low[-2:] == pytest.approx(2 * WIDEST)
    assert curve.latest_stddev == np.inf
    other = history.curve(NAMES[1], 200)
    assert other is not None and other.latest_stddev == pytest.approx(np.degrees(0.01))
    assert curve.latest() == "17.2° ± ?"
    assert other.latest() == "28.6° ± 1.1°"


def test_a_band_that_spans_all_angles_is_not_given_as_a_number() -> None:
    for stddev, text in ((1.5, "17.2° ± 168.4°"), (1.7, "17.2° ± ?")):
        history = filled(10)
        history.add(10 * STEP_NS, NAMES, np.array([0.3, 0.5]), np.array([stddev, 0.01]))
        curve = history.curve(NAMES[0], 200)
        assert curve is not None and curve.latest() == text


@pytest.mark.parametrize(
    ("half", "text"), [(0.11, "17.2° ± 0.1°"), (0.03, "17.19° ± 0.03°"), (0.004, "17.189° ± 0.004°")]
)
def test_a_narrow_band_is_not_shown_as_zero(half: float, text: str) -> None:
    history = filled(10)
    history.add(10 * STEP_NS, NAMES, np.array([0.3, 0.5]), np.array([np.radians(half) / BAND, 0.01]))
    curve = history.curve(NAMES[0], 200)
    assert curve is not None and curve.latest() == text


# --- kept samples


def test_the_window_is_kept_and_the_newest_is_at_zero() -> None:
    curve = filled(600, window=2.0).curve(NAMES[0], 1000)
    assert curve is not None
    assert curve.times[-1] == 0.0
    assert curve.times[0] == pytest.approx(-2.0, abs=1e-6)
    assert (np.diff(curve.times) > 0).all()


def test_more_messages_than_there_is_room_for_push_the_oldest_out() -> None:
    history = AngleHistory(1e6, capacity=100)
    for k in range(1000):
        history.add(k * STEP_NS, NAMES, np.array([float(k), 0.0]), np.zeros(2))
    assert len(history) == 100
    curve = history.curve(NAMES[0], 1000)
    assert curve is not None
    assert np.radians(curve.values) == pytest.approx(np.arange(900, 1000))


def test_late_ones_are_left_out_and_a_jump_back_or_other_names_start_anew() -> None:
    history = filled(100)
    history.add(98 * STEP_NS, NAMES, np.zeros(2), np.zeros(2))
    assert len(history) == 100
    history.add(-2 * NANOSECONDS, NAMES, np.zeros(2), np.zeros(2))
    assert len(history) == 1
    history.add(NANOSECONDS, ("waist",), np.zeros(1), np.zeros(1))
    assert (len(history), history.names) == (1, ("waist",))
    assert history.curve(NAMES[0], 100) is None


def test_an_angle_that_no_longer_comes_is_shown_with_its_age() -> None:
    """Its value would pass for the present one after the sensors have stopped."""
    history = AngleHistory(10.0)
    history.add(5, ("a",), np.radians([17.2]), np.radians([1.0]), steady_ns=7 * NANOSECONDS)
    curve = history.curve("a", 100)
    assert curve is not None and history.age(9 * NANOSECONDS) == pytest.approx(2.0)
    assert curve.latest(1.9) == curve.latest() == "17.2° ± 2.0°"
    assert curve.latest(history.age(29 * NANOSECONDS)) == "17.2°, 22 s ago"


def test_an_angle_of_which_nothing_is_known_yet_has_no_curve() -> None:
    history = AngleHistory(10.0)
    assert history.curve(NAMES[0], 100) is None
    history.add(0, NAMES, np.array([np.nan, 0.0]), np.array([np.inf, 0.1]))
    assert history.curve(NAMES[0], 100) is None
    assert history.curve(NAMES[1], 100) is not None


def test_elbows_come_first_where_there_are_any() -> None:
    names = ("lumbar_flexion", "shoulder_flexion_left", "elbow_flexion_left", "elbow_flexion_right")
    assert first_choice(names, 2) == ("elbow_flexion_left", "elbow_flexion_right")
    assert set(first_choice(names, 9)) == set(names)
    assert first_choice((), 3) == ()


@pytest.mark.parametrize("convention", [each for each in ALL_CONVENTIONS if each != "dh26"])
def test_each_elbow_and_each_shoulder_has_a_plot(convention: str) -> None:
    chosen = first_choice(angle_names(convention), 4)
    assert heading_of(chosen) == "elbows and shoulders"
    sides = {"left": 0, "right": 0}
    for name in chosen:
        sides[label_of(name).partition(" ")[0]] += 1
    assert sides == {"left": 2, "right": 2}


def test_in_the_t_pose_the_shoulders_show_an_angle_that_is_known() -> None:
    unknown = ("shoulder_flexion", "shoulder_rotation", "forearm_pronation")
    names = [name for name in angle_names("model") if not name.startswith(unknown)]
    assert first_choice(names, 4)[2:] == ("shoulder_abduction_left", "shoulder_abduction_right")
    one = [name for name in names if name != "shoulder_abduction_left"]
    assert first_choice(one, 4)[2:] == ("shoulder_abduction_right", "trunk_flexion")
    assert heading_of(first_choice(one, 4)) == "elbows, shoulders and trunk"
    assert "clavicle" not in " ".join(first_choice(one, 12))


def test_other_angles_are_headed_as_what_they_are() -> None:
    assert heading_of(first_choice(angle_names("dh26"), 4)) == "trunk"
    assert heading_of(("clavicle_protraction_left", "elbow_flexion_right")) == "clavicles and elbows"
    assert heading_of(("speed",)) == "other angles"
    assert heading_of(()) == ""


def test_only_angles_with_a_value_and_a_finite_deviation_are_known() -> None:
    history = AngleHistory(10.0)
    assert history.known() == ()
    history.add(0, ("a", "b", "c"), np.array([0.1, np.nan, 0.2]), np.array([0.1, 0.1, 0.6]))
    assert history.known() == ("a",)
    history.add(STEP_NS, ("a", "b", "c"), np.array([np.nan, 0.1, 0.2]), np.array([0.1, 0.1, np.inf]))
    assert history.known() == ("a", "b")

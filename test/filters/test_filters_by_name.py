"""Filters by name: parameters, the handling of stamps, and the times at which predictions are due."""

from __future__ import annotations

import copy
import subprocess
import sys
from dataclasses import fields, replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.measurement import BASE_STDDEV
from body_tracking.core.parameters import check_all, fields_of, parameters_from
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, Skeleton
from body_tracking.filters import (
    DEFAULT_FILTER,
    FILTERS,
    ModelFilter,
    SkeletonFilter,
    make_filter,
    parameter_classes,
    parameter_prefix,
)
from body_tracking.filters.linear import LINEAR_MODELS
from body_tracking.filters.parameters import FilterError
from body_tracking.filters.prediction import PERIOD_NS, Prediction
from draws import draws
from patience import PATIENCE
from walkers import TRACKED, performed


def test_every_filter_is_made_with_the_parameters_of_its_own_prefix() -> None:
    assert set(FILTERS) == {*LINEAR_MODELS, "ekf", "thesis_lkf1", "thesis_lkf2", "schlagenhauf_ekf"}
    assert DEFAULT_FILTER in FILTERS
    table = [item for prefix, each in parameter_classes().items() for item in parameters_from(each, prefix=prefix)]
    assert len({item.name for item in table}) == len(table)
    values = check_all(table, {"ekf.velocity_time": 2, "schlagenhauf_ekf.calibration_frames": 7, "predict_for": 0.4})
    settings = {}
    for name in FILTERS:
        prefix = parameter_prefix(name)
        settings[name] = fields_of(parameter_classes()[prefix], values, prefix=prefix)
        assert make_filter(name, **settings[name]).counters["frames"] == 0
    assert settings["ekf"]["velocity_time"] == 2.0
    assert settings["ekf"]["predict_for"] != settings[DEFAULT_FILTER]["predict_for"] == 0.4
    assert settings["schlagenhauf_ekf"]["calibration_frames"] == 7


def test_only_the_ekf_is_a_model_filter() -> None:
    assert [name for name in FILTERS if isinstance(make_filter(name), ModelFilter)] == ["ekf"]


@pytest.mark.parametrize("name", FILTERS)
def test_another_filters_parameter_is_refused(name: str) -> None:
    with pytest.raises(BodyTrackingError, match=f"filter {name}: unknown parameter"):
        make_filter(name, no_such_thing=1.0)
    with pytest.raises(BodyTrackingError, match=f"unknown filter '{name}g'"):
        make_filter(f"{name}g")


@pytest.mark.parametrize(
    ("parameters", "name"),
    [(each, item.name) for each in parameter_classes().values() for item in fields(each) if "min" in item.metadata],
)
def test_parameters_out_of_range_are_refused(parameters: type, name: str) -> None:
    item = next(each for each in fields(parameters) if each.name == name)
    low, high = item.metadata["min"], item.metadata["max"]
    assert low <= item.default <= high and item.metadata["doc"]
    for bad in (low - 1e-6 * max(1.0, abs(low)), 1.000001 * high, np.nan, np.inf, True, "1", None):
        with pytest.raises(FilterError, match=name):
            parameters(**{name: bad})
    for good in (low, high):
        parameters(**{name: good})


def test_the_names_alone_cost_no_scipy() -> None:
    """Every node reads the table of the graph, and should start soon."""
    code = "import sys, body_tracking.pipeline.graph; assert not {'scipy.stats', 'filterpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=PATIENCE)


# --- stamps

STATED = BASE_STDDEV[:, None, None] ** 2 * np.eye(3)
FRAMES = [
    Skeleton(
        100 * NANOSECONDS + k * NANOSECONDS // 30,
        "world",
        positions,
        TRACKED,
        0,
        STATED,
    )
    for k, positions in enumerate(performed("two_handed_wave")[:60])
]
"""A T-pose of two seconds, which the thesis's extended filter starts from, and from which others learn offsets."""


DISPLACED = np.random.default_rng(1).normal(0.0, 0.01, (N_JOINTS, 3))


@cache
def begun(name: str, learning: bool) -> SkeletonFilter:
    """A filter after another person, whose joints are elsewhere: offsets that it has learnt may not remain; to copy."""
    tested = make_filter(name, **settings_of(name, learning))
    for each in FRAMES:
        tested.update(replace(each, positions=each.positions + DISPLACED))
    return tested


def settings_of(name: str, learning: bool) -> dict[str, bool]:
    return {} if learning or name not in LINEAR_MODELS else {"t_pose": False}


def assert_alike(one: Skeleton | None, other: Skeleton | None) -> None:
    assert (one is None) == (other is None)
    if one is not None and other is not None:
        assert (one.stamp_ns, one.frame_id) == (other.stamp_ns, other.frame_id)
        assert_allclose(one.positions, other.positions, rtol=0.0, atol=1e-12)
        assert_allclose(one.covariances, other.covariances, rtol=0.0, atol=1e-12)
        np.testing.assert_array_equal(one.states, other.states)


ANEW = {"backward_jumps": (-50, "world"), "frame_changes": (2, "map"), "gaps": (50, "world"), "reset": (5, "world")}
"""By counter: seconds by which the frames after such an event are later, and their frame of reference."""


@pytest.mark.parametrize(
    ("name", "cause"), [(name, cause) for name in FILTERS for cause in ANEW if cause != "gaps" or name in LINEAR_MODELS]
)
def test_a_restarted_filter_equals_a_new_one(name: str, cause: str) -> None:
    later, frame_id = ANEW[cause]
    # after a gap it is still the same person, whose joints are where a T-pose has shown them
    learning = cause != "gaps"
    tested, fresh = copy.deepcopy(begun(name, learning)), make_filter(name, **settings_of(name, learning))
    assert tested.counters.get("t_poses", 1) == learning
    counted = dict(tested.counters)
    if cause == "reset":
        tested.reset()
        assert tested.counters | {"t_poses_forgotten": 0} == counted | {"t_poses_forgotten": 0}
    for each in FRAMES[: draws(20, 45)]:
        moved = replace(each, stamp_ns=each.stamp_ns + later * NANOSECONDS, frame_id=frame_id)
        assert_alike(tested.update(moved), fresh.update(moved))
    expected = {key: int(key == cause) for key in ("backward_jumps", "frame_changes", "gaps")}
    assert {key: tested.counters[key] - counted[key] for key in expected} == expected


@pytest.mark.parametrize("name", FILTERS)
def test_repeated_and_late_frames_are_ignored_and_outputs_do_not_change(name: str) -> None:
    once, twice = make_filter(name), make_filter(name)
    handed_out = []
    for each in FRAMES:
        found = once.update(each)
        assert_alike(twice.update(each), found)
        handed_out += [] if found is None else [(found, found.positions.copy())]
        assert twice.update(replace(each, positions=each.positions + 1.0)) is None
    assert twice.counters["repeated_stamps"] == len(FRAMES)
    assert twice.update(replace(FRAMES[-2], positions=FRAMES[-2].positions + 1.0)) is None
    assert twice.counters["late_frames"] == (name != "ekf")  # which has taken that frame
    following = replace(FRAMES[-1], stamp_ns=FRAMES[-1].stamp_ns + NANOSECONDS // 30)
    assert_alike(twice.update(following), once.update(following))
    for found, positions in handed_out:
        np.testing.assert_array_equal(found.positions, positions)


@pytest.mark.parametrize("name", FILTERS)
def test_frames_without_a_joint_give_no_output(name: str) -> None:
    tested, nowhere = make_filter(name), np.full((N_JOINTS, 3), np.nan)
    for each in FRAMES[:30]:
        assert tested.update(replace(each, positions=nowhere, states=np.zeros_like(TRACKED))) is None


# --- prediction


def test_predictions_follow_a_silence_with_the_stamps_of_frames_that_did_not_come() -> None:
    prediction = Prediction(0.1)
    assert prediction.due(10**12) is None
    stamp, now = 5_000_000_000, 7_000_000_000
    prediction.arrived(stamp, now)
    assert prediction.due(now + 99_999_999) is None
    # a late caller gets the same stamps as one in time
    asked = now + 200_000_000
    found = []
    while (due := prediction.due(asked)) is not None:
        found.append(due)
    assert found == [stamp + 100_000_000 + k * PERIOD_NS for k in range(4)]
    prediction.arrived(stamp + 190_000_000, asked)
    assert prediction.due(asked + 1) is None
    prediction.stop()
    assert prediction.due(asked + 10**10) is None

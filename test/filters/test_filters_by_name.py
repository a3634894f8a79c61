"""Filters by their names, with their parameters; and when a prediction is due."""

from __future__ import annotations

import subprocess
import sys

import pytest

from body_tracking.errors import BodyTrackingError
from body_tracking.filters import (
    DEFAULT_FILTER,
    FILTERS,
    ModelFilter,
    make_filter,
    parameter_classes,
    parameter_prefix,
)
from body_tracking.filters.linear import LINEAR_MODELS
from body_tracking.filters.prediction import PERIOD_NS, Prediction
from body_tracking.parameters import check_all, fields_of, parameters_from


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


def test_who_models_the_body_says_so() -> None:
    assert [name for name in FILTERS if isinstance(make_filter(name), ModelFilter)] == ["ekf"]


@pytest.mark.parametrize("name", FILTERS)
def test_another_filters_parameter_is_refused(name: str) -> None:
    with pytest.raises(BodyTrackingError, match=f"filter {name}: unknown parameter"):
        make_filter(name, no_such_thing=1.0)


def test_the_names_alone_cost_no_scipy() -> None:
    """Every node reads the table of the graph, and should start soon."""
    code = "import sys, body_tracking.graph; assert not {'scipy.stats', 'filterpy'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)


# --- prediction


def test_predictions_follow_a_silence_with_the_stamps_of_frames_that_did_not_come() -> None:
    prediction = Prediction(0.1)
    assert prediction.due(10**12) is None
    stamp, now = 5_000_000_000, 7_000_000_000
    prediction.arrived(stamp, now)
    assert prediction.due(now + 99_999_999) is None
    # Whoever asks late gets all that was due, as if he had asked in time.
    asked = now + 200_000_000
    found = []
    while (due := prediction.due(asked)) is not None:
        found.append(due)
    assert found == [stamp + 100_000_000 + k * PERIOD_NS for k in range(4)]
    prediction.arrived(stamp + 190_000_000, asked)
    assert prediction.due(asked + 1) is None
    prediction.stop()
    assert prediction.due(asked + 10**10) is None

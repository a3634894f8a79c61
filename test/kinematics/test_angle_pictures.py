"""The drawings of the angles (``docs/pictures.py``) show the sense in which each angle grows."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from body_tracking.kinematics.conventions import angle_names

ROOT = Path(__file__).resolve().parent.parent.parent
BY = 0.2


@pytest.fixture(scope="module")
def pictures() -> Any:
    spec = importlib.util.spec_from_file_location("angle_pictures", ROOT / "docs" / "pictures.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def check(pictures: Any, convention: str, name: str) -> None:
    """The drawn angle grows by the requested amount, and no other joint moves."""
    before = pictures.start(name)
    after = pictures.moved(before, name, convention, BY)
    change = pictures.angles(after, convention) - pictures.angles(before, convention)
    change = (change + np.pi) % (2 * np.pi) - np.pi
    names = angle_names(convention)
    assert change[names.index(name)] == pytest.approx(BY, abs=0.01), name
    if not name.startswith("trunk") and convention != "positional":
        others = np.array([n != name and not n.startswith("trunk") for n in names])
        assert np.abs(change[others & np.isfinite(change)]).max() < 0.02, name


@pytest.mark.parametrize("name", ["neck_flexion", "elbow_flexion_left"])
def test_a_drawn_angle_grows_alone(pictures: Any, name: str) -> None:
    check(pictures, "model", name)


@pytest.mark.slow
@pytest.mark.parametrize("convention", ["model", "isb", "positional", "rep155", "dh26"])
def test_every_drawn_angle_grows_alone(pictures: Any, convention: str) -> None:
    names = pictures.drawn(convention)
    left_out = {"y_head", "theta9", "theta16", *(f"theta{n}" for n in (10, 11, 12, *range(20, 27)))}
    others = ("_right", "r_y_shoulder", "r_p_shoulder", "r_r_shoulder", "r_elbow")
    assert all(name in names or name.endswith(others) or name in left_out for name in angle_names(convention))
    for name in names:
        check(pictures, convention, name)

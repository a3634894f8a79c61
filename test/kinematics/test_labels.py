"""Every angle of every convention has a label of its own, and a limb."""

from __future__ import annotations

import pytest

from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.kinematics.labels import LIMBS, OTHER, by_limb, label_of, limb_of


@pytest.mark.parametrize("convention", ALL_CONVENTIONS)
def test_labels_are_different_and_every_angle_has_a_limb(convention: str) -> None:
    names = angle_names(convention)
    assert len({label_of(name) for name in names}) == len(names)
    limbs = by_limb(names)
    assert set(limbs) == set(LIMBS[:3])
    assert len(limbs["left arm"]) == len(limbs["right arm"])
    assert sorted(name for own in limbs.values() for name in own) == sorted(names)


@pytest.mark.parametrize(
    ("name", "label", "limb"),
    [
        ("elbow_flexion_left", "left elbow flexion", "left arm"),
        ("l_p_shoulder", "left shoulder pitch", "left arm"),
        ("r_elbow", "right elbow", "right arm"),
        ("r_head", "head roll", "trunk and head"),
        ("thorax_axial_left", "thorax axial left", "trunk and head"),
        ("theta12", "theta12", "right arm"),
        ("knee_flexion_right", "right knee flexion", "right leg"),
        ("gripper", "gripper", OTHER),
    ],
)
def test_names_become_words(name: str, label: str, limb: str) -> None:
    assert (label_of(name), limb_of(name)) == (label, limb)

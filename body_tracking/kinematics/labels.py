"""Readable labels of joint angles, and the limb of each, from their names in any convention."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Final

LIMBS: Final = ("left arm", "right arm", "trunk and head", "left leg", "right leg")
"""The limbs, in the order in which they are listed; angles of other names are in :data:`OTHER`."""
UNKNOWN: Final = 30.0
"""Standard deviation of an angle, degrees, from which it counts as unknown: the 95 % band is 60 degrees to each side,
as wide as that of the priors of most angles. Chosen on the shipped recordings."""
OTHER: Final = "other angles"

_SIDES: Final = {"l": "left", "r": "right"}
_AXES: Final = {"r": "roll", "p": "pitch", "y": "yaw"}
_HUMANOID: Final = re.compile(r"([lr])_(?:([rpy])_)?([a-z]+)")
"""REP-155, as in ``l_p_shoulder``."""
_HEAD: Final = re.compile(r"([rpy])_(head)")
_THETA: Final = re.compile(r"theta(\d+)")
"""Schlagenhauf (2017), tables 3.1 and 3.2."""
_LEGS: Final = ("hip", "knee", "ankle", "foot")
_ARMS: Final = ("clavicle", "shoulder", "humeral", "elbow", "wrist", "hand", "forearm")
_MIDDLE: Final = ("trunk", "lumbar", "thora", "neck", "head", "waist", "pelvis", "spine")


def label_of(name: str) -> str:
    """The angle in words: ``left elbow flexion``, ``left shoulder pitch``."""
    if match := _HEAD.fullmatch(name):
        return f"{match[2]} {_AXES[match[1]]}"
    if match := _HUMANOID.fullmatch(name):
        return " ".join(filter(None, (_SIDES[match[1]], match[3], _AXES.get(match[2] or ""))))
    for side in _SIDES.values():
        if name.endswith(f"_{side}") and any(part in name for part in (*_ARMS, *_LEGS)):
            name = f"{side}_{name.removesuffix(f'_{side}')}"
    return name.replace("_", " ")


def limb_of(name: str) -> str:
    """One of :data:`LIMBS`, or :data:`OTHER`."""
    if match := _THETA.fullmatch(name):
        number = int(match[1])
        right = 10 <= number <= 12 or number >= 20
        return "trunk and head" if number <= 6 else "right arm" if right else "left arm"
    label = label_of(name)
    side = label.partition(" ")[0]
    if side in _SIDES.values():
        for limb, parts in (("leg", _LEGS), ("arm", _ARMS)):
            if any(part in label for part in parts):
                return f"{side} {limb}"
    return "trunk and head" if any(part in label for part in _MIDDLE) else OTHER


def by_limb(names: Iterable[str]) -> dict[str, tuple[str, ...]]:
    """The names of each limb that has any, in the order of :data:`LIMBS`, within a limb as given."""
    limbs = {name: limb_of(name) for name in names}
    found = {limb: tuple(name for name in limbs if limbs[name] == limb) for limb in (*LIMBS, OTHER)}
    return {limb: own for limb, own in found.items() if own}

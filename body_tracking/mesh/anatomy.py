"""Anatomical frames of the segments of a body model, and its angles and their ranges.

Every segment has a frame as in :mod:`body_tracking.kinematics.upper_body`: in the neutral-zero pose (upright, arms
hanging, thumbs forward) x is forward, y left and z up. A body model's rest pose is another one, a T or an A; the
frames at rest are columns in the model's axes (SMPL's: x left, y up, z forward).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from body_tracking.core.skeleton import FloatArray

SIDES: Final = ("left", "right")
UPRIGHT: Final[FloatArray] = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""Frame of an upright trunk: forward, left and up as columns in a model's axes."""
_STRAIGHT = np.radians(10.0)
"""An elbow at rest that bends less than this does not show its axis."""


def segment_frames(
    names: Sequence[str], joints: FloatArray, thumbs: Mapping[str, FloatArray] | None = None
) -> FloatArray:
    """Frames (J, 3, 3) of the segments at rest, as columns in the model's axes.

    Args:
        names: of the joints, SMPL's; a joint that is not known gets the frame of the trunk.
        joints: (J, 3) at rest.
        thumbs: per side, the direction (3,) from the little finger's to the index finger's knuckle at rest; forward
            where it is not given, as in SMPL's T-pose with palms down.
    """
    place = {name: joints[number] for number, name in enumerate(names)}
    frames = np.tile(UPRIGHT, (len(names), 1, 1))
    forward = UPRIGHT[:, 0]
    for side in SIDES:
        for bone, end in (("hip", "knee"), ("knee", "ankle")):
            along = place[f"{side}_{end}"] - place[f"{side}_{bone}"]
            frames[list(names).index(f"{side}_{bone}")] = _frame(-along, forward)
        upper = place[f"{side}_elbow"] - place[f"{side}_shoulder"]
        fore = place[f"{side}_wrist"] - place[f"{side}_elbow"]
        axis = np.cross(upper, fore)
        if np.linalg.norm(axis) < np.sin(_STRAIGHT) * np.linalg.norm(upper) * np.linalg.norm(fore):
            axis = np.cross(upper, forward)
        # flexion turns about -y, and x completes the frame
        frames[list(names).index(f"{side}_shoulder")] = _frame(-upper, np.cross(-axis, -upper))
        thumb = forward if thumbs is None else thumbs[side]
        for bone in ("elbow", "wrist"):
            frames[list(names).index(f"{side}_{bone}")] = _frame(-fore, thumb)
    return frames


def _frame(up: FloatArray, forward: FloatArray) -> FloatArray:
    """(3, 3) columns x, y, z: z along ``up``, x as near ``forward`` as possible."""
    z = up / np.linalg.norm(up)
    y = np.cross(z, forward)
    y /= np.linalg.norm(y)
    return np.column_stack([np.cross(y, z), y, z])

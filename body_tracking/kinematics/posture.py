"""Prior distribution of a person's pose.

Points do not determine how a bend divides between pelvis, lumbar and thoracic joints: the base of the spine and the
hips lie on one line, and the middle of the spine is seen through clothes. The prior divides it: all of these joints are
upright in an upright person, and a forward bend is shared in proportion to their variances.

Zero is the neutral standing pose of ``upper_body``. The standard deviations are of moving people, and are rounded:
publications give their order of magnitude, and those marked * were then adjusted (by at most a factor of 1.5) on the
three shipped recordings, which are simulated. Figures over these recordings are therefore no evidence for them.

- pelvic tilt*, lumbar and thoracic flexion*: between standing people pelvic tilt has a deviation of 7 deg (Mac-Thiong
  et al., Eur. Spine J. 20 Suppl. 5 (2011) 572, 709 people); a forward bend is at first twice as large in the lumbar
  spine as in the hips, and less later (Esola et al., Spine 21 (1996) 71), so that both get the same deviation
- the others: a share of the range to one side in :mod:`body_tracking.kinematics.ranges`, whose sources stand there; a
  third for lateral bending*, the neck and the wrist, half for axial rotations and the clavicle (chosen on 16 simulated
  and five real people, ``docs/tried.md``: a quarter drew raised arms down). Forearms turn by 50 deg either way in
  daily activities (Morrey et al., J. Bone Joint Surg. Am. 63 (1981) 872)
- elbows: uniform over their range, since no flexion is more usual than another
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import Linearisation
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.kinematics.ranges import Ranges
from body_tracking.kinematics.upper_body import UpperBody

STDDEV: dict[str, float] = {
    "lumbar_flexion": 10.0,
    "lumbar_lateral": 10.0,
    "lumbar_axial": 8.0,
    "thoracic_flexion": 8.0,
    "thoracic_lateral": 10.0,
    "thoracic_axial": 20.0,
    "neck_flexion": 20.0,
    "neck_lateral": 15.0,
    "clavicle_protraction": 16.0,
    "clavicle_elevation": 16.0,
    "shoulder_z": 55.0,
    "forearm_pronation": 45.0,
    "wrist_flexion": 26.0,
    "wrist_deviation": 12.0,
}
"""Degrees about zero."""

UNIFORM = ("elbow_flexion",)
"""Coordinates of which every value in the range is as usual."""

TILT_STDDEV = (10.0, 6.0)
"""Degrees: tilt of the pelvis against gravity, forward and sideways."""

_VERTICAL = 1e-9
"""Least horizontal part of the pelvis's left-right axis, for a pelvis that lies on its side."""


@dataclass(frozen=True, slots=True, eq=False)
class Tilt:
    """Tilt of the pelvis against gravity.

    Attributes:
        values: (2,) sines of the tilt forward and to the left.
        gradients: (2, 32) by the tangent.
    """

    values: FloatArray
    gradients: FloatArray


class PosturePrior:
    """Mean and standard deviation of each coordinate of ``upper_body`` after the base.

    Coordinates that are not in :data:`STDDEV` have the centre of their range of motion, and a sixth of its width; those
    of :data:`UNIFORM` have the deviation of a uniform distribution.

    Attributes:
        mean, stddev: (26,) radians, of ``SoftCoordinates``.
        postural: (26,) which of them are in :data:`STDDEV`.
        tilt_stddev: (2,) radians, of :class:`Tilt`.
    """

    def __init__(self, model: UpperBody, ranges: Ranges) -> None:
        names = [name.removesuffix("_left").removesuffix("_right") for name in model.coordinate_names[6:]]
        self.postural: BoolArray = np.array([name in STDDEV for name in names])
        postural = np.radians([STDDEV.get(name, 0.0) for name in names])
        self.mean: FloatArray = np.where(self.postural, 0.0, ranges.centre)
        uniform = np.array([name in UNIFORM for name in names])
        flat = (ranges.high - ranges.low) / math.sqrt(12.0)
        self.stddev: FloatArray = np.where(self.postural, postural, np.where(uniform, flat, ranges.stddev))
        self.tilt_stddev: FloatArray = np.radians(TILT_STDDEV)

    @staticmethod
    def tilt_of(rotation: FloatArray) -> FloatArray:
        """(..., 2) sines of the tilt of a pelvis forward and to the left, of its rotations (..., 3, 3)."""
        axes = _horizontal_axes(rotation)
        values: FloatArray = (axes @ rotation[..., :, 2:])[..., 0]
        return values

    @staticmethod
    def tilt(lines: Linearisation) -> Tilt:
        """The tilt of the pelvis at one configuration, with its derivative."""
        rotation, turning = lines.posture.rotations[0], lines.rotation_jacobian[0]
        axes = _horizontal_axes(rotation)
        forward, left = axes @ rotation[:, 2]
        gradients: FloatArray = axes @ so3.skew(-rotation[:, 2]) @ turning
        # both axes turn with the heading
        size = max(float(np.hypot(rotation[0, 1], rotation[1, 1])), _VERTICAL)
        heading = (-axes[0] / size) @ so3.skew(-rotation[:, 1]) @ turning
        gradients += np.outer([left, -forward], heading)
        return Tilt(np.array([forward, left]), gradients)


def _horizontal_axes(rotation: FloatArray) -> FloatArray:
    """(..., 2, 3) horizontal unit vectors forward and to the left of a pelvis of rotation (..., 3, 3)."""
    x, y = rotation[..., 0, 1], rotation[..., 1, 1]
    size = np.maximum(np.hypot(x, y), _VERTICAL)
    x, y, zero = x / size, y / size, np.zeros_like(x)
    return np.stack([np.stack([y, -x, zero], axis=-1), np.stack([x, y, zero], axis=-1)], axis=-2)

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

import numpy as np

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


class PosturePrior:
    """Mean and standard deviation of each coordinate of ``upper_body`` after the base.

    Coordinates that are not in :data:`STDDEV` have the centre of their range of motion, and a sixth of its width; those
    of :data:`UNIFORM` have the deviation of a uniform distribution.

    Attributes:
        mean, stddev: (26,) radians, of ``SoftCoordinates``.
        postural: (26,) which of them are in :data:`STDDEV`.
        tilt_stddev: (2,) radians: tilt of the pelvis against gravity, forward and to the left.
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

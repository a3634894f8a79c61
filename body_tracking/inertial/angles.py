"""ISB joint angles directly from the orientations of segments, without the body model.

The sequences are those of convention ``isb`` in ``kinematics.conventions``. Sensors measure three angles even where the
model's joint has two: the carrying angle of an elbow, the twist of a wrist. These third angles get their own names.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.inertial.alignment import AlignmentError
from body_tracking.kinematics.conventions import convention
from body_tracking.kinematics.upper_body import UpperBody

_THIRD_ANGLES = {"elbow": "elbow_carrying", "wrist": "wrist_twist", "clavicle": "clavicle_axial", "neck": "neck_axial"}
"""Name of a joint's third angle, by the first word of the names of its other angles."""
_KNOWN = np.pi / 10.0
"""Radians: an angle with a larger standard deviation gets an infinite one."""


class SegmentAngles:
    """Rotations of segments to ISB angles.

    Attributes:
        names: the angles of convention ``isb`` and the third angles of its joints with two.
    """

    def __init__(self, model: UpperBody) -> None:
        isb = convention("isb", model)
        # all its chains are between segments: one stage
        ((self._sequences, self._parents, self._children, rows),) = isb.stages
        isb_names = dict(zip((isb.rows - rows.start).tolist(), isb.names, strict=True))
        names = []
        for place in range(rows.stop - rows.start):
            if place in isb_names:
                names.append(isb_names[place])
                continue
            first = 3 * (place // 3)
            neighbour = next(isb_names[other] for other in range(first, first + 3) if other in isb_names)
            side = neighbour.rpartition("_")[2]
            word = _THIRD_ANGLES[neighbour.partition("_")[0]]
            names.append(f"{word}_{side}" if side in ("left", "right") else word)
        self.names = tuple(names)

    def __call__(
        self,
        stamp_ns: int,
        rotations: FloatArray,
        covariances: FloatArray | None = None,
        previous: JointAngles | None = None,
    ) -> JointAngles:
        """Angles at one instant.

        Args:
            stamp_ns: nanoseconds.
            rotations: (12, 3, 3) segments to world, in the order of ``UpperBody.segment_names``; NaN without sensor.
            covariances: (12, 3, 3) radians squared, each in its segment's own frame and independent of the others; None
                where nothing is known of them.
            previous: the angles before, which these continue.

        Returns:
            Angles in radians, their velocities NaN; NaN with an infinite deviation where a segment is missing.

        Raises:
            AlignmentError: rotations or covariances of another shape.
        """
        if rotations.shape != (12, 3, 3) or (covariances is not None and covariances.shape != (12, 3, 3)):
            raise AlignmentError(f"segment angles: rotations of shape {rotations.shape}, expected (12, 3, 3)")
        known: BoolArray = np.logical_and.reduce(np.isfinite(rotations.reshape(12, 9)), axis=1)
        whole = np.where(known[:, None, None], rotations, np.eye(3))
        own = np.zeros((12, 3, 3)) if covariances is None else np.where(known[:, None, None], covariances, 0.0)
        back = whole[self._parents].swapaxes(-1, -2)
        relative = back @ whole[self._children]
        # in the parent's frame: Q e_child - e_parent
        spread = relative @ own[self._children] @ relative.swapaxes(-1, -2) + own[self._parents]
        before = None
        if previous is not None and previous.names == self.names:
            before = np.where(np.isfinite(previous.position), previous.position, 0.0).reshape(-1, 3)
        split = self._sequences.split(relative, np.diagonal(spread, axis1=1, axis2=2), before)
        angles = split.angles.reshape(-1).copy()
        variance = np.einsum("cij,cjk,cik->ci", split.gradients, spread, split.gradients).reshape(-1)
        stddev = np.sqrt(np.maximum(variance, 0.0))
        stddev[stddev > _KNOWN] = np.inf
        if covariances is None:
            stddev[:] = np.inf
        missing = np.repeat(~(known[self._parents] & known[self._children]), 3)
        angles[missing], stddev[missing] = np.nan, np.inf
        unknown = np.full(len(angles), np.nan)
        return JointAngles(stamp_ns, self.names, angles, unknown, stddev, np.full(len(angles), np.inf))

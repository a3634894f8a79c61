"""A person of rigid segments: joint angles in, the positions of the 25 joints out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.skeleton import N_JOINTS, FloatArray, Joint


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Angles over n instants, radians; the conventions are those of ``kinematics.positional``.

    Attributes:
        trunk: (n, 3) flexion, lateral lean to the right, axial turn to the left of the chest against the pelvis.
        plane: (n, 2) plane of elevation of the left and the right arm.
        elevation: (n, 2) elevation.
        rotation: (n, 2) humeral rotation.
        elbow: (n, 2) elbow flexion.
        sway: (n, 3) metres by which the whole body is off its place.
    """

    trunk: FloatArray
    plane: FloatArray
    elevation: FloatArray
    rotation: FloatArray
    elbow: FloatArray
    sway: FloatArray


@dataclass(frozen=True, slots=True)
class Figure:
    """Segment lengths as fractions of the stature (Drillis and Contini 1966, in Winter 2009, figure 4.1).

    Widths are those of the joint centres that Kinect shows, narrower than the bony landmarks.

    Attributes:
        stature: metres.
    """

    stature: float = 1.75

    UPPER_ARM = 0.186
    FOREARM = 0.146
    HAND = 0.054
    HAND_TIP = 0.100
    THUMB = 0.035
    THIGH = 0.245
    SHANK = 0.246
    ANKLE_HEIGHT = 0.039
    FOOT = 0.090
    HIP_HALF_WIDTH = 0.046
    HIP_DROP = 0.018
    SHOULDER_HALF_WIDTH = 0.103
    SHOULDER_DROP = 0.017
    TRUNK = 0.288
    SPINE_MID = 0.140
    NECK = 0.040
    HEAD = 0.105

    def positions(self, pose: Pose) -> FloatArray:
        """The joints in the body's own frame: x forward, y left, z up, the origin on the floor between the ankles.

        Args:
            pose: n instants.

        Returns:
            (n, 25, 3) metres.
        """
        count = len(pose.trunk)
        joints = np.zeros((N_JOINTS, count, 3))
        chest = Rotation.from_euler("YXZ", pose.trunk)
        waist = Rotation.from_rotvec(0.5 * chest.as_rotvec())

        hip_height = self.ANKLE_HEIGHT + self.SHANK + self.THIGH
        base = pose.sway / self.stature + [0.0, 0.0, hip_height + self.HIP_DROP]
        joints[Joint.SPINE_BASE] = base
        joints[Joint.SPINE_MID] = base + waist.apply([0.0, 0.0, self.SPINE_MID])
        top = joints[Joint.SPINE_MID] + chest.apply([0.0, 0.0, self.TRUNK - self.SPINE_MID])
        joints[Joint.SPINE_SHOULDER] = top
        joints[Joint.NECK] = top + chest.apply([0.0, 0.0, self.NECK])
        joints[Joint.HEAD] = top + chest.apply([0.0, 0.0, self.HEAD])
        for column, (side, sign) in enumerate((("LEFT", 1.0), ("RIGHT", -1.0))):
            hip = base + np.array([0.0, sign * self.HIP_HALF_WIDTH, -self.HIP_DROP])
            joints[Joint[f"HIP_{side}"]] = hip
            joints[Joint[f"KNEE_{side}"]] = hip - [0.0, 0.0, self.THIGH]
            ankle = hip - [0.0, 0.0, self.THIGH + self.SHANK]
            joints[Joint[f"ANKLE_{side}"]] = ankle
            joints[Joint[f"FOOT_{side}"]] = ankle + np.array([self.FOOT, 0.0, -0.6 * self.ANKLE_HEIGHT])

            shoulder = top + chest.apply([0.0, sign * self.SHOULDER_HALF_WIDTH, -self.SHOULDER_DROP])
            upper, forearm, thumb = (chest.apply(part) for part in _arm(pose, column, sign))
            joints[Joint[f"SHOULDER_{side}"]] = shoulder
            joints[Joint[f"ELBOW_{side}"]] = shoulder + self.UPPER_ARM * upper
            wrist = joints[Joint[f"ELBOW_{side}"]] + self.FOREARM * forearm
            joints[Joint[f"WRIST_{side}"]] = wrist
            joints[Joint[f"HAND_{side}"]] = wrist + self.HAND * forearm
            joints[Joint[f"HAND_TIP_{side}"]] = wrist + self.HAND_TIP * forearm
            joints[Joint[f"THUMB_{side}"]] = wrist + self.HAND * forearm + self.THUMB * thumb
        result: FloatArray = self.stature * joints.swapaxes(0, 1)
        return result


def _arm(pose: Pose, column: int, sign: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """(n, 3) unit vectors along upper arm, forearm and thumb in the chest's frame."""
    plane, elevation, rotation, elbow = (
        angle[:, column, None] for angle in (pose.plane, pose.elevation, pose.rotation, pose.elbow)
    )
    up, forward, outward = np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]), np.array([0.0, sign, 0.0])
    horizontal = np.cos(plane) * outward + np.sin(plane) * forward
    front = np.cos(plane) * forward - np.sin(plane) * outward
    upper = -np.cos(elevation) * up + np.sin(elevation) * horizontal
    rise = np.sin(elevation) * up + np.cos(elevation) * horizontal
    across = np.cos(rotation) * front - np.sin(rotation) * rise
    forearm = np.cos(elbow) * upper + np.sin(elbow) * across
    thumb = np.cos(elbow) * across - np.sin(elbow) * upper
    return upper, forearm, thumb

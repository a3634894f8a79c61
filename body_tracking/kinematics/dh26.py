"""The 26 angles of Schlagenhauf (2017), tables 3.1 and 3.2, for the posture of ``upper_body``.

The joints' axes are those of the T-pose with palms down, where all angles are zero (signs as in
``kinematics.schlagenhauf26``). In her model these angles give the directions of all its bones against the pelvis. Her
model differs from ours in three points:

- Her clavicles have a third angle, theta9 and theta12, about their own axis, which is redundant with the shoulder's
  three angles. It is set to zero; the shoulder's angles are against the clavicle without it.
- theta16 and theta23, "pronation", turn about the upper arm's axis, as theta15 and theta22 do: redundant, set to zero.
- Her forearm has no axial rotation. The wrist's two angles are against the forearm without our pronation: they give the
  direction of the hand, not its axial rotation.

An angle that is set to zero has an infinite standard deviation, because it is unobservable.
"""

from __future__ import annotations

import numpy as np

from body_tracking.core import so3
from body_tracking.kinematics.conventions import Chain, Convention, Frame
from body_tracking.kinematics.euler import EulerAngles
from body_tracking.kinematics.ranges import RANGES
from body_tracking.kinematics.upper_body import UpperBody

_X, _Y, _Z = np.eye(3)
_TRUNK_USUAL = ((-80.0, 80.0), (-80.0, 80.0), (-80.0, 80.0))


def _theta(*numbers: int) -> tuple[str, ...]:
    return tuple(f"theta{number}" for number in numbers)


def _three(first: int) -> tuple[str, str, str]:
    return (f"theta{first}", f"theta{first + 1}", f"theta{first + 2}")


def dh26(model: UpperBody) -> Convention:
    """The convention; her axes x (left), y (backward), z (up) are our y, -x, z.

    Tables 3.1 and 3.2 decide: the names in table 3.4 contradict them in the torso, where theta1 is axial, theta2
    flexion, theta3 lateral; theta4 lateral, theta5 axial, theta6 flexion.
    """
    left, back, up = _Y, -_X, _Z
    chains = [
        Chain(_three(1), "pelvis", "lower_trunk", EulerAngles((up, left, back), _TRUNK_USUAL)),
        Chain(_three(4), "lower_trunk", "upper_trunk", EulerAngles((back, up, left), _TRUNK_USUAL)),
    ]
    frames, later = [], []
    # first angle of the clavicle and of the arm, and the sense in which raising the arm to the T-pose turns about x
    for side, clavicle, arm, out in (("left", 7, 13, 1.0), ("right", 10, 20, -1.0)):
        low, high = RANGES["elbow_flexion"]
        # theta17 extends the left elbow, theta24 flexes the right one
        elbow = (-high, -low) if side == "left" else (low, high)
        down = (-90.0, 120.0) if side == "left" else (-120.0, 90.0)
        frames += [Frame(f"her_clavicle_{side}", len(chains), 2), Frame(f"her_forearm_{side}", len(chains) + 1, 1)]
        names = _theta(clavicle, clavicle + 1)
        chains += [
            Chain(
                (names[0], names[1], None),
                "upper_trunk",
                f"clavicle_{side}",
                EulerAngles((back, up, left), _TRUNK_USUAL),
                _theta(clavicle + 2),
            ),
            # her vertical axis in the frame of the hanging arm
            Chain(
                (f"theta{arm + 4}", None, None),
                f"upper_arm_{side}",
                f"forearm_{side}",
                EulerAngles((out * _Y, _X, _Z), (elbow, (-90.0, 90.0), (-90.0, 90.0))),
                _theta(arm + 3),
            ),
        ]
        later += [
            Chain(
                _three(arm),
                f"her_clavicle_{side}",
                f"upper_arm_{side}",
                EulerAngles(
                    (back, up, left),
                    (down, (-140.0, 140.0), (-150.0, 150.0)),
                    so3.quat_to_matrix(so3.exp(-0.5 * np.pi * out * _X)),
                ),
            ),
            Chain(
                (f"theta{arm + 5}", f"theta{arm + 6}", None),
                f"her_forearm_{side}",
                f"hand_{side}",
                EulerAngles((out * _Y, back, _Z), ((-90.0, 90.0), (-90.0, 90.0), (-180.0, 180.0))),
            ),
        ]
    return Convention(model, _theta(*range(1, 27)), chains, frames, later)

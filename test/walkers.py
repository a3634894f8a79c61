"""Performed motions, and a walking person, seen by sensors with or without noise.

The tests themselves add the errors that make calibration hard, one at a time.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState
from body_tracking.simulation.people import Person, joints
from body_tracking.simulation.repertoire import END_S, TPOSE_S, make_movement

TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)

OPTICAL_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Level axes (x forward, y left, z up) into optical ones (x right, y down, z forward)."""


PERSON = Person.average("male")
ABOUT_FACE = np.array([-1.0, -1.0, 1.0])
"""Rotation from the level axes of a person who faces the sensor into the sensor's axes."""


_WAVE_S = make_movement("two_handed_wave", PERSON).duration - TPOSE_S - END_S


def performed(motion: str, times: FloatArray | None = None) -> FloatArray:
    """The standard performance of a motion by an average man, in his own frame: x forward, the origin on the floor.

    Args:
        motion: one of ``repertoire.MOTIONS``.
        times: (n,) seconds; all of it, 30 times a second, where none are given.

    Returns:
        (n, 25, 3) metres.
    """
    movement = make_movement(motion, PERSON)
    return joints(PERSON, movement.course(np.arange(0.0, movement.duration, 1.0 / 30.0) if times is None else times))


def walk(times: FloatArray, still: float = 3.0) -> FloatArray:
    """A person in the optical frame of a level sensor: stands still, then wanders and turns within +-40 degrees.

    Args:
        times: (n,) seconds.
        still: seconds of standing.

    Returns:
        (n, 25, 3) metres.
    """
    moving = np.clip(times - still, 0.0, None)
    # from one T-pose to the other, again and again
    wave = performed("two_handed_wave", TPOSE_S + moving % _WAVE_S)
    figure = (wave - wave[:, :1]) * ABOUT_FACE
    ramp = np.clip(moving, 0.0, 1.0)
    heading = 0.7 * ramp * np.sin(0.9 * moving)
    place = np.stack(
        [
            2.5 + 0.6 * ramp * np.sin(0.7 * moving + 0.4 * np.sin(0.31 * moving)),
            0.7 * ramp * np.sin(0.53 * moving),
            0.02 * ramp * np.sin(5.0 * moving),
        ],
        axis=1,
    )
    turned = np.einsum("nij,nkj->nki", Rotation.from_euler("z", heading[:, None]).as_matrix(), figure)
    return (turned + place[:, None]) @ OPTICAL_FROM_LEVEL.T


def frame(stamp: float, positions: FloatArray, sensor: str = "kinect1", states: np.ndarray = TRACKED) -> Skeleton:
    """A skeleton of a sensor at a time of its own clock, seconds."""
    return Skeleton(round(stamp * NANOSECONDS), f"{sensor}_optical_frame", positions, states.copy())


def tracked(positions: FloatArray) -> Skeleton:
    """Joints (25, 3), all tracked, in ``world``."""
    return Skeleton(1, "world", positions, TRACKED.copy())


def degrees_between(rotation: FloatArray, other: FloatArray) -> float:
    """Angle between two rotation matrices."""
    return float(np.degrees(Rotation.from_matrix(rotation @ other.T).magnitude()))


def about_y(degrees: float) -> FloatArray:
    """Rotation about the optical y axis, which is vertical."""
    matrix: FloatArray = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return matrix

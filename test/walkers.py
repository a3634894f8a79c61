"""A person who walks about, seen by sensors without noise or with some: for tests of calibration and fusion.

The errors that make calibration hard are put in one at a time by the tests themselves.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from body_tracking.simulation.bags import true_positions
from body_tracking.simulation.motions import MOTIONS
from body_tracking.skeleton import N_JOINTS, NANOSECONDS, FloatArray, Skeleton, TrackingState

TRACKED = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)

OPTICAL_FROM_LEVEL = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Level axes (x forward, y left, z up) into optical ones (x right, y down, z forward)."""


def walk(times: FloatArray, still: float = 3.0) -> FloatArray:
    """A person in the optical frame of a level sensor: stands still, then wanders and turns within +-40 degrees.

    Args:
        times: (n,) seconds.
        still: seconds of standing.

    Returns:
        (n, 25, 3) metres.
    """
    moving = np.clip(times - still, 0.0, None)
    figure = true_positions(MOTIONS[0], 3.0 + moving % 10.0)
    # The simulated figure faces between its two sensors; this one faces its only one.
    figure = (figure - figure[:, :1]) @ Rotation.from_euler("z", -45, degrees=True).as_matrix().T
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


def about_y(degrees: float) -> FloatArray:
    """Rotation about the optical y axis, which is vertical."""
    matrix: FloatArray = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    return matrix

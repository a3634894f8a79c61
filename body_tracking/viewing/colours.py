"""Colours: one per sensor; Inferred joints are red, joints that are not tracked dark red.

As in Schlagenhauf (2017), section 5.9, figures 5.18-5.19.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.skeleton import TrackingState

Colour = tuple[int, int, int]
ColourArray = NDArray[np.uint8]

PALETTE: Final[tuple[Colour, ...]] = (
    (38, 108, 190),
    (240, 140, 20),
    (60, 155, 60),
    (130, 85, 165),
    (0, 160, 170),
    (150, 110, 70),
)
"""Colours of the sensors, in their order; none is red."""
FUSED: Final[Colour] = (120, 125, 130)
FILTERED: Final[Colour] = (25, 30, 40)
BODY: Final[Colour] = (196, 206, 220)
UNCERTAINTY: Final[Colour] = (120, 85, 200)
INFERRED: Final[Colour] = (235, 50, 40)
NOT_TRACKED: Final[Colour] = (150, 0, 0)


def sensor_colours(sensors: Sequence[str]) -> dict[str, Colour]:
    """A colour for each sensor; they repeat if there are more sensors than colours."""
    return {sensor: PALETTE[index % len(PALETTE)] for index, sensor in enumerate(sensors)}


def joint_colours(states: NDArray[np.uint8], own: Colour) -> ColourArray:
    """(n, 3) RGB of joints with (n,) ``TrackingState``; ``own`` is the colour of tracked joints.

    Schlagenhauf 2017, section 5.9, figures 5.18-5.19.
    """
    table = np.empty((len(TrackingState), 3), np.uint8)
    table[[TrackingState.NOT_TRACKED, TrackingState.INFERRED, TrackingState.TRACKED]] = NOT_TRACKED, INFERRED, own
    colours: ColourArray = table[states]
    return colours


def linear(colours: Colour | ColourArray) -> ColourArray:
    """(..., 3) intensities of sRGB colours (IEC 61966-2-1), as viser expects for batched meshes."""
    shares = np.asarray(colours, dtype=np.float64) / 255.0
    intensities = np.where(shares <= 0.04045, shares / 12.92, ((shares + 0.055) / 1.055) ** 2.4)
    return np.rint(255.0 * intensities).astype(np.uint8)

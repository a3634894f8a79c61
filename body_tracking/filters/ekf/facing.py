"""Frames with left and right swapped by a camera, detected by arms with measured orientations."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from body_tracking.core.body_model import Posture
from body_tracking.core.sides import headings_of, reversed_halves, swap_left_right
from body_tracking.core.skeleton import MIRROR, N_JOINTS, BoolArray, FloatArray, IntArray, Joint, Skeleton
from body_tracking.filters.ekf.state import State, StateSpace

_IMPROBABLE = 20.0
"""Squared normalised distance of the twists of both arms from the middle of their ranges (chi-square with 4 degrees of
freedom) that one of 2000 poses exceeds: beyond it, the filter's facing of the person is probably wrong."""
_TWISTS = ("shoulder_z", "forearm_pronation")
_LIMBS = {"upper_arm": ("SHOULDER", "ELBOW"), "forearm": ("ELBOW", "WRIST")}
_DIRECTION_STDDEV = 0.35
"""Radians: standard deviation of a limb's direction by a camera."""
_MOST, _DOUBTED = 1.0, 10.0
"""Log likelihood ratios: bound for one frame, as errors of successive frames are correlated, and threshold of their sum
beyond which the state is doubted."""


class Facing:
    """Swaps left and right of frames that contradict the state.

    A Kinect assumes that every body faces it, and swaps left and right of one that has turned away. A filter that has
    followed the turn detects the swap. With cameras alone its facing may be wrong from the start; a measured
    orientation of an arm shows this: the arms would be twisted beyond their ranges, or the measured arm points where
    the other one is seen.

    Args:
        space: of the states.
        counters: of the filter; counts ``sides_swapped``.
    """

    def __init__(self, space: StateSpace, counters: dict[str, int]) -> None:
        self._space, self._counters = space, counters
        self._twists: BoolArray = np.array([name.startswith(_TWISTS) for name in space.model.coordinate_names[6:]])
        self._ends = {
            number: tuple(Joint[f"{joint}_{side.upper()}"] for joint in _LIMBS[limb])
            for number, name in enumerate(space.model.segment_names)
            for limb, _, side in [name.rpartition("_")]
            if limb in _LIMBS
        }

    def corrected(self, state: State, skeleton: Skeleton) -> tuple[State, Skeleton]:
        """Swap left and right of a frame if the swapped frame is likelier.

        Args:
            state: of the frame's time.
            skeleton: in the state's frame of reference.

        Returns:
            The updated state and the frame. The frame is unchanged if both face the same way, no source is active, or
            the state is doubted; else left and right of the upper body, the lower body or both are swapped, or removed
            where their heading is across the state's.
        """
        active = state.sources.active(state.stamp_ns)
        if not active.any():
            return state, skeleton
        posture = self._space.model.forward(state.q, state.lengths)
        expected = np.full((N_JOINTS, 3), np.nan)
        expected[self._space.model.joints] = posture.positions
        halves = reversed_halves(headings_of(skeleton.positions), headings_of(expected))
        if not halves:
            return state, skeleton
        doubt = state.doubt + self._evidence(posture, state.sources.segments[active], skeleton)
        state = state.but(doubt=max(doubt, 0.0))
        if doubt > _DOUBTED or self._is_improbable(state):
            return state, skeleton
        self._counters["sides_swapped"] += 1
        points, states, factors = skeleton.positions.copy(), skeleton.states.copy(), np.ones(N_JOINTS)
        swap_left_right(halves, points, factors, states)
        states[np.isinf(factors)] = 0
        covariances = skeleton.covariances
        if covariances is not None:
            exchanged = np.isfinite(factors) & (factors != 1.0)
            covariances = covariances.copy()
            covariances[exchanged] = factors[exchanged, None, None] * covariances[MIRROR[exchanged]]
        return state, replace(skeleton, positions=points, states=states, covariances=covariances)

    def _evidence(self, posture: Posture, segments: IntArray, skeleton: Skeleton) -> float:
        """Log likelihood ratio of a frame as seen against swapped, from the limbs with measured orientations."""
        evidence = 0.0
        for number in segments.tolist():
            if number not in self._ends:
                continue
            axis = -posture.rotations[number, :, 2]
            start, end = self._ends[number]
            as_seen, exchanged = (
                _angle(axis, skeleton.positions[b] - skeleton.positions[a])
                for a, b in ((start, end), (MIRROR[start], MIRROR[end]))
            )
            if np.isfinite(as_seen + exchanged):
                evidence += (exchanged**2 - as_seen**2) / (2.0 * _DIRECTION_STDDEV**2)
        return float(np.clip(evidence, -_MOST, _MOST))

    def _is_improbable(self, state: State) -> bool:
        """Whether the arms are twisted so far that the state's facing is probably wrong."""
        ranges = self._space.ranges
        away = (ranges.values(state.q) - ranges.centre)[self._twists] / ranges.stddev[self._twists]
        return float(away @ away) > _IMPROBABLE


def _angle(axis: FloatArray, direction: FloatArray) -> float:
    """Radians between a unit vector and a direction of any length; NaN if the direction is."""
    return float(np.arctan2(np.linalg.norm(np.cross(axis, direction)), axis @ direction))

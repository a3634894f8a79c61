"""Selection of the pairs of frames to store: a bounded number, spread over the person's places and headings."""

from __future__ import annotations

import numpy as np

from body_tracking.calibration.pairwise import Pairs
from body_tracking.core.measurement import body_heading
from body_tracking.core.skeleton import N_JOINTS, FloatArray, IntArray, Joint

PLACE_SIZE = 0.3
"""Side of a place on the floor, metres."""

HEADINGS = 8
"""Sectors of the body's heading."""

_TRUNK: IntArray = np.array([Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER], dtype=np.intp)
"""The first of them that is known is at the place of a body."""


class Coverage:
    """Pairs of frames by place and heading of the body, the newest ``per_place`` of each.

    A minute of standing still must not outweigh a minute of walking, and memory must not grow with the session.
    """

    def __init__(self, per_place: int, capacity: int) -> None:
        self._per_place = per_place
        self._capacity = capacity
        self._count = 0
        self._key = np.zeros((capacity, 3), dtype=np.intp)
        self._order = np.zeros(capacity, dtype=np.intp)
        self._elapsed = np.zeros(capacity)
        self._points = np.zeros((capacity, 3, N_JOINTS, 3))
        self._variance = np.zeros((capacity, N_JOINTS))
        self._added = 0

    def __len__(self) -> int:
        return self._count

    def add(
        self, elapsed: float, reference: FloatArray, sensor: FloatArray, velocity: FloatArray, variance: FloatArray
    ) -> None:
        """Store one pair.

        Args:
            elapsed: seconds of reference time since the anchor of the clock.
            reference: (25, 3) metres, as in :class:`Pairs`.
            sensor: (25, 3) metres.
            velocity: (25, 3) metres per second, of ``sensor``.
            variance: (25,) square metres.
        """
        key = self._place(reference)
        slot = self._slot(key)
        self._key[slot] = key
        self._order[slot] = self._added
        self._elapsed[slot] = elapsed
        self._points[slot] = reference, sensor, velocity
        self._variance[slot] = variance
        self._added += 1

    def _place(self, reference: FloatArray) -> IntArray:
        """(3,) indices of place across the view, place along it, and sector of the heading; optical frame, y down."""
        trunk = reference[_TRUNK]
        centre, axis = trunk[int(np.isfinite(trunk[:, 0]).argmax())], body_heading(reference)
        sector = np.arctan2(axis[2], axis[0]) / (2 * np.pi) * HEADINGS
        key = np.array([centre[0] / PLACE_SIZE, centre[2] / PLACE_SIZE, sector])
        place: IntArray = np.floor(np.nan_to_num(key)).astype(np.intp)
        return place

    def _slot(self, key: IntArray) -> int:
        same = np.flatnonzero((self._key[: self._count] == key).all(axis=1))
        if len(same) >= self._per_place:
            return int(same[np.argmin(self._order[same])])
        if self._count < self._capacity:
            self._count += 1
            return self._count - 1
        # Full: replace the oldest pair of the place with the most.
        _, place, sizes = np.unique(self._key, axis=0, return_inverse=True, return_counts=True)
        crowded = np.flatnonzero(place.reshape(-1) == np.argmax(sizes))
        return int(crowded[np.argmin(self._order[crowded])])

    def pairs(self, since: float = -np.inf) -> Pairs:
        """The stored pairs, of these elapsed seconds and later, in the order of their times."""
        n = self._count
        chosen = np.flatnonzero(self._elapsed[:n] >= since)
        chosen = chosen[np.argsort(self._elapsed[chosen], kind="stable")]
        points, places = self._points[chosen], len(np.unique(self._key[chosen], axis=0)) if len(chosen) else 0
        return Pairs(points[:, 0], points[:, 1], self._variance[chosen], places)

    def forget_before(self, elapsed: float) -> None:
        """Drop the pairs of earlier elapsed seconds."""
        kept = np.flatnonzero(self._elapsed[: self._count] >= elapsed)
        for values in (self._key, self._order, self._elapsed, self._points, self._variance):
            values[: len(kept)] = values[kept]
        self._count = len(kept)

    def shift_clock(self, offset: float, drift: float) -> None:
        """Move the stored sensor frames along their velocity after a correction of the sensor's clock.

        Args:
            offset: seconds added to the sensor's clock offset at the anchor.
            drift: seconds per second added to its drift.
        """
        n = self._count
        step = offset + drift * self._elapsed[:n]
        self._points[:n, 1] += step[:, None, None] * self._points[:n, 2]

    @property
    def oldest(self) -> float:
        """Elapsed seconds of the oldest pair; infinity when there is none."""
        return float(self._elapsed[: self._count].min(initial=np.inf))

    def clear(self) -> None:
        self._count = 0

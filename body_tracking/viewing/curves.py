"""Joint angles over the last seconds as curves with 95 % bands, reduced to the points that a plot can show."""

from __future__ import annotations

import itertools
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.clocks import jumped_back
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.kinematics.labels import OTHER, UNKNOWN, label_of, limb_of

BAND: Final = 1.959963984540054
"""Half width of the 95 % band of a normal distribution, in standard deviations."""
WIDEST: Final = 60.0
"""Limit of a band's half width, degrees, also for infinite standard deviations."""
_GAP_NS: Final = NANOSECONDS
"""Greatest time between two messages over which a curve is drawn as if measured."""
_HALF_TURN: Final = 180.0
_DECIMALS: Final = 3
"""Most decimals of an angle in degrees."""
_JOINTS: Final = {
    "elbow": ("elbow flexion", "elbow"),
    "shoulder": ("shoulder elevation", "shoulder abduction", "shoulder flexion", "shoulder pitch", "shoulder"),
}
"""The joints plotted first, and the angles of each by preference: a shoulder's abduction before its flexion, which the
T-pose leaves undetermined."""
_GROUPS: Final = {"elbow": "elbows", "shoulder": "shoulders", "humeral": "shoulders", "clavicle": "clavicles"}
_LIMB_GROUPS: Final = {
    "left arm": "arms",
    "right arm": "arms",
    "trunk and head": "trunk",
    "left leg": "legs",
    "right leg": "legs",
}


_OLD: Final = 2.0
"""Seconds without a message from which an angle is shown as old."""


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """An angle over time.

    Attributes:
        times: (n,) seconds before the newest, ascending to 0.
        values: (n,) degrees; the last known one where the angle is unknown.
        low: (n,) degrees, the band's lower edge.
        high: (n,) degrees, its upper edge.
        latest_stddev: degrees; infinite if the angle is unobserved now.
    """

    times: FloatArray
    values: FloatArray
    low: FloatArray
    high: FloatArray
    latest_stddev: float

    def latest(self, age: float = 0.0) -> str:
        """The latest angle and half its band, to a tenth of a degree, or finer for a band that is narrower.

        ``?`` stands for half a turn or more, which leaves no angle out. Of an angle that has not come for ``age``
        seconds, 2 or more, that time is shown in place of the band.
        """
        reach = BAND * self.latest_stddev
        decimals = next((each for each in range(1, _DECIMALS) if reach >= 10.0**-each), _DECIMALS)
        half = f"{reach:.{decimals}f}\u00b0" if reach < _HALF_TURN else "?"
        if age >= _OLD:
            return f"{self.values[-1]:.{decimals}f}\u00b0, {age:.0f} s ago"
        return f"{self.values[-1]:.{decimals}f}\u00b0 \u00b1 {half}"


class AngleHistory:
    """Keeps the angles of the last seconds.

    Args:
        window: seconds.
        capacity: largest number of messages kept.
    """

    def __init__(self, window: float, capacity: int = 4096) -> None:
        self.window = window
        self.names: tuple[str, ...] = ()
        self._rows: deque[tuple[int, FloatArray]] = deque(maxlen=capacity)
        self._received_ns = 0

    def clear(self) -> None:
        self._rows.clear()

    def __len__(self) -> int:
        return len(self._rows)

    def add(
        self, stamp_ns: int, names: Sequence[str], positions: FloatArray, stddevs: FloatArray, steady_ns: int = 0
    ) -> None:
        """Add a message; messages out of order are ignored.

        Other names, a jump back in time, or one forward over a time that has not passed, as of a bag that is continued
        at another place, clear the history. Over a gap that has passed, the angles are unknown.

        Args:
            stamp_ns: capture time.
            names: of n angles.
            positions: (n,) radians.
            stddevs: (n,) radians, infinity where not known.
            steady_ns: time of receipt by a steady clock.
        """
        last = self._rows[-1][0] if self._rows else None
        gap = 0 if last is None else stamp_ns - last
        skipped = gap > _GAP_NS and steady_ns - self._received_ns < gap // 2
        self._received_ns = steady_ns
        if tuple(names) != self.names or jumped_back(stamp_ns, last) or skipped:
            self.names = tuple(names)
            self.clear()
        elif last is not None and stamp_ns <= last:
            return
        elif last is not None and gap > _GAP_NS:
            unknown = np.full((2, len(self.names)), np.inf)
            unknown[0] = np.nan
            self._rows += [(last + 1, unknown), (stamp_ns - 1, unknown)]
        self._rows.append((stamp_ns, np.degrees([positions, stddevs])))
        while self._rows[0][0] < stamp_ns - round(self.window * NANOSECONDS):
            self._rows.popleft()

    def age(self, steady_ns: int) -> float:
        """Seconds since the last message, at this time of the clock of :meth:`add`."""
        return (steady_ns - self._received_ns) / NANOSECONDS

    def known(self) -> tuple[str, ...]:
        """Angles with a value and a standard deviation below ``UNKNOWN`` at any time in the window."""
        if not self._rows:
            return ()
        rows = np.array([row for _, row in list(self._rows)])
        seen: BoolArray = (np.isfinite(rows[:, 0]) & (rows[:, 1] < UNKNOWN)).any(axis=0)
        return tuple(name for name, there in zip(self.names, seen, strict=True) if there)

    def curve(self, name: str, count: int) -> Curve | None:
        """The curve of one angle, with at most ``count`` points; None without known values."""
        if name not in self.names or not len(self):
            return None
        index = self.names.index(name)
        rows = list(self._rows)  # a copy: another thread may append meanwhile
        stamps = np.array([stamp_ns for stamp_ns, _ in rows])
        values, stddevs = np.array([row[:, index] for _, row in rows]).T
        known = np.isfinite(values)
        if not known.any():
            return None
        latest = np.maximum.accumulate(np.where(known, np.arange(len(values)), 0))
        values = values[np.maximum(latest, known.argmax())]
        reach = np.minimum(np.where(known & np.isfinite(stddevs), BAND * stddevs, np.inf), WIDEST)
        low, high = values - reach, values + reach
        kept = extremes(np.stack([values, low, high]), count)
        times = (stamps[kept] - stamps[-1]) / NANOSECONDS
        latest_stddev = float(stddevs[-1]) if known[-1] else float("inf")
        return Curve(times, values[kept], low[kept], high[kept], latest_stddev)


def extremes(series: FloatArray, count: int) -> IntArray:
    """Samples that preserve the visible course of curves: the first, the last and the extremes.

    The samples are split into intervals of equal length; of each one the smallest and the largest value of every series
    are kept.

    Args:
        series: (k, n) finite numbers, all over the same times.
        count: largest number of samples kept; at least 2 + 2 k.

    Returns:
        (m,) ascending indices, m at most ``count``; all of them if n is at most ``count``.
    """
    k, n = series.shape
    if n <= count:
        return np.arange(n, dtype=np.intp)
    stretches = max(1, (count - 2) // (2 * k))
    length = -(-n // stretches)
    begin = np.arange(0, n, length, dtype=np.intp)
    # the last interval is padded with its last sample
    padded = np.pad(series, ((0, 0), (0, len(begin) * length - n)), mode="edge").reshape(k, len(begin), length)
    found = np.concatenate([padded.argmin(axis=2), padded.argmax(axis=2)]) + begin
    kept: IntArray = np.unique(np.concatenate([[0, n - 1], np.minimum(found, n - 1).ravel()])).astype(np.intp)
    return kept


def first_choice(names: Sequence[str], count: int) -> tuple[str, ...]:
    """The angles plotted before the user's choice: one of each elbow and of each shoulder, then others of these joints,
    then those of the trunk, and of the clavicles last.
    """
    labels = {name: label_of(name) for name in names}

    def rank(name: str) -> int:
        label = labels[name]
        if any(joint in label for joint in (*_JOINTS, "humeral")):
            return 0
        return 1 if label == "trunk flexion" else 3 if "clavicle" in label else 2

    first: list[str] = []
    for kinds in _JOINTS.values():
        for side in ("left", "right"):
            own = (name for kind in kinds for name in names if labels[name].startswith(f"{side} {kind}"))
            first += itertools.islice(own, 1)
    return (*first, *sorted((name for name in names if name not in first), key=rank))[:count]


def heading_of(names: Sequence[str]) -> str:
    """What these angles are of, such as ``elbows and shoulders``."""
    groups = []
    for name in names:
        joints = (group for joint, group in _GROUPS.items() if joint in label_of(name))
        groups.append(next(joints, None) or _LIMB_GROUPS.get(limb_of(name), OTHER))
    *most, last = dict.fromkeys(groups) or ("",)
    return f"{', '.join(most)} and {last}" if most else last

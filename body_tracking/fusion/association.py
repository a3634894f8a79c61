"""Association of the bodies that several sensors see with people, over time.

Each frame of one sensor is assigned at its own time. A person is predicted from the last sighting by the same sensor or
by another one, whichever has the smaller variance, with a decaying velocity; the variance grows with the time since.
The assignment of bodies to people within the gate minimises the total cost (``assignment``), the negative
log-likelihood of the distance between torsos. The sensor's own number of a body is evidence only.

Torsos are compared by points that do not change when a sensor swaps left and right, and by the median of their
distances, which one outlier does not move.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Joint, Skeleton
from body_tracking.fusion.assignment import least_cost_assignment
from body_tracking.pipeline.people import HOLD

_MIDLINE = np.array([Joint.SPINE_BASE, Joint.SPINE_MID, Joint.SPINE_SHOULDER, Joint.NECK], dtype=np.intp)
_LEFT = np.array([Joint.SHOULDER_LEFT, Joint.HIP_LEFT], dtype=np.intp)
_RIGHT = np.array([Joint.SHOULDER_RIGHT, Joint.HIP_RIGHT], dtype=np.intp)

_CONFIRM = round(0.3 * NANOSECONDS)
"""An unassigned body becomes a person when seen for this long, nanoseconds: ghosts last a few frames."""

_CHANGE_NS = round(1.0 * NANOSECONDS)
"""The assignment changes when another one has been better for this long, nanoseconds."""

_MARGIN = 0.3
"""... by this many metres in total."""

_MERGE_DISTANCE = 0.35
"""Two people nearer than this are merged unless one sensor sees both, metres: torsos do not come as close."""

_OWN_STDDEV, _CROSS_STDDEV = 0.08, 0.2
"""Standard deviation of a torso against the same sensor's last frame, and against another sensor's, metres."""

_GROWTH, _REACH, _MAX_GATE_GROWTH = 0.6, 1.2, 2.5
"""Growth of the standard deviation and of the gate, metres per second, and the gate's largest growth, metres."""

_VELOCITY_DECAY = 0.7
"""Time constant of the velocity of a person who is not seen, seconds."""

_MAX_SPEED = 3.0
"""Fastest walk in a room, metres per second."""

_ID_BONUS = 6.0
"""Cost by which the sensor's own number favours the same person, in squared standard deviations."""

_FRESH = round(0.2 * NANOSECONDS)
"""Age up to which another sensor's sighting counts as current, nanoseconds."""

_KEPT, _RECENT = 6, round(0.3 * NANOSECONDS)
"""Number of a sensor's sightings that are kept, and their largest age for the velocity, nanoseconds."""

_CHECK_NS = round(1.0 * NANOSECONDS)
"""A lone person is assigned this often, nanoseconds."""

GATE = 0.6
"""Largest distance between a torso and a person's prediction, metres; it grows while the person is not seen."""

_IMPOSSIBLE = 1e9


def torso_points(positions: FloatArray) -> FloatArray:
    """The points by which torsos are compared.

    Args:
        positions: (k, 25, 3) metres, NaN for joints that are not known.

    Returns:
        (k, 6, 3) metres: the joints of the spine, and the middles between both shoulders and both hips. Where no such
        point is known, the mean of the joints that are.
    """
    middles = 0.5 * (positions[:, _LEFT] + positions[:, _RIGHT])
    points: FloatArray = np.concatenate([positions[:, _MIDLINE], middles], axis=1)
    for index in np.flatnonzero(~np.isfinite(points[..., 0]).any(axis=1)):
        known = np.isfinite(positions[index]).all(axis=1)
        if known.any():
            points[index] = positions[index, known].mean(axis=0)
    return points


def torso_distances(ones: FloatArray, others: FloatArray) -> FloatArray:
    """Distances between torsos: the lower median over their common points; without any, the distance of the centres.

    Args:
        ones: (n, 6, 3) metres, as of :func:`torso_points`.
        others: (m, 6, 3) metres.

    Returns:
        (n, m) metres; infinity where one has no point.
    """
    apart = np.linalg.norm(ones[:, None] - others[None], axis=3)
    apart.sort(axis=2)  # NaN last
    count = np.isfinite(apart).sum(axis=2)
    distances: FloatArray = np.take_along_axis(apart, np.maximum(count - 1, 0)[..., None] // 2, axis=2)[..., 0]
    for i, j in np.argwhere(count == 0):
        middles = [_middle(each) for each in (ones[i], others[j])]
        distances[i, j] = np.linalg.norm(middles[0] - middles[1])
    distances[np.isnan(distances)] = np.inf
    return distances


def _middle(points: FloatArray) -> FloatArray:
    known = points[np.isfinite(points[:, 0])]
    result: FloatArray = known.mean(axis=0) if len(known) else np.full(3, np.nan)
    return result


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """A torso in world, at a time of the reference's clock."""

    stamp_ns: int
    points: FloatArray


@dataclass(slots=True, eq=False)
class _Person:
    """A person with each sensor's last sightings."""

    number: int
    since_ns: int
    seen_ns: int
    confirmed: bool
    sightings: dict[str, deque[_Sighting]] = field(default_factory=dict)
    bodies: dict[str, int] = field(default_factory=dict)  # the sensors' own numbers

    def record(self, sensor: str, sighting: _Sighting, body: int) -> None:
        track = self.sightings.setdefault(sensor, deque(maxlen=_KEPT))
        if track and sighting.stamp_ns <= track[-1].stamp_ns:
            return
        track.append(sighting)
        self.bodies[sensor] = body
        self.seen_ns = max(self.seen_ns, sighting.stamp_ns)

    def age_ns(self, sensor: str, stamp_ns: int) -> float:
        """Time since a sensor saw the person; infinity where it did not."""
        track = self.sightings.get(sensor)
        return abs(stamp_ns - track[-1].stamp_ns) if track else math.inf

    def by_others(self, sensor: str, stamp_ns: int) -> str | None:
        """The other sensor with the newest sighting."""
        others = (name for name in self.sightings if name != sensor)
        return min(others, key=lambda name: self.age_ns(name, stamp_ns), default=None)

    def expected(self, sensor: str, stamp_ns: int) -> FloatArray:
        """(6, 3) metres: prediction of the torso from one sensor's sightings."""
        track = self.sightings[sensor]
        last = track[-1]
        first = next(each for each in track if last.stamp_ns - each.stamp_ns <= _RECENT)
        elapsed = (stamp_ns - last.stamp_ns) / NANOSECONDS
        span = (last.stamp_ns - first.stamp_ns) / NANOSECONDS
        if span < 0.02:
            return last.points
        moved = last.points - first.points
        known = np.isfinite(moved[:, 0])
        if not known.any():
            return last.points
        velocity = np.median(moved[known], axis=0) / span
        velocity *= min(1.0, _MAX_SPEED / max(float(np.linalg.norm(velocity)), 1e-9))
        carried = math.copysign(_VELOCITY_DECAY * -math.expm1(-abs(elapsed) / _VELOCITY_DECAY), elapsed)
        result: FloatArray = last.points + carried * velocity
        return result


class Association:
    """Assigns the bodies of calibrated sensors to people.

    Args:
        hold: seconds for which a person whom no sensor sees keeps the id.

    Attributes:
        counters: since the construction: ``new``, ``lost`` and ``merged`` people, ``exchanged`` assignments, and bodies
            that a sensor ``renumbered``.
    """

    def __init__(self, hold: float = HOLD) -> None:
        self.counters: Counter[str] = Counter()
        self._hold_ns = round(hold * NANOSECONDS)
        self._number = 0
        self.reset()

    def reset(self) -> None:
        """Forget all people; numbers are not used again."""
        self._people: list[_Person] = []
        self._contested: dict[str, int] = {}
        self._alike: dict[tuple[int, int], tuple[int, int]] = {}
        self._checked: dict[str, int] = {}

    def forget_sensor(self, sensor: str) -> None:
        """Forget one sensor's sightings, because its time jumped back."""
        for person in self._people:
            person.sightings.pop(sensor, None)
            person.bodies.pop(sensor, None)
        self._contested.pop(sensor, None)
        self._checked.pop(sensor, None)

    def move_sensor(self, sensor: str, rotation: FloatArray, translation: FloatArray) -> None:
        """Move a sensor's sightings after a change of its pose.

        Args:
            sensor: its name.
            rotation: (3, 3) from the old pose, in world.
            translation: (3,) metres from the old pose, in world.
        """
        for person in self._people:
            track = person.sightings.get(sensor)
            if track is not None:
                moved = [_Sighting(each.stamp_ns, each.points @ rotation.T + translation) for each in track]
                person.sightings[sensor] = deque(moved, maxlen=_KEPT)

    @property
    def people(self) -> tuple[int, ...]:
        """The numbers of the confirmed people, the longest known first."""
        return tuple(person.number for person in self._people if person.confirmed)

    def seen_ns(self, number: int) -> int | None:
        """Reference time of a person's last sighting; None for an unknown number."""
        return next((person.seen_ns for person in self._people if person.number == number), None)

    def place(self, number: int) -> FloatArray:
        """(3,) metres in world: the centre of a person's torso in the last sighting."""
        (person,) = (person for person in self._people if person.number == number)
        return _middle(max((track[-1] for track in person.sightings.values()), key=lambda each: each.stamp_ns).points)

    def alone(self, sensor: str, stamp_ns: int, body: int) -> int | None:
        """The number of the only person, where a sensor's only body must be that person and no assignment is due.

        The caller passes the frame later, by :meth:`record`.
        """
        if len(self._people) != 1 or stamp_ns - self._checked.get(sensor, -_CHECK_NS) >= _CHECK_NS:
            return None
        (person,) = self._people
        return person.number if person.confirmed and person.bodies.get(sensor) == body else None

    def record(self, sensor: str, seen: Sequence[tuple[int, FloatArray]], body: int) -> None:
        """Record a sensor's last frames of the only person, (stamp, (25, 3) metres in world) in the order of stamps."""
        (person,) = self._people
        person.sightings.pop(sensor, None)
        for (stamp_ns, _), points in zip(
            seen, torso_points(np.stack([positions for _, positions in seen])), strict=True
        ):
            person.record(sensor, _Sighting(stamp_ns, points), body)

    def assign(self, sensor: str, bodies: Sequence[Skeleton]) -> tuple[int | None, ...]:
        """Assign the bodies of one frame of one sensor to people.

        Args:
            sensor: its name.
            bodies: in world and in the reference's clock, all of one stamp; NaN for joints that are not known.

        Returns:
            For each body the number of its person, constant while the person is present; None for an unconfirmed one.
        """
        if not bodies:
            return ()
        stamp_ns = bodies[0].stamp_ns
        self._drop_lost(stamp_ns)
        points = torso_points(np.stack([body.positions for body in bodies]))
        numbers = [body.body for body in bodies]
        self._checked[sensor] = stamp_ns
        whose = self._assignment(sensor, stamp_ns, points, numbers)
        if len(self._people) > 1:
            whose = self._corrected(sensor, stamp_ns, points, whose)
        beginning = not any(person.confirmed for person in self._people)
        # in the order of the sensor's numbers, so that the order of the bodies does not matter
        for index in sorted(range(len(bodies)), key=lambda each: numbers[each]):
            if whose[index] is None and np.isfinite(points[index]).any():
                self._number += 1
                whose[index] = added = _Person(self._number, stamp_ns, stamp_ns, confirmed=False)
                self._people.append(added)
        for index, person in enumerate(whose):
            if person is None:
                continue
            before = person.bodies.get(sensor)
            self.counters["renumbered"] += before is not None and before != numbers[index]
            person.record(sensor, _Sighting(stamp_ns, points[index]), numbers[index])
            if not person.confirmed and (beginning or stamp_ns - person.since_ns >= _CONFIRM):
                person.confirmed = True
                self.counters["new"] += 1
        if len(self._people) > 1:
            self._merge(sensor, stamp_ns, whose)
        return tuple(person.number if person is not None and person.confirmed else None for person in whose)

    def _drop_lost(self, stamp_ns: int) -> None:
        kept = []
        for person in self._people:
            if stamp_ns - person.seen_ns <= (self._hold_ns if person.confirmed else _CONFIRM):
                kept.append(person)
            else:
                self.counters["lost"] += person.confirmed
        self._people = kept

    def _assignment(
        self, sensor: str, stamp_ns: int, points: FloatArray, numbers: Sequence[int]
    ) -> list[_Person | None]:
        """The most likely person of each body, if any."""
        people = [person for person in self._people if person.sightings]
        whose: list[_Person | None] = [None] * len(points)
        if not people:
            return whose
        expected, stddev, gate = [], [], []
        for person in people:
            other = person.by_others(sensor, stamp_ns)
            own = _GROWTH * person.age_ns(sensor, stamp_ns) / NANOSECONDS + _OWN_STDDEV
            cross = (
                math.inf if other is None else _GROWTH * person.age_ns(other, stamp_ns) / NANOSECONDS + _CROSS_STDDEV
            )
            by, spread, least = (
                (sensor, own, _OWN_STDDEV) if other is None or own <= cross else (other, cross, _CROSS_STDDEV)
            )
            expected.append(person.expected(by, stamp_ns))
            stddev.append(spread)
            gate.append(GATE + min(_REACH / _GROWTH * (spread - least), _MAX_GATE_GROWTH))
        distances = torso_distances(np.stack(expected), points)
        spread_of = np.array(stddev)[:, None]
        # people move in the plane: two dimensions of likelihood
        costs = (distances / spread_of) ** 2 + 4.0 * np.log(spread_of / _OWN_STDDEV)
        costs -= _ID_BONUS * np.array(
            [[person.bodies.get(sensor) == number for number in numbers] for person in people]
        )
        costs[~(distances <= np.array(gate)[:, None])] = _IMPOSSIBLE
        rows, columns = least_cost_assignment(costs)
        for row, column in zip(rows, columns, strict=True):
            if costs[row, column] < _IMPOSSIBLE:
                whose[column] = people[row]
        return whose

    def _corrected(
        self, sensor: str, stamp_ns: int, points: FloatArray, whose: list[_Person | None]
    ) -> list[_Person | None]:
        """The assignment, or the one by the other sensors' sightings once it has been better for ``_CHANGE_NS``."""
        present = [
            (person, other)
            for person in self._people
            if (other := person.by_others(sensor, stamp_ns)) is not None and person.age_ns(other, stamp_ns) <= _FRESH
        ]
        people = [person for person, _ in present]
        mine = {index: people.index(person) for index, person in enumerate(whose) if person in people}
        columns = list(mine)
        if len(people) < 2 or not columns:
            self._contested.pop(sensor, None)
            return whose
        expected = np.stack([person.expected(other, stamp_ns) for person, other in present])
        distances = np.minimum(torso_distances(expected, points[columns]), 2.0 * GATE)
        now = distances[list(mine.values()), range(len(columns))].sum()
        rows, chosen = least_cost_assignment(distances)
        if now - distances[rows, chosen].sum() <= _MARGIN:
            self._contested.pop(sensor, None)
            return whose
        if stamp_ns - self._contested.setdefault(sensor, stamp_ns) < _CHANGE_NS:
            return whose
        del self._contested[sensor]
        changed = list(whose)
        for row, k in zip(rows, chosen, strict=True):
            changed[columns[k]] = people[row] if distances[row, k] <= GATE else None
        for index in columns:
            before, after = whose[index], changed[index]
            if before is not after:
                self.counters["exchanged"] += 1
                for person in (before, after):  # their sightings were of others
                    if person is not None:
                        person.sightings.pop(sensor, None)
                        person.bodies.pop(sensor, None)
        return changed

    def _merge(self, sensor: str, stamp_ns: int, whose: Sequence[_Person | None]) -> None:
        """Merge two people who have been in one place for ``_CHANGE_NS`` while no sensor saw both."""
        for one, other, by in self._pairs(sensor, stamp_ns, whose):
            older, newer = sorted((one, other), key=lambda person: person.number)
            pair = older.number, newer.number
            here = one.sightings[sensor][-1].points[None]
            if torso_distances(here, other.expected(by, stamp_ns)[None])[0, 0] > _MERGE_DISTANCE:
                self._alike.pop(pair, None)
                continue
            since, until = self._alike.get(pair, (stamp_ns, stamp_ns))
            if stamp_ns - until > _CHANGE_NS:  # not compared for long
                since = stamp_ns
            self._alike[pair] = since, stamp_ns
            if stamp_ns - since < _CHANGE_NS:
                continue
            for name, track in newer.sightings.items():
                if name not in older.sightings or track[-1].stamp_ns > older.sightings[name][-1].stamp_ns:
                    older.sightings[name], older.bodies[name] = track, newer.bodies[name]
            older.seen_ns = max(older.seen_ns, newer.seen_ns)
            older.confirmed |= newer.confirmed
            self._people.remove(newer)
            self.counters["merged"] += 1
            break
        numbers = {person.number for person in self._people}
        self._alike = {pair: times for pair, times in self._alike.items() if numbers.issuperset(pair)}

    def _pairs(
        self, sensor: str, stamp_ns: int, whose: Sequence[_Person | None]
    ) -> Iterator[tuple[_Person, _Person, str]]:
        """The people in a frame, each with those whom only another sensor sees, and that sensor."""
        for one in whose:
            for other in self._people:
                if one is None or other in whose or other.age_ns(sensor, stamp_ns) <= _CHANGE_NS:
                    continue
                by = other.by_others(sensor, stamp_ns)
                # a sensor that sees both proves that they are two
                if by is not None and other.age_ns(by, stamp_ns) <= _FRESH < one.age_ns(by, stamp_ns):
                    yield one, other, by

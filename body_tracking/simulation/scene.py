"""Simulates people who move in front of sensors: ground truth and measurements."""

from __future__ import annotations

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.body_model import Posture
from body_tracking.core.clocks import ClockModel
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import N_JOINTS, NANOSECONDS, FloatArray, IntArray, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.inertial.simulated import ImuSamples, Motion, SimulatedImu
from body_tracking.inertial.surroundings import Surroundings
from body_tracking.kinect.simulated import KinectErrors
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.kinematics.upper_body import PARENTS
from body_tracking.simulation.layouts import Layout, layout
from body_tracking.simulation.people import MODEL, Course, Person, joints
from body_tracking.simulation.repertoire import Movement, make_movement

WORLD: Final = "world"
START_NS: Final = 40 * NANOSECONDS
"""Time on the reference sensor's clock at the start."""
RECEIVED_FROM_NS: Final = 1_750_000_000 * NANOSECONDS
"""Time on the receiver's clock at the start."""
MAX_PEOPLE: Final = 6
"""Largest number of bodies of a Kinect v2."""
APART: Final = 0.9
"""Distance between people side by side, metres."""
LANE: Final = 0.7
"""Distance between the lanes of people who walk past each other, metres."""
_CLOCK_OFFSET_S, _CLOCK_DRIFT_PPM = 2.0, 50.0
"""Largest offset and drift of a sensor's clock relative to the reference sensor's."""
_STEP = 1e-4
"""Half step of the central differences for velocities, seconds; accurate to 1e-6 m/s."""


class SceneError(BodyTrackingError):
    """Raised for an impossible scene."""


@dataclass(frozen=True, slots=True)
class Place:
    """A person's initial position, relative to that of a single person in the layout.

    Attributes:
        ahead: metres forward.
        left: metres to the left.
        turn: heading, turned to the left, radians.
    """

    ahead: float
    left: float
    turn: float = 0.0


def side_by_side(number: int) -> tuple[Place, ...]:
    """The first person at the layout's position, the others 1, -1, 2, -2, ... intervals to the left."""
    return tuple(Place(0.0, APART * ((k + 1) // 2 * (1 if k % 2 else -1))) for k in range(number))


def lanes(number: int, apart: float = LANE) -> tuple[Place, ...]:
    """One behind the other, every second one facing backwards, so that people who walk sideways pass each other."""
    return tuple(Place(apart * (0.5 * (number - 1) - k), 0.0, np.pi * (k % 2)) for k in range(number))


@dataclass(frozen=True, slots=True, eq=False)
class Setup:
    """Parameters of a simulation.

    Attributes:
        motion: one of ``repertoire.MOTIONS``; performed by all people, each in their own manner.
        layout: poses of the sensors.
        people: None to draw them at random.
        number: of people to draw.
        imus: worn by the first person.
        seconds: of the recording; None for the motion's own length.
        seed: of the random generators.
        standard: the motion as the thesis shows it, without an individual manner.
        errors: of the cameras.
        dark: without light, a Kinect captures 15 frames per second.
        places: initial positions; None for side by side.
        surroundings: of the inertial sensors.
    """

    motion: str
    layout: Layout = field(default_factory=lambda: layout(4))
    people: tuple[Person, ...] | None = None
    number: int = 1
    imus: tuple[SimulatedImu, ...] = ()
    seconds: float | None = None
    seed: int = 0
    standard: bool = False
    errors: KinectErrors = field(default_factory=KinectErrors)
    dark: bool = False
    places: tuple[Place, ...] | None = None
    surroundings: Surroundings = field(default_factory=Surroundings)

    def __post_init__(self) -> None:
        count = self.number if self.people is None else len(self.people)
        if not 1 <= count <= MAX_PEOPLE:
            raise SceneError(f"{count} people: expected 1 to {MAX_PEOPLE}")
        if self.places is not None and len(self.places) != count:
            raise SceneError(f"{len(self.places)} places for {count} people")
        if self.seed < 0:
            raise SceneError(f"seed {self.seed}: must not be negative")
        if self.seconds is not None and not 1.0 <= self.seconds <= 36_000.0:
            raise SceneError(f"{self.seconds} seconds: expected 1 to 36000")


@dataclass(frozen=True, slots=True, eq=False)
class Truth:
    """Ground truth of one person in ``world``, at the captures of the reference sensor and by its clock.

    Attributes:
        person: the body.
        stamps_ns: (n,) nanoseconds.
        positions: (n, 25, 3) metres.
        velocities: (n, 25, 3) m/s.
        q: (n, 35) configurations of ``UpperBody``.
        rates: (n, 32) tangent velocities, per second.
    """

    person: Person
    stamps_ns: IntArray
    positions: FloatArray
    velocities: FloatArray
    q: FloatArray
    rates: FloatArray

    def skeleton(self, instant: int, body: int = 0) -> Skeleton:
        """The joints at an instant, all tracked."""
        tracked = np.full(N_JOINTS, TrackingState.TRACKED, dtype=np.uint8)
        return Skeleton(
            int(self.stamps_ns[instant]),
            WORLD,
            self.positions[instant],
            tracked,
            body,
            velocities=self.velocities[instant],
        )

    def estimate(self, instant: int) -> ModelEstimate:
        """The state of the body model at an instant, with zero covariance."""
        zero = np.zeros((2 * MODEL.nv, 2 * MODEL.nv))
        return ModelEstimate(
            int(self.stamps_ns[instant]),
            WORLD,
            0,
            self.q[instant],
            self.rates[instant],
            zero,
            self.person.lengths,
            np.zeros(len(self.person.lengths)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedRecording:
    """Ground truth and measurements.

    Attributes:
        setup: of the simulation.
        duration: seconds.
        sensors: the cameras, the reference first.
        frames: of all cameras, in the order of receipt.
        truths: of each person.
        imus: inertial sensors with their samples.
    """

    setup: Setup
    duration: float
    sensors: tuple[SimulatedKinect, ...]
    frames: tuple[RecordedFrame, ...]
    truths: tuple[Truth, ...]
    imus: tuple[tuple[SimulatedImu, ImuSamples], ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Actor:
    """A person with a movement, an initial pose, and the misreading common to all sensors."""

    person: Person
    misreading: Misreading
    movement: Movement
    position: FloatArray
    yaw: float

    def course(self, times: FloatArray) -> Course:
        """The body at (n,) seconds in ``world``."""
        return self.movement.course(np.clip(times, 0.0, self.movement.duration)).placed(self.position, self.yaw)

    def positions(self, times: FloatArray) -> FloatArray:
        """(n, 25, 3) metres in ``world``."""
        return joints(self.person, self.course(times))

    def truth(self, times: FloatArray) -> Truth:
        """The ground truth at (n,) seconds."""
        # movements are defined from 0 to their duration
        inside = np.clip(times, _STEP, self.movement.duration - _STEP)
        before, after = self.course(inside - _STEP), self.course(inside + _STEP)
        velocities = (joints(self.person, after) - joints(self.person, before)) / (2.0 * _STEP)
        stamps = START_NS + np.round(times * NANOSECONDS).astype(np.int64)
        course = self.course(times)
        return Truth(
            self.person,
            stamps,
            joints(self.person, course),
            velocities,
            course.q,
            MODEL.difference(before.q, after.q) / (2.0 * _STEP),
        )


def simulate(setup: Setup) -> SimulatedRecording:
    """Simulate a recording; equal setups give equal numbers.

    People, movements, each sensor's clock and each sensor's errors have their own generators, so that adding a sensor
    or an error changes nothing else.

    Raises:
        RepertoireError: an unknown motion, or too few seconds for it.
    """
    name = zlib.crc32(setup.motion.encode())
    actors = _actors(setup, name)
    duration = actors[0].movement.duration
    sensors = _sensors(setup)
    frames: list[RecordedFrame] = []
    truths: tuple[Truth, ...] = ()
    for number, sensor in enumerate(sensors):
        rng = np.random.default_rng([setup.seed, name, 3, number])
        times = sensor.capture_times(duration, rng)
        if number == 0:
            truths = tuple(actor.truth(times) for actor in actors)
        bodies = [(actor.positions(times), actor.person.capsules()) for actor in actors]
        seen = [
            sensor.see(times, *body, rng, actor.misreading, bodies[:number] + bodies[number + 1 :])
            for number, (body, actor) in enumerate(zip(bodies, actors, strict=True))
        ]
        frames += sensor.deliver(times, _numbered(seen), START_NS, RECEIVED_FROM_NS, rng)
    frames.sort(key=lambda frame: (frame.received_ns, frame.sensor))
    imus = tuple(
        (
            imu,
            _samples(
                imu, actors[0], setup.surroundings, duration, np.random.default_rng([setup.seed, name, 4, number])
            ),
        )
        for number, imu in enumerate(setup.imus)
    )
    return SimulatedRecording(setup, duration, sensors, tuple(frames), truths, imus)


_Seen = tuple[FloatArray, NDArray[np.uint8]]
"""Positions and states of one person."""


def _numbered(seen: Sequence[_Seen]) -> dict[int, _Seen]:
    """Each person's measurements by the sensor's body numbers; a new person gets the lowest free number."""
    if len(seen) == 1:
        return {0: seen[0]}
    there = np.stack([states.any(axis=1) for _, states in seen], axis=1)
    numbered = {number: (np.full_like(seen[0][0], np.nan), np.zeros_like(seen[0][1])) for number in range(len(seen))}
    taken: dict[int, int] = {}
    edges = np.flatnonzero((there[1:] != there[:-1]).any(axis=1)) + 1
    for begin, end in pairwise([0, *edges.tolist(), len(there)]):
        present = np.flatnonzero(there[begin]).tolist() if end > begin else []
        taken = {person: number for person, number in taken.items() if person in present}
        for person in present:
            if person not in taken:
                taken[person] = min(numbered.keys() - taken.values())
            positions, states = numbered[taken[person]]
            positions[begin:end], states[begin:end] = seen[person][0][begin:end], seen[person][1][begin:end]
    return numbered


def draw_clock(rng: np.random.Generator) -> ClockModel:
    """The clock of an unsynchronised sensor."""
    offset, drift = rng.uniform(-1.0, 1.0, 2) * [_CLOCK_OFFSET_S, _CLOCK_DRIFT_PPM]
    return ClockModel(round(offset * NANOSECONDS), float(drift), START_NS)


def _actors(setup: Setup, name: int) -> tuple[_Actor, ...]:
    rng = np.random.default_rng([setup.seed, 1])
    people: Sequence[Person] = setup.people or [Person.draw(rng) for _ in range(setup.number)]
    yaw = setup.layout.yaw
    ahead, left = np.array([np.cos(yaw), np.sin(yaw), 0.0]), np.array([-np.sin(yaw), np.cos(yaw), 0.0])
    actors = []
    for number, (person, place) in enumerate(zip(people, setup.places or side_by_side(len(people)), strict=True)):
        own = None if setup.standard else np.random.default_rng([setup.seed, name, 2, number])
        movement = make_movement(setup.motion, person, own, setup.seconds)
        misreading = Misreading.draw(np.random.default_rng([setup.seed, 6, number]))
        position = setup.layout.position + place.ahead * ahead + place.left * left
        actors.append(_Actor(person, misreading, movement, position, yaw + place.turn))
    return tuple(actors)


def _sensors(setup: Setup) -> tuple[SimulatedKinect, ...]:
    """The cameras with their clocks; the first one is the reference."""
    sensors = []
    for number, pose in enumerate(setup.layout.poses):
        rng = np.random.default_rng([setup.seed, 5, number])
        clock = draw_clock(rng) if number else ClockModel(anchor_ns=START_NS)
        phase = float(rng.uniform(0.0, 1.0 / 30.0)) if number else 0.0
        sensors.append(SimulatedKinect(pose, clock, phase, setup.errors, setup.dark))
    return tuple(sensors)


def _samples(
    imu: SimulatedImu, actor: _Actor, surroundings: Surroundings, duration: float, rng: np.random.Generator
) -> ImuSamples:
    """Samples of an inertial sensor worn by a person."""
    segment = MODEL.segment_names.index(imu.segment)
    latest: list[tuple[FloatArray, Posture]] = []

    def posture(times: FloatArray) -> Posture:
        # a segment and its parent are requested at the same times, one after the other
        if not latest or not np.array_equal(latest[0][0], times):
            latest[:] = [(times, MODEL.forward(actor.course(times).q, actor.person.lengths))]
        return latest[0][1]

    def motion_of(number: int) -> Motion:
        def motion(times: FloatArray) -> tuple[FloatArray, FloatArray]:
            found = posture(times)
            return found.rotations[:, number], found.origins[:, number]

        return motion

    parent = PARENTS[segment]
    return imu.samples(
        motion_of(segment),
        duration,
        START_NS,
        rng,
        parent=None if parent < 0 else motion_of(parent),
        surroundings=surroundings,
        received_from_ns=RECEIVED_FROM_NS,
    )

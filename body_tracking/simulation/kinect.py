"""What a Kinect v2 would have said of a person, when, and how wrongly.

The errors are those of the sensor's own skeleton, so they are told of the body that the sensor believes to see: one
that faces it, with left and right exchanged where it does not (``mirrored``). From the true joints to the reported:

1. the trunk is told too straight, lifted shoulders too low, a turned body as turned less (``straightening``,
   ``lift_damping``, ``turn_loss``);
2. each joint is placed beside the anatomical one, always by the same in the body's own frames (``offset``), and along
   the ray by what its kind is wrong by (``depth_offset``);
3. it errs with the pose and the side it is seen from, in the same pose in the same way (``bias``, ``bias_turn``,
   ``length_spread``), and wanders besides (``drift``, ``drift_time``); :class:`Misreading` holds what is drawn once for
   a person and a type of sensor;
4. a hidden joint is guessed (``guess``), drawn to the surface that hides it (``drag``) and comes free with a delay
   (``hang_over``); limbs nearly keep their lengths in all of this;
5. all frames bring noise (``white``) and, rarely, outliers.

Bias, drift and noise grow with the distance (``distance_growth``) and with the angle under which the body is seen
(``growth_60``, ``growth_90``), on its far side more than on its near side; guesses grow with the distance. All of these
are greater along the ray than across it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.special import ndtri

from body_tracking.calibration.result import SensorPose
from body_tracking.clocks import ClockModel
from body_tracking.errors import BodyTrackingError
from body_tracking.kinematics.motion import EXTREMITY, JOINT_CLASSES, LIMB
from body_tracking.measurement import body_heading
from body_tracking.parameters import (
    Parameter,
    ParameterError,
    as_yaml,
    check_all,
    check_fields,
    number_field,
    parameters_from,
    read_file,
)
from body_tracking.sensors import RecordedFrame, optical_frame
from body_tracking.simulation.occlusion import Capsules, obstruction, veil
from body_tracking.skeleton import (
    BONES,
    MIRROR,
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)

FIELD_OF_VIEW: Final = (np.radians(70.6), np.radians(60.0))
"""Radians, across and down: of the depth camera."""
RANGE: Final = (0.5, 4.5)
"""Metres along the optical axis within which the sensor sees bodies."""
RATE, DARK_RATE = 30.0, 15.0
"""Frames per second, in the light and in the dark."""
REFERENCE_DISTANCE: Final = 2.0
"""Metres: where the errors are as large as their parameters say."""
SECTION: Final = "simulated_kinect"
"""Of a parameters file."""


class SimulatedKinectError(BodyTrackingError):
    """Errors that are out of their range, or a truth that is none."""


@dataclass(frozen=True, slots=True)
class KinectErrors:
    """How much a simulated Kinect v2 errs; each field's metadata says what it is, its unit and its range.

    Lengths hold for a joint of the trunk of a person who faces the sensor at 2 m; the other joints have their multiples
    (:data:`WHITE_SCALE`, :data:`SLOW_SCALE`).

    Raises:
        SimulatedKinectError: a value out of its range.
    """

    white: float = number_field(
        0.00015, "standard deviation of the noise that is new in each frame, across the ray", "m", 0.0, 0.1
    )
    bias: float = number_field(
        0.007, "standard deviation of the error that depends on pose and view, across the ray", "m", 0.0, 0.2
    )
    bias_turn: float = number_field(
        0.8, "how far a limb or the view has to turn for that error to become another one", "rad", 0.05, 10.0
    )
    drift: float = number_field(0.003, "standard deviation of the error that wanders with time", "m", 0.0, 0.2)
    drift_time: float = number_field(1.0, "time for which it persists", "s", 0.02, 100.0)
    length_spread: float = number_field(
        0.035, "standard deviation of the length of a limb or of the trunk, as a share of it", "1", 0.0, 0.5
    )
    anatomical: float = number_field(
        1.0,
        "how much of what lies between reported and anatomical joint of everybody, constant in the body",
        "1",
        0.0,
        5.0,
    )
    offset: float = number_field(
        0.010,
        "standard deviation of what lies between reported and anatomical joint of a person besides",
        "m",
        0.0,
        0.2,
    )
    depth_offset: float = number_field(
        0.018, "root mean square over the joints of what their kind is wrong by along the ray", "m", 0.0, 0.2
    )
    distance_growth: float = number_field(1.5, "power of the distance with which errors grow", "1", 0.0, 4.0)
    growth_60: float = number_field(
        0.3, "by how much errors are greater at a yaw of 60 degrees than at 30", "1", 0.0, 10.0
    )
    growth_90: float = number_field(
        2.2, "by how much errors are greater at a yaw of 90 degrees than at 30", "1", 0.0, 20.0
    )
    turn_loss: float = number_field(
        0.3, "share of the yaw of shoulders and hips that is missing at 90 degrees", "1", 0.0, 1.0
    )
    straightening: float = number_field(0.3, "share of the trunk's bend that is missing", "1", 0.0, 1.0)
    lift_damping: float = number_field(0.4, "share of a shoulder's lift that is missing", "1", 0.0, 1.0)
    hidden_from: float = number_field(
        0.5, "cover from which a joint is inferred: 0 at the rim of what is before it, 1 in its middle", "1", 0.01, 1.0
    )
    given_up: float = number_field(
        0.1, "share of the joints behind the middle of something that are not tracked", "1", 0.0, 1.0
    )
    hang_over: float = number_field(
        0.2, "time that a joint takes to be hidden or free, and for which exchanged limbs last", "s", 0.0, 10.0
    )
    drag: float = number_field(
        0.35, "share of the way to the surface before it by which a hidden joint is drawn there", "1", 0.0, 1.0
    )
    guess: float = number_field(
        0.04, "standard deviation of where a hidden joint is guessed, across the ray", "m", 0.0, 0.5
    )
    mislabelled: float = number_field(0.3, "share of the hidden joints that are said to be tracked", "1", 0.0, 1.0)
    flicker: float = number_field(
        0.01, "share of the frames in which a hand or foot in full view is said to be inferred", "1", 0.0, 1.0
    )
    mirrored: float = number_field(
        1.0, "share of the times a person turns the back in which the sensor takes it for the front", "1", 0.0, 1.0
    )
    mirror_hysteresis: float = number_field(
        1.1, "angle beyond the side view by which a body has to turn for left and right to change", "rad", 0.0, 1.5
    )
    mirror_rate: float = number_field(
        0.04, "how often left and right change by themselves in a side view", "1/s", 0.0, 10.0
    )
    mirror_time: float = number_field(1.3, "time for which they then stay exchanged, on average", "s", 0.01, 60.0)
    limb_swap_rate: float = number_field(0.003, "how often the arms, or the legs, are exchanged", "1/s", 0.0, 10.0)
    outlier_rate: float = number_field(0.01, "how often a joint jumps away for a few frames", "1/s", 0.0, 10.0)
    outlier_size: float = number_field(0.2, "how far, on average", "m", 0.0, 2.0)
    jitter: float = number_field(0.0002, "standard deviation of the instant of a capture", "s", 0.0, 0.01)
    lost: float = number_field(0.09, "share of the frames that are lost", "1", 0.0, 0.9)
    stall_rate: float = number_field(
        0.03,
        "how often the connection stalls: half of the times its frames are lost, else they come in a burst",
        "1/s",
        0.0,
        10.0,
    )
    stall_time: float = number_field(0.25, "for how long, on average", "s", 0.0, 10.0)
    delay: float = number_field(0.022, "time from capture to receipt, at least", "s", 0.0, 10.0)
    delay_jitter: float = number_field(0.003, "time added to it on average", "s", 0.0, 1.0)

    def __post_init__(self) -> None:
        check_fields(self, "simulated Kinect", SimulatedKinectError)

    def offsets_alone(self) -> KinectErrors:
        """Only where they take the joints' centres to be, beside where an anatomist does."""
        return replace(self.none(), anatomical=self.anatomical, offset=self.offset)

    @classmethod
    def none(cls) -> KinectErrors:
        """A sensor that errs in nothing, though what is covered is still inferred or not tracked."""
        nothing = {item.name: 0.0 for item in parameters() if item.min == 0.0}
        return cls(**nothing)

    def scaled(self, factor: float, names: tuple[str, ...] | None = None) -> KinectErrors:
        """All parameters, or those named, times the factor, within their ranges."""
        changes = {
            item.name: float(np.clip(factor * getattr(self, item.name), item.min, item.max))
            for item in parameters()
            if names is None or item.name in names
        }
        return replace(self, **changes)


def parameters() -> tuple[Parameter, ...]:
    """What :class:`KinectErrors` can be told."""
    return _PARAMETERS


_PARAMETERS: Final = parameters_from(KinectErrors)


def read_errors(path: Path) -> KinectErrors:
    """Errors from the section ``simulated_kinect`` of a parameters file; what it does not name is at its default.

    Raises:
        SimulatedKinectError: no such file or section, an unknown name, a value out of its range.
    """
    try:
        sections = read_file(path)
    except ParameterError as error:
        raise SimulatedKinectError(str(error)) from error
    given = sections.get(SECTION, sections.get(f"/{SECTION}"))
    if given is None:
        raise SimulatedKinectError(
            f"{path}: no section {SECTION}; found: {', '.join(name.strip('/') for name in sections) or 'none'}"
        )
    try:
        values = check_all(parameters(), given)
    except ParameterError as error:
        raise SimulatedKinectError(f"{path}: {error}") from error
    return KinectErrors(**{name: float(value) for name, value in values.items() if isinstance(value, int | float)})


def errors_as_yaml(errors: KinectErrors | None = None) -> str:
    """A parameters file of these errors, or of the defaults, explained."""
    values = errors or KinectErrors()
    return as_yaml({SECTION: [replace(item, default=getattr(values, item.name)) for item in parameters()]})


# --- what differs from joint to joint

_PARTS: Final = {
    # kind of joint: multiples of the white noise and of the slow errors, millimetres that it is too far along the ray
    "SPINE_BASE": (1.0, 1.2, 32.0),
    "SPINE_MID": (0.8, 0.8, 14.0),
    "SPINE_SHOULDER": (1.0, 0.8, -8.0),
    "NECK": (1.0, 0.8, -18.0),
    "HEAD": (1.3, 1.1, 32.0),
    "SHOULDER": (1.3, 1.1, 4.0),
    "ELBOW": (1.4, 1.3, -10.0),
    "WRIST": (2.0, 1.4, -15.0),
    "HAND": (4.5, 1.5, -12.0),
    "HAND_TIP": (10.0, 1.8, -10.0),
    "THUMB": (22.0, 2.0, -20.0),
    "HIP": (1.0, 1.2, 6.0),
    "KNEE": (1.7, 1.2, -15.0),
    "ANKLE": (1.7, 1.4, -20.0),
    "FOOT": (3.0, 1.8, -33.0),
}
"""White noise: third differences of the ``kinect_pairs`` recordings; slow errors: spread of limb lengths and of what
two sensors disagree on there, and the greater errors of hands and feet in Schlagenhauf 2017, table E.1; along the ray:
what sensors 45 and 90 degrees apart consistently disagree on there."""


def _part_of(joint: Joint) -> tuple[float, float, float]:
    return _PARTS[joint.name.removesuffix("_LEFT").removesuffix("_RIGHT")]


WHITE_SCALE: Final[FloatArray] = np.array([_part_of(joint)[0] for joint in Joint])
"""(25,) multiples of ``white``."""
SLOW_SCALE: Final[FloatArray] = np.array([_part_of(joint)[1] for joint in Joint])
"""(25,) multiples of ``bias``, ``drift``, ``offset`` and ``guess``."""
_DEPTH: Final[FloatArray] = np.array([_part_of(joint)[2] for joint in Joint])
DEPTH_PATTERN: Final[FloatArray] = _DEPTH / np.sqrt((_DEPTH**2).mean())
"""(25,) multiples of ``depth_offset``."""
_ANATOMICAL: Final = {
    "SPINE_BASE": (-0.0308, -0.0071, -0.0298),
    "SPINE_MID": (-0.0616, -0.0143, -0.0597),
    "NECK": (-0.0366, -0.0394, -0.0199),
    "HEAD": (-0.0366, -0.0394, -0.0199),
    "SHOULDER_LEFT": (0.0188, -0.0678, -0.0439),
    "ELBOW_LEFT": (-0.0184, -0.0434, -0.0303),
    "WRIST_LEFT": (0.0323, 0.0036, -0.0341),
    "HAND_LEFT": (0.0508, 0.0193, -0.0686),
    "SHOULDER_RIGHT": (-0.0466, -0.0386, -0.0459),
    "ELBOW_RIGHT": (0.0058, -0.0642, -0.0534),
    "WRIST_RIGHT": (-0.0881, -0.0079, -0.0068),
    "HAND_RIGHT": (-0.0734, -0.0343, 0.0039),
    "SPINE_SHOULDER": (-0.0366, -0.0394, -0.0199),
    "HAND_TIP_LEFT": (0.0693, 0.0350, -0.1031),
    "THUMB_LEFT": (0.0508, 0.0193, -0.0686),
    "HAND_TIP_RIGHT": (-0.0587, -0.0607, 0.0146),
    "THUMB_RIGHT": (-0.0734, -0.0343, 0.0039),
}
"""What ``benchmarks/calibrate_simulator.py --fit`` found, metres forward, left and up in the frames of the segments."""
ANATOMICAL: Final[FloatArray] = np.array([_ANATOMICAL.get(joint.name, (0.0, 0.0, 0.0)) for joint in Joint])
ALONG_RAY: Final = 1.5
"""Errors along the ray against those across it."""
_RAY_AXES: Final = np.array([1.0, 1.0, ALONG_RAY])


def _named(*names: str) -> BoolArray:
    return np.array([joint.name.removesuffix("_LEFT").removesuffix("_RIGHT") in names for joint in Joint])


_SPINE: Final = _named("SPINE_BASE", "SPINE_MID", "SPINE_SHOULDER", "NECK", "HEAD")
_ARMS: Final = _named("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")
_LEGS: Final = _named("KNEE", "ANKLE", "FOOT")
_FLICKERS: Final[FloatArray] = np.select([JOINT_CLASSES == EXTREMITY, JOINT_CLASSES == LIMB], [1.0, 0.5], 0.0)
_SPINE_WEIGHT, _FAR_DEPTH = 0.4, 0.3
"""What of the variance that grows with yaw the spine has; metres behind it at which a limb has all of the far side."""
_MIDDLE = 0.75
_LOST_FROM, _FIND_AGAIN = 0.6, 0.15
"""Share of the trunk's joints that must be behind others for a body to be lost, and the seconds that it stays so."""
"""Cover from which a joint is behind the middle of something."""
_REST_LEVEL = -0.27
"""Shoulder against SpineShoulder of a person who stands, as a share of its distance (``kinect_pairs``)."""


def _parents() -> IntArray:
    """(25,) the joint at the other end of each joint's segment."""
    parents = np.arange(N_JOINTS, dtype=np.intp)
    for parent, child in BONES:
        parents[child] = parent
    return parents


_PARENTS: Final = _parents()
_ANCHORS: Final[IntArray] = np.where(_SPINE | _named("HIP"), np.intp(Joint.SPINE_SHOULDER), _PARENTS)
"""(25,) from where a joint's length is measured that varies: the trunk's as a whole, from its best seen joint."""
_VARYING: Final[IntArray] = np.where(_ANCHORS == Joint.SPINE_SHOULDER, np.intp(Joint.SPINE_BASE), np.arange(N_JOINTS))
_VARYING[[Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT]] = Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT


def _second_segments() -> IntArray:
    """(25,) the other segment that a joint's errors depend on: the one before, or after a limb's first."""
    second = _PARENTS.copy()
    for side in ("LEFT", "RIGHT"):
        for first, after in (("ELBOW", "WRIST"), ("KNEE", "ANKLE")):
            second[Joint[f"{first}_{side}"]] = Joint[f"{after}_{side}"]
    return second


_ON_TRUNK: Final = ~(_ARMS | _LEGS)
_FIRST: Final[IntArray] = np.where(_ON_TRUNK, np.intp(Joint.ELBOW_LEFT), np.arange(N_JOINTS))
_SECOND: Final[IntArray] = np.where(_ON_TRUNK, np.intp(Joint.ELBOW_RIGHT), _second_segments())
"""(25,) segments, named by their outer joints, with which the errors of a joint change; the trunk's with the arms."""
_REST: Final[FloatArray] = np.zeros((N_JOINTS, 3))
_REST[_LEGS] = [0.0, 0.0, -1.0]
_REST[_ARMS, 1] = [1.0 if joint.name.endswith("LEFT") else -1.0 for joint in Joint if _ARMS[joint]]
_FOLLOWS: Final = (
    # how far a limb follows its root where this is seen as turned less than it is
    (Joint.SPINE_SHOULDER, "SHOULDER", {"ELBOW": 0.6, "WRIST": 0.2, "HAND": 0.2, "HAND_TIP": 0.2, "THUMB": 0.2}),
    (Joint.SPINE_BASE, "HIP", {"KNEE": 0.4}),
)
_CHAINS: Final = tuple(
    np.flatnonzero(_named(*names))
    for names in (("SHOULDER", "HIP"), ("ELBOW", "KNEE"), ("WRIST", "ANKLE"), ("HAND", "FOOT"), ("HAND_TIP", "THUMB"))
)
_KINSHIP = 0.8
"""Correlation of slow errors along a segment: limbs err as a whole more than they change their lengths."""
_STIFFNESS = 0.7
"""How far the sensor keeps the length of a limb when it misplaces the limb's joints."""
_FEATURES = 24
"""Random features per joint: enough for errors that are nearly Gaussian."""


def _kin() -> FloatArray:
    """(25, 25) independent errors of unit variance to those of the joints, correlated from parents to children."""
    kin = np.eye(N_JOINTS)
    for parent, child in BONES:
        kin[child] = _KINSHIP * kin[parent]
        kin[child, child] = np.sqrt(1.0 - _KINSHIP**2)
    return kin


_KIN: Final = _kin()


@dataclass(frozen=True, slots=True, eq=False)
class Misreading:
    """How a type of sensor misreads one person: drawn once, so that all sensors err alike in the same view and pose.

    All in units of the parameters of :class:`KinectErrors`, of standard deviation 1.

    Attributes:
        offset: (25, 3) in the body's frames: of the trunk (forward, left, up), or of the trunk turned as the limb's
            segment is turned from the T-pose (arms) or from standing (legs).
        frequencies: (25, m, 9) per unit of direction: of the view, of a joint's first and of its second segment.
        phases: (25, m) radians.
        amplitudes: (25, m, 4) of the error to the right, down and along the ray, and of the length.
    """

    offset: FloatArray
    frequencies: FloatArray
    phases: FloatArray
    amplitudes: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Misreading:
        """A person at random; a smooth random function by Rahimi and Recht 2007, of a Gaussian kernel."""
        shape = (N_JOINTS, _FEATURES)
        return cls(
            _KIN @ rng.normal(size=(N_JOINTS, 3)),
            rng.normal(size=(*shape, 9)),
            rng.uniform(0.0, 2.0 * np.pi, shape),
            rng.normal(size=(*shape, 4)) * np.sqrt(2.0 / _FEATURES),
        )

    def at(self, directions: FloatArray, turn: float) -> FloatArray:
        """(n, 25, 4) errors at (n, 25, 9) directions, with another error after a turn by ``turn`` radians."""
        angles = np.einsum("njd,jmd->njm", directions, self.frequencies / turn, optimize=True) + self.phases
        result: FloatArray = np.einsum("njm,jme->nje", np.cos(angles), self.amplitudes, optimize=True)
        return result


# --- the sensor


@dataclass(frozen=True, slots=True)
class SimulatedKinect:
    """A Kinect v2 at its place, with its clock and its errors.

    Attributes:
        pose: of its optical frame in ``world``; its name is the sensor's.
        clock: its clock against the reference clock.
        phase: seconds of its first frame after the start.
        errors: how much it errs.
        dark: whether it is dark: it then takes half as many frames.
    """

    pose: SensorPose
    clock: ClockModel = field(default_factory=ClockModel)
    phase: float = 0.0
    errors: KinectErrors = field(default_factory=KinectErrors)
    dark: bool = False

    @property
    def rate(self) -> float:
        """Frames per second of its own clock."""
        return DARK_RATE if self.dark else RATE

    def capture_times(self, duration: float, rng: np.random.Generator) -> FloatArray:
        """(n,) seconds at which it takes its frames, in order: at the rate of its own clock, with jitter."""
        period = 1.0 / (self.rate * (1.0 + self.clock.drift_ppm * 1e-6))
        times = np.arange(self.phase, duration, period)
        moved = np.clip(rng.normal(scale=self.errors.jitter, size=len(times)), -0.3 * period, 0.3 * period)
        result: FloatArray = times + moved
        return result

    def observe(
        self,
        times: FloatArray,
        truth: FloatArray,
        capsules: Capsules,
        start_ns: int,
        received_from_ns: int,
        rng: np.random.Generator,
        body: int = 0,
        misreading: Misreading | None = None,
    ) -> list[RecordedFrame]:
        """The frames of one person that arrive, in order of receipt.

        Args:
            times: (n,) seconds of the captures after the start.
            truth: (n, 25, 3) metres, true joints in ``world`` at these times.
            capsules: the person's flesh.
            start_ns: the start in the reference clock.
            received_from_ns: the start in the receiver's clock.
            rng: where all chance comes from.
            body: the sensor's number of the person.
            misreading: of this person; the same for all sensors, or drawn where none is given.

        Raises:
            SimulatedKinectError: times or truth of another shape, or not finite.
        """
        seen = self.see(times, truth, capsules, rng, misreading)
        return self.deliver(times, {body: seen}, start_ns, received_from_ns, rng)

    def see(
        self,
        times: FloatArray,
        truth: FloatArray,
        capsules: Capsules,
        rng: np.random.Generator,
        misreading: Misreading | None = None,
        others: Sequence[tuple[FloatArray, Capsules]] = (),
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """What it makes of one person; arguments as of :meth:`observe`.

        Args:
            times: as there, like all that follows but the last.
            truth: as there.
            capsules: as there.
            rng: as there.
            misreading: as there.
            others: who may stand before the person: (n, 25, 3) metres, true joints in ``world``, and flesh of each.

        Returns:
            (n, 25, 3) metres in the optical frame, NaN where a joint is not tracked, and its (n, 25) states.
        """
        if times.ndim != 1 or truth.shape != (len(times), N_JOINTS, 3) or not np.isfinite(truth).all():
            raise SimulatedKinectError(
                f"simulated Kinect {self.pose.sensor}: times {times.shape}, truth {truth.shape}, expected (n,) and"
                f" (n, {N_JOINTS}, 3), finite"
            )
        if misreading is None:
            misreading = Misreading.draw(rng)
        if len(times) == 0:
            return np.empty((0, N_JOINTS, 3)), np.empty((0, N_JOINTS), dtype=np.uint8)
        sight = (truth - self.pose.translation) @ self.pose.rotation
        steps = np.diff(times)
        period = float(np.median(steps)) if len(steps) else 1.0 / self.rate
        veiled = np.zeros(sight.shape[:2])
        for joints, flesh in others:
            other = (joints - self.pose.translation) @ self.pose.rotation
            np.maximum(veiled, veil(sight, capsules, other, flesh), out=veiled)
        return _Sighting(self.errors, period, rng).of(sight, capsules, misreading, veiled)

    def deliver(
        self,
        times: FloatArray,
        bodies: Mapping[int, tuple[FloatArray, NDArray[np.uint8]]],
        start_ns: int,
        received_from_ns: int,
        rng: np.random.Generator,
    ) -> list[RecordedFrame]:
        """The frames that arrive, in order of receipt; a frame without any tracked joint is none.

        Args:
            times: (n,) seconds of the captures after the start.
            bodies: what :meth:`see` says of these, by the sensor's numbers of the persons.
            start_ns: the start in the reference clock.
            received_from_ns: the start in the receiver's clock.
            rng: where all chance comes from.
        """
        errors, count = self.errors, len(times)
        lost = rng.random(count) < errors.lost
        received = times + errors.delay + rng.gamma(1.0, errors.delay_jitter, count)
        for begin, end in _events(times, errors.stall_rate, errors.stall_time, rng):
            during = slice(*np.searchsorted(times, (begin, end)))
            if rng.random() < 0.5:
                lost[during] = True
            else:
                received[during] = np.maximum(received[during], end + errors.delay)
        # a connection keeps the order: a frame that is held up holds up those behind it
        received = np.maximum.accumulate(received)
        frames = []
        for k in np.flatnonzero(~lost):
            stamp_ns = self.clock.to_sensor(start_ns + round(times[k] * NANOSECONDS))
            skeletons = tuple(
                Skeleton(stamp_ns, optical_frame(self.pose.sensor), positions[k], states[k], body)
                for body, (positions, states) in bodies.items()
                if states[k].any()
            )
            if skeletons:
                receipt_ns = received_from_ns + round(received[k] * NANOSECONDS)
                frames.append(RecordedFrame(self.pose.sensor, receipt_ns, skeletons))
        return frames


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The body that a sensor believes to see, over n frames.

    Attributes:
        trunk: (n, 3, 3) the trunk's axes (forward, left, up) in the optical frame, as columns.
        yaw: (n,) radians about its own axis from where it faces to the sensor, positive to its left.
        rays: (n, 25, 3, 3) unit vectors right, down and along the ray of each joint, as rows.
        growth: (n, 25) how many times greater errors are for the distance and the yaw.
        distance: (n, 25) how many times greater they are for the distance alone.
    """

    trunk: FloatArray
    yaw: FloatArray
    rays: FloatArray
    growth: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, sight: FloatArray, errors: KinectErrors) -> _View:
        trunk, yaw = _trunk(sight)
        far = np.linalg.norm(sight, axis=2)
        along = sight / np.maximum(far, 1e-9)[..., None]
        right = _unit(np.cross([0.0, 1.0, 0.0], along))
        rays = np.stack([right, np.cross(along, right), along], axis=2)
        distance = (far / REFERENCE_DISTANCE) ** errors.distance_growth
        grown = [1.0, 1.0, 1.0 + errors.growth_60, 1.0 + errors.growth_90]
        factor = np.interp(np.abs(yaw), np.radians([0.0, 30.0, 60.0, 90.0]), grown)[:, None]
        # the root of the mean square of both sides is the factor: the near side is seen nearly as well as ever
        away = _unit(sight[:, Joint.SPINE_MID])
        behind = np.einsum("nji,ni->nj", sight - sight[:, None, Joint.SPINE_MID], away)
        weight = np.where(_SPINE, _SPINE_WEIGHT, np.clip(1.0 + behind / _FAR_DEPTH, 0.1, 1.9))
        growth = distance * np.sqrt(1.0 + (factor**2 - 1.0) * weight)
        return cls(trunk, yaw, rays, growth, distance)

    def in_optical(self, errors: FloatArray) -> FloatArray:
        """(n, 25, 3) errors to the right, down and along the ray into the optical frame."""
        result: FloatArray = np.einsum("njk,njki->nji", errors, self.rays)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """Errs over frames at a regular ``period`` in seconds."""

    errors: KinectErrors
    period: float
    rng: np.random.Generator

    def of(
        self, sight: FloatArray, capsules: Capsules, misreading: Misreading, veiled: FloatArray
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """True joints in the optical frame, (n, 25) hidden by others, to reported ones and their states."""
        # one generator per kind of error, so that one kind does not depend on how often another one happens
        for_labels, for_slow, for_states, for_white = self.rng.spawn(4)
        before, in_view = obstruction(sight, capsules), _in_view(sight)
        labels = self._labels(sight, for_labels)
        sight = np.take_along_axis(sight, labels[..., None], axis=1)
        # the sensor knows the other for somebody else: what is hidden by others is not drawn to them
        covers = np.maximum(before.cover, veiled), np.where(veiled > before.cover, 0.0, before.nearer)
        cover, nearer = (np.take_along_axis(values, labels, axis=1) for values in covers)
        in_view = np.take_along_axis(in_view, labels, axis=1)

        view = _View.of(sight, self.errors)
        segments = _unit(sight - sight[:, _PARENTS])
        anatomy = sight + self._offset(view, segments, misreading)
        slow, length = self._slow(anatomy, view, segments, misreading, for_slow)
        placed = anatomy + self._shape(sight, view) + slow
        placed += self._hidden(view, cover, nearer, for_slow)
        self._keep_lengths(placed, anatomy, length)
        placed += self._new(view, for_white)
        states = self._states(cover, in_view, for_states)
        states[self._unseen(veiled)] = TrackingState.NOT_TRACKED
        placed[states == TrackingState.NOT_TRACKED] = np.nan
        return placed, states

    def _labels(self, sight: FloatArray, rng: np.random.Generator) -> IntArray:
        """(n, 25) which joint the sensor takes for which."""
        errors, count = self.errors, len(sight)
        times: FloatArray = self.period * np.arange(count, dtype=np.float64)
        labels = np.tile(np.arange(N_JOINTS, dtype=np.intp), (count, 1))
        _, yaw = _trunk(sight)
        labels[self._mirrored(np.abs(yaw), times, rng)] = MIRROR
        for limbs in (_ARMS, _LEGS):
            which = np.flatnonzero(limbs)
            for begin, end in _events(times, errors.limb_swap_rate, errors.hang_over, rng):
                during = slice(*np.searchsorted(times, (begin, end)))
                labels[during, which] = labels[during, MIRROR[which]]
        return labels

    def _mirrored(self, yaw: FloatArray, times: FloatArray, rng: np.random.Generator) -> BoolArray:
        """(n,) whether the sensor exchanges left and right; yaw (n,) radians from 0 to pi."""
        errors = self.errors
        back = yaw > np.pi / 2 + errors.mirror_hysteresis
        front = yaw < np.pi / 2 - errors.mirror_hysteresis
        mirrored: BoolArray = np.zeros_like(back)
        edges = np.flatnonzero(np.diff(back, prepend=False, append=False))
        for begin, end in edges.reshape(-1, 2):
            # who turns back is seen rightly when it cannot be mistaken any more, or a while before
            until = min(end + round(rng.exponential(errors.mirror_time) / self.period), len(yaw))
            seen = np.flatnonzero(front[end:until])
            mirrored[begin : end + int(seen[0]) if len(seen) else until] |= rng.random() < errors.mirrored
        # at 45 degrees a quarter as often as from the side
        likely = np.sin(yaw) ** 4
        for begin, end in _events(times, errors.mirror_rate, errors.mirror_time, rng):
            first, last = np.searchsorted(times, (begin, end))
            if rng.random() < likely[min(first, len(likely) - 1)]:
                mirrored[first:last] ^= True
        return mirrored

    def _shape(self, sight: FloatArray, view: _View) -> FloatArray:
        """(n, 25, 3) displacement: straightened spine, damped lift of the shoulders, body turned less than it is."""
        errors, moved = self.errors, np.zeros_like(sight)
        base, top = sight[:, Joint.SPINE_BASE], sight[:, Joint.SPINE_SHOULDER]
        chord, middle = top - base, sight[:, Joint.SPINE_MID] - base
        share = (middle * chord).sum(axis=1) / np.maximum((chord * chord).sum(axis=1), 1e-9)
        moved[:, Joint.SPINE_MID] = errors.straightening * (share[:, None] * chord - middle)

        up = view.trunk[:, :, 2]
        turn = errors.turn_loss * view.yaw * np.sin(view.yaw) ** 4
        for centre, root, followers in _FOLLOWS:
            for side in ("LEFT", "RIGHT"):
                end = Joint[f"{root}_{side}"]
                arm = sight[:, end] - sight[:, centre]
                turned = _turned(arm, up, turn) - arm
                moved[:, end] += turned
                for name, much in followers.items():
                    moved[:, Joint[f"{name}_{side}"]] += much * turned
                if root == "SHOULDER":
                    level = np.einsum("ni,ni->n", arm, up)
                    lift = np.maximum(level - _REST_LEVEL * np.linalg.norm(arm, axis=1), 0.0)
                    moved[:, end] -= errors.lift_damping * lift[:, None] * up
        return moved

    def _offset(self, view: _View, segments: FloatArray, misreading: Misreading) -> FloatArray:
        """(n, 25, 3) what is constant: in the body's frames, and along the ray."""
        constant = self.errors.anatomical * ANATOMICAL + self.errors.offset * SLOW_SCALE[:, None] * misreading.offset
        offset = np.einsum("nik,jk->nji", view.trunk, constant)
        # limbs: by the least rotation that takes the segment's rest direction to where it points
        limbs = ~_ON_TRUNK
        rest = np.einsum("nik,jk->nji", view.trunk, _REST[limbs])
        offset[:, limbs] = _least_rotation(rest, segments[:, limbs], offset[:, limbs])
        result: FloatArray = offset + self.errors.depth_offset * DEPTH_PATTERN[:, None] * view.rays[:, :, 2]
        return result

    def _slow(
        self,
        anatomy: FloatArray,
        view: _View,
        segments: FloatArray,
        misreading: Misreading,
        rng: np.random.Generator,
    ) -> tuple[FloatArray, FloatArray]:
        """What persists, with the pose and with time: (n, 25, 3) displacement, (n, 25) how much longer segments are.

        A joint's segment is the one from its anchor; the displacement has the lengths in it.
        """
        errors = self.errors
        pointing = np.einsum("nki,njk->nji", view.trunk, segments)
        towards = np.einsum("nki,nk->ni", view.trunk, -_unit(anatomy[:, Joint.SPINE_MID]))
        towards = np.broadcast_to(towards[:, None], pointing.shape)
        directions = np.concatenate([towards, pointing[:, _FIRST], pointing[:, _SECOND]], axis=2)
        posed = misreading.at(directions, errors.bias_turn)
        wandering = self._wander((*anatomy.shape[:2], 4), rng)
        joint = _KIN @ (errors.bias * posed[..., :3] + errors.drift * wandering[..., :3])
        displacement = view.in_optical((SLOW_SCALE * view.growth)[..., None] * _RAY_AXES * joint)
        length = errors.length_spread * np.sqrt(0.5) * (posed[..., 3] + wandering[..., 3])[:, _VARYING]
        return displacement + length[..., None] * (anatomy - anatomy[:, _ANCHORS]), length

    def _hidden(self, view: _View, cover: FloatArray, nearer: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(n, 25, 3) displacement of hidden joints; those of the trunk are not drawn to what hides them."""
        errors = self.errors
        half = 0.5 * errors.hidden_from
        hidden = np.clip((cover - half) / half, 0.0, 1.0)
        drawn = self._lag(errors.drag * hidden * np.where(_ON_TRUNK, 0.0, nearer))
        size = errors.guess * self._lag(hidden) * SLOW_SCALE * view.distance
        guessed = size[..., None] * _RAY_AXES * self._wander((*cover.shape, 3), rng)
        guessed[..., 2] -= drawn
        return view.in_optical(guessed)

    @staticmethod
    def _keep_lengths(placed: FloatArray, anatomy: FloatArray, longer: FloatArray) -> None:
        """Move the limbs' joints of ``placed``, from the trunk outwards, to nearly their lengths."""
        for joints in _CHAINS:
            parents = _PARENTS[joints]
            way = placed[:, joints] - placed[:, parents]
            now = np.linalg.norm(way, axis=2)
            kept = np.linalg.norm(anatomy[:, joints] - anatomy[:, parents], axis=2) * (1.0 + longer[:, joints])
            placed[:, joints] += (_STIFFNESS * (kept - now) / np.maximum(now, 1e-3))[..., None] * way

    def _new(self, view: _View, rng: np.random.Generator) -> FloatArray:
        """(n, 25, 3) white noise, and outliers of one to three frames."""
        errors, shape = self.errors, view.growth.shape
        noise = errors.white * (WHITE_SCALE * view.growth)[..., None] * _RAY_AXES * rng.normal(size=(*shape, 3))
        result = view.in_optical(noise)
        for frame, joint in np.argwhere(rng.random(shape) < errors.outlier_rate * self.period):
            jump = rng.uniform(0.5, 1.5) * errors.outlier_size * _unit(rng.normal(size=3))
            result[frame : frame + rng.integers(1, 4), joint] += jump
        return result

    def _states(self, cover: FloatArray, in_view: BoolArray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(n, 25) tracking states."""
        errors, shape = self.errors, cover.shape
        hidden = self._lag(cover)
        # what is said of a hidden joint is said for a while
        chance = self._wander(shape, rng)
        inferred = (hidden > errors.hidden_from) & (chance > ndtri(errors.mislabelled))
        lost = inferred & (hidden > _MIDDLE) & (chance > -ndtri(errors.given_up))
        flickers = rng.random(shape) < errors.flicker * _FLICKERS
        states = np.where(inferred | flickers, TrackingState.INFERRED, TrackingState.TRACKED).astype(np.uint8)
        states[lost | ~in_view] = TrackingState.NOT_TRACKED
        return states

    def _unseen(self, veiled: FloatArray) -> BoolArray:
        """(n,) when the body is lost: most of the trunk behind others, and for a moment after that."""
        hidden = (veiled[:, _ON_TRUNK] > self.errors.hidden_from).mean(axis=1) > _LOST_FROM
        until = np.convolve(hidden, np.ones(1 + round(_FIND_AGAIN / self.period)))[: len(hidden)]
        return until > 0.5

    def _wander(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """A smooth process of unit variance over the first axis: an Ornstein-Uhlenbeck process, followed by another.

        Its correlation is (1 + t) exp(-t) after a time t in units of half the ``drift_time`` (Matern, 3/2).
        """
        keep = np.exp(-2.0 * self.period / self.errors.drift_time)
        settle = int(np.ceil(5.0 * self.errors.drift_time / self.period))
        drive = rng.normal(size=(settle + shape[0], *shape[1:])) * np.sqrt((1.0 - keep**2) ** 3 / (1.0 + keep**2))
        result: FloatArray = lfilter([1.0], [1.0, -2.0 * keep, keep**2], drive, axis=0)[settle:]
        return result

    def _lag(self, values: FloatArray) -> FloatArray:
        """(n, ...) values as they are followed with a delay, from rest."""
        keep = np.exp(-self.period / max(self.errors.hang_over, 1e-9))
        result: FloatArray
        result, _ = lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * values[:1])
        return result


def _events(times: FloatArray, rate: float, duration: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """(begin, end) in seconds of what happens at random, lasting at random."""
    span = float(times[-1] - times[0]) if len(times) else 0.0
    begins = times[:1] + np.sort(rng.uniform(0.0, span, rng.poisson(rate * span)))
    return [(float(begin), float(begin + rng.exponential(duration))) for begin in begins]


def _unit(vectors: FloatArray) -> FloatArray:
    """(..., 3) vectors of length 1; 0 stays 0."""
    result: FloatArray = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    return result


def _trunk(sight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) the trunk's axes (forward, left, up) as columns, and (n,) radians from forward to the sensor."""
    up = _unit(sight[:, Joint.SPINE_SHOULDER] - sight[:, Joint.SPINE_BASE])
    across = body_heading(sight)
    left = _unit(across - (across * up).sum(axis=1, keepdims=True) * up)
    forward = np.cross(left, up)
    towards = -sight[:, Joint.SPINE_SHOULDER]
    yaw = np.arctan2((towards * left).sum(axis=1), (towards * forward).sum(axis=1))
    return np.stack([forward, left, up], axis=2), yaw


def _turned(vectors: FloatArray, axis: FloatArray, angle: FloatArray) -> FloatArray:
    """(n, 3) vectors turned about (n, 3) unit axes by (n,) radians (Rodrigues)."""
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    along = (vectors * axis).sum(axis=1, keepdims=True)
    result: FloatArray = vectors * cos + np.cross(axis, vectors) * sin + axis * along * (1.0 - cos)
    return result


def _least_rotation(start: FloatArray, end: FloatArray, vectors: FloatArray) -> FloatArray:
    """(..., 3) vectors turned as the least rotation turns unit vectors ``start`` into ``end``."""
    cos = (start * end).sum(axis=-1, keepdims=True)
    axis = np.cross(start, end)
    along = (axis * vectors).sum(axis=-1, keepdims=True) / np.maximum(1.0 + cos, 0.05)
    result: FloatArray = cos * vectors + np.cross(axis, vectors) + along * axis
    return result


def _in_view(sight: FloatArray) -> BoolArray:
    """(n, 25) which joints lie in the frustum and the range."""
    x, y, z = np.moveaxis(sight, 2, 0)
    across, down = (np.tan(0.5 * angle) * z for angle in FIELD_OF_VIEW)
    seen: BoolArray = (np.abs(x) <= across) & (np.abs(y) <= down) & (z >= RANGE[0]) & (z <= RANGE[1])
    return seen

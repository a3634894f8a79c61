"""The extended Kalman filter on a body model whose covariance is meant: ``ekf``.

State: the model's configuration, its segment lengths and its tangent velocities. The error of the configuration lives
in the tangent space (an error-state filter, Sola 2017), because base and shoulders turn freely; filterpy's
ExtendedKalmanFilter, whose state is a plain vector and whose update inverts what is factored here, does not fit.

- Motion: each velocity is an Ornstein-Uhlenbeck process (it fades with ``velocity_time``), driven by white noise whose
  density each joint finds for itself: as long as it is right, the corrections of the velocities are white and as large
  as the covariance says; where they lean to one side, the person moves more briskly than assumed.
- Measurement noise: a sensor's white noise is read off the third differences of each point over time, in which smooth
  motion all but cancels; no tuning for a sensor. What its points are wrong by for seconds (a joint placed beside the
  anatomical one) is a state of its own that is considered but not estimated (Schmidt 1966), with the deviation of
  ``body_tracking.measurement`` scaled until the innovations are as large as expected.
- Lengths are estimated for the first seconds. From then on they are what the distances between points say over many
  poses (``lengths``), and only considered here: what errs for seconds would otherwise be learnt as a length. They are
  brought in every second, until they are known to some millimetres or for a minute, and then stay as they are.
- Ranges of motion bound what nothing observes. They enter as rarely as they would be new information.
- Where a sensor takes the centres of the joints to be, beside the anatomical ones, never changes, is the same for all
  sensors of a kind, and so shows in no innovation. What it does to the pose is added to what is handed out.
- Orientations of segments by inertial sensors come at their own times, and what their sources err by is estimated
  behind the state of the body (``orientation``); without any of them nothing is there, and nothing is different.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from scipy.linalg import block_diag
from scipy.linalg.lapack import dpotrf, dtrtri, dtrtrs
from scipy.special import chdtri

from body_tracking.filters import orientation
from body_tracking.filters.linear import FilterError
from body_tracking.filters.orientation import PER_SOURCE, OrientationParameters, Sources
from body_tracking.kinematics import so3
from body_tracking.kinematics.estimate import ModelEstimate
from body_tracking.kinematics.inverse import InverseKinematics
from body_tracking.kinematics.lengths import SegmentLengths, proportions
from body_tracking.kinematics.model import Linearisation, ModelError
from body_tracking.kinematics.ranges import TWIST_SHARING_STDDEV, Ranges
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.measurement import BASE_STDDEV, INFERRED_FACTOR
from body_tracking.orientation import SEGMENT_NUMBER, SegmentOrientation
from body_tracking.parameters import check_fields, number_field
from body_tracking.skeleton import (
    BONES,
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)

_DIMENSIONS = 3
_TRACKED, _INFERRED = np.uint8(TrackingState.TRACKED), np.uint8(TrackingState.INFERRED)
_EYE3 = np.eye(_DIMENSIONS)
_MEAN = np.full(_DIMENSIONS, 1.0 / _DIMENSIONS)
_MEAN_VARIANCE = _EYE3.reshape(-1) / _DIMENSIONS
"""(9,) factors of a covariance, row by row."""
_UNKNOWN = np.zeros((N_JOINTS, _DIMENSIONS, _DIMENSIONS))
_UNKNOWN[:] = np.diag([np.inf] * _DIMENSIONS)
_START_FRAMES = 4
"""Frames of one sensor that tell its noise."""
_WAIT_NS = NANOSECONDS // 2
"""Frames farther apart than this do not make a start together."""
_FLOOR = 1e-3
"""Metres: no sensor's white noise is taken for less."""
_MAX_COORDINATE = 100.0
_MAX_SLOW = np.array([9.0, 1.0])
"""Greatest scales of the slow variance: of points three times the model's deviation, of limbs as it is stated."""
_THIRD_DIFFERENCE_SPAN = 0.25
"""Seconds beyond which four frames in a row show motion, not noise."""
_CORRELATED = 2.31
"""So many third differences in a row, which overlap, tell of a variance as much as one and those after it, apart."""
_NOISE_FRAMES = 600.0
"""Frames over which the white noise of a point is averaged."""
_POOL = 8.0
"""Frames from which on a point's own noise counts alone."""
_OUTLYING = 6.0
"""A squared difference counts as at most so many times the variance."""
_NEGLIGIBLE_SLOW = 1e-3
_STRETCH = 0.1
"""Share of the length of an upper arm or forearm that a sensor, at unit scale of its slow errors, is wrong by."""
_SLOW_BOUND = 25.0
_FORESEEABLE = 0.1
"""Metres: standard deviation of a predicted point up to which its innovation tells of slow errors."""
_MEDIAN_OF_CHI2 = 0.455
_LEAST_ERROR = 0.004
"""Metres: no sensor knows where the centre of a joint is better than this."""
_SIGNIFICANT = 2.0
"""Standard deviations above zero from which a scale of slow errors is used."""
_SLOW_PERIOD_NS = NANOSECONDS // 15
_SLOW_STEP = 0.02
"""Share by which a scale changes at least: what it did to the state before has to be put right each time."""
_SLOW_MEMORY = 0.7
"""Seconds over which the scale of the slow errors is averaged."""
_WHITENESS_TIME = 0.25
"""Seconds over which corrections of a velocity are summed: about what the filter takes to follow a movement."""
_OF_SPEED = 16.0
"""1/s: beside orientations the density of a joint's acceleration besides, per square of its speed. Who swings a limb
twice a second accelerates it by 4 pi times its speed for about a tenth of a second; what a pose is too slow to follow
is taken for errors of the sources."""
_UNTOUCHED = 0.02
_RATIO_BOUND = 8.0
_DENSITY_DOWN, _DENSITY_UP = 3.0, 4.0
_PRIOR_PERIOD = 0.1
"""Seconds between two looks at the ranges of motion."""
_POSTURE_TIME = 10.0
"""Seconds for which people hold a trunk alike: to sources of orientations the middle of its ranges is news once in
twice that time, however often it is told."""
_VAGUE = 0.5
"""Share of the range's deviation from which an angle is drawn to the middle of its range."""
_SPURIOUS = 0.7
"""Share of what the ranges say below which the variance of an unobserved direction is taken to be false."""
_SETTLE_AFTER = 0.3
"""Share of the settle time before which no length stays: a person has to be seen in more than one pose."""
_NULL = 1e-6
"""Singular value, as a share of the greatest, below which a direction moves no point."""
_LIMIT_STDDEV = 3.0
"""Degrees: how softly limits push back, each time."""
_HARD_STDDEV = 0.2
_PROJECTIONS = 3
_FAR_BEYOND, _BACK_TO = np.radians(10.0), np.radians(8.0)
"""An estimate farther beyond a range than the first is brought back to the second."""
_REST_NS = NANOSECONDS // 4
"""At least so long from one search for another pose to the next."""
_MOST_ATTEMPTS = 4
"""Times that the rest doubles where the strain is back soon after another pose was looked for: sensors that contradict
each other are the cause then, and no pose is right for all of them."""
_SOON = 4
"""Rests after which it is another matter."""
_LOOK_NS = NANOSECONDS // 2
"""The same where only a hand is suspected, which much noise makes it be time and again, and lengths stay as they are:
these do not give way to a wrong hand, and its strain remains."""
_WHOLE = 15
"""Points that a frame must show to tell a person's size from."""
_AWAY_NS = NANOSECONDS // 4
"""Unseen for longer than this, a limb may have turned farther than a linearisation reaches."""
_LINEARISATIONS = 4
_FAR, _CLOSE = 0.2, 0.05
"""Radians: a correction farther than the first is linearised anew, until it changes by less than the second."""
_SUDDEN, _SUDDEN_TIME = 20.0, 0.05
"""m/s2 that a joint may be accelerated by beyond expectation (standard deviation), and the longest time for which."""
_DRAWING = 3.0
"""Squared Mahalanobis distance that a point is taken for which has been rejected for long."""
_MOST_GROWN = 100.0
_MUCH_BETTER = 0.5
_LEAN_TIME, _LEAN_FRAMES = 0.3, 4.0
"""Seconds over which innovations are averaged, and how many it takes to see them lean."""
_STRAINED = 4.0
"""Squared Mahalanobis distance of a mean innovation that a filter in the right pose does not come to: it stays below 1
with little noise and below 3 with much; a hand that is bent and turned the wrong way about comes to 2 to 5."""
_SUSPICIOUS = 1.0
"""The same, from which it is worth a look whether a hand is bent and turned the wrong way about. That is seldom with
little noise, and most of the time in such a pose: lengths that are still learnt give way to it."""
_LIKELIER = 3.0
"""Half the difference of two costs, the logarithm of how much likelier a pose is: 20 to 1."""
_MISFIT = 0.02
"""Metres by which a person's points lie beside any pose of the model for a while."""
_FIRST_SPEED, _FIRST_TURN_RATE = 0.3, 1.0
"""m/s and rad/s: standard deviation of the velocities of a person who is first seen."""
_ENOUGH_BLOCKS = 5
"""Seconds of frames from which on the lengths are what these say."""
_LENGTHS_PERIOD = 0.75
"""Seconds that they are left alone for: several sensors' blocks of a second are brought in together."""
_AHEAD_OF = 0.9
"""Share of the period of the greatest rate from which on the next orientation counts: clocks jitter."""
_TOGETHER_NS = NANOSECONDS // 125
"""An orientation so soon after the state is compared with where that is heading for: it saves a prediction, and what
the motion model adds in the meantime (1 mrad) comes with the next one."""
_HELD_STDDEV = 0.02
"""Radians by which what moves a pose without any measurement may turn a segment whose orientation is measured."""
_HELD_FOR_NS = NANOSECONDS // 4
"""A source that is silent for longer does not hold its segment any more."""
_CONTRADICTION = 0.8
"""Radians by which no other pose that points suggest may turn such a segment at once."""
_LONGEST_WAIT_NS = NANOSECONDS // 10
"""Orientations that nobody asks for wait no longer than this."""
_SLIP_TIME = 0.5
"""Seconds over which innovations of orientations are summed, to see them lean."""
_SLIPPED = 30.0
"""Squared normalised sum that a source which fits does not come to (chi-square with 3 degrees of freedom)."""
_UNPLACED_STDDEV, _UNTURNED_STDDEV = 100.0, 1.0
"""Metres and radians: of the base where orientations alone start the body."""
_BENT, _ARM_OFFSETS = ("SHOULDER", "ELBOW", "WRIST"), 2.0
"""Joints that show which way an arm is bent, and how many times the usual distance their centres are off for that: a
Kinect v2 sees hanging arms bent to where they are not (13 cm at the wrist, simulated as calibrated with recordings)."""
_ANOTHER_SIZE = 1.2
"""Times that a person is larger or smaller than the one before, who must be another one."""


@dataclass(frozen=True, slots=True)
class EkfParameters(OrientationParameters):
    """The settings of the extended filter; each field's metadata says what it is, its unit and its range.

    Raises:
        FilterError: a value out of its range.
    """

    velocity_time: float = number_field(0.8, "time in which a velocity fades when nothing renews it", "s", 0.05, 100.0)
    density_translation: float = number_field(
        1.0, "spectral density of the base's acceleration per axis, before it is learnt", "m2/s3", 1e-5, 1e3
    )
    density_trunk: float = number_field(
        2.0,
        "spectral density of the angular acceleration of the base's tilt, spine, neck, clavicles, at first",
        "rad2/s3",
        1e-4,
        1e4,
    )
    density_turn: float = number_field(
        20.0,
        "spectral density of the angular acceleration with which the whole person turns, at first: people stand, and "
        "then turn at once",
        "rad2/s3",
        1e-4,
        1e4,
    )
    density_limb: float = number_field(
        3.0, "spectral density of the angular acceleration of shoulders and elbows, at first", "rad2/s3", 1e-4, 1e4
    )
    density_hand: float = number_field(
        3.0, "spectral density of the angular acceleration of forearms and wrists, at first", "rad2/s3", 1e-4, 1e4
    )
    density_rate: float = number_field(
        0.1, "how quickly the densities follow the movement; 0 leaves them", "1", 0.0, 10.0
    )
    white_stddev: float = number_field(
        0.01, "standard deviation of a sensor's white noise before it is learnt", "m", 0.0005, 0.5
    )
    slow_scale: float = number_field(
        0.3,
        "variance of the slow errors of a sensor that states covariances, as a share of these, before it is learnt",
        "1",
        0.0,
        9.0,
    )
    offset_scale: float = number_field(
        1.0,
        "distance of the joints' centres by a sensor that states covariances from the anatomical ones, in standard "
        "deviations of body_tracking.measurement; no filter can know it, and it is added to what is handed out",
        "1",
        0.0,
        10.0,
    )
    slow_time: float = number_field(3.0, "time for which a sensor's slow errors persist", "s", 0.05, 1000.0)
    gate_probability: float = number_field(
        0.9999,
        "a point is rejected where its innovation lies beyond this chi-square quantile (3 degrees of freedom)",
        "1",
        0.5,
        1.0,
    )
    reacquire_after: float = number_field(
        0.12,
        "points rejected without a break for longer than this may start the pose anew, where it fits them",
        "s",
        0.0,
        60.0,
    )
    settle_stddev: float = number_field(
        0.003, "lengths stay as they are from when they are known as well as this", "m", 1e-5, 1.0
    )
    settle_time: float = number_field(60.0, "at the latest lengths stay as they are from this time on", "s", 0.1, 1e5)
    late_window: float = number_field(0.2, "frames that come late by no more than this still count", "s", 0.0, 2.0)
    predict_for: float = number_field(
        2.0, "without any measurement for longer than this the person is lost", "s", 0.0, 60.0
    )

    def __post_init__(self) -> None:
        check_fields(self, "extended filter", FilterError)


class _Changeable:
    """A frozen dataclass without slots that is copied often."""

    def but(self, **changes: Any) -> Self:
        """What ``dataclasses.replace`` makes, which takes thirty times as long for that many fields."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.__dict__.update(changes)
        return other


@dataclass(frozen=True, slots=True, eq=False)
class _SlowBasis:
    """Displacement (57, 61) of the points by each slow error of unit variance.

    Attributes:
        points: (57,) by those of each point alone, the diagonal of the first 57 columns.
        limbs: (57, 4) by those of the limbs, the last columns.
    """

    points: FloatArray
    limbs: FloatArray

    def of(self, crosses: FloatArray) -> FloatArray:
        """(n, 57) covariance with the displacement, of what has (n, 61) with the slow errors: C B^T."""
        count = len(self.points)
        result: FloatArray = crosses[:, :count] * self.points + crosses[:, count:] @ self.limbs.T
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Measurement:
    """One frame of one sensor, on the model's points.

    Attributes:
        sensor: who measured.
        stamp_ns: capture time.
        positions: (19, 3) metres in world; 0 where not measured.
        measured: (19,) which are.
        model_variance: (19,) square metres per axis by the measurement model, of white and slow errors together.
        skeleton: where it comes from.
    """

    sensor: str
    stamp_ns: int
    positions: FloatArray
    measured: BoolArray
    model_variance: FloatArray
    skeleton: Skeleton


@dataclass(frozen=True, eq=False)
class _SensorState(_Changeable):
    """What the filter has learnt of a sensor.

    Attributes:
        stamps: nanoseconds of its last (at most 3) frames.
        positions: (k, 19, 3) their points, NaN where not used.
        white: (19,) variance of the white noise per axis, square metres.
        differences: (19,) mean of the squared differences of each point alone.
        weight: (19,) how many of these there were.
        slow: (2,) scales of the slow variance: of points by themselves, of limbs.
        slow_estimate: (2,) their running estimates, of which only significant ones are used.
        slow_information: (2,) of the estimates.
        stated: it says itself how much it errs, as one that was measured against anatomy does.
    """

    stamps: tuple[int, ...]
    positions: FloatArray
    white: FloatArray
    differences: FloatArray
    weight: FloatArray
    slow: FloatArray
    slow_estimate: FloatArray
    slow_information: FloatArray
    stated: bool


_NOBODY = Sources.none()


@dataclass(frozen=True, eq=False)
class _State(_Changeable):
    """Everything that changes; never written into, so that an earlier one can be gone on from.

    Attributes:
        stamp_ns: of the state.
        q, lengths, velocity: the estimate.
        covariance: (85, 85) of the tangent, the lengths and the velocities; m more of m / 7 sources of orientations.
        log_density: (groups,) log of the spectral density of each group of coordinates.
        moved: (32,) faded sum of the corrections of the velocities.
        moved_variance: (32,) its variance, if all is right.
        sensors: what is known of each.
        slow_names: (n,) those with whose slow errors the state is correlated.
        crosses: (85 + m, 61 n) covariance of the state with the slow errors of these, in units of their deviation.
        rejected_for: (19,) seconds.
        lean: (19, 3) metres, faded mean of the innovations: where a wrong pose shows that no frame alone gives away.
        leaning: (19,) how many innovations it is worth.
        strain: the greatest squared Mahalanobis distance of such a mean (chi-square with 3 degrees of freedom).
        used_ns: (19,) stamp of the last accepted measurement of each point.
        since_prior: seconds since ranges of motion were last brought in.
        tracked: seconds since the start.
        settled: the lengths are only considered.
        seen: what tells the lengths; None from when they stay as they are.
        measured_at: seconds since the start at which these were last brought in.
        null: (k, 32) directions of the tangent that move no point.
        fresh: started from a frame, without any after it.
        attempted_ns: when another pose was looked for last.
        attempts: how often that was, each time soon after the last.
        sources: of orientations.
        oriented_ns: stamp of the last accepted orientation.
        unplaced: started by orientations: nothing tells where the base is.
    """

    stamp_ns: int
    q: FloatArray
    lengths: FloatArray
    velocity: FloatArray
    covariance: FloatArray
    log_density: FloatArray
    moved: FloatArray
    moved_variance: FloatArray
    sensors: dict[str, _SensorState]
    slow_names: tuple[str, ...]
    crosses: FloatArray
    rejected_for: FloatArray
    lean: FloatArray
    leaning: FloatArray
    strain: float
    used_ns: IntArray
    since_prior: float
    tracked: float
    settled: bool
    seen: SegmentLengths | None
    null: FloatArray
    measured_at: float = 0.0
    fresh: bool = False
    attempted_ns: int = 0
    attempts: int = 0
    sources: Sources = _NOBODY
    oriented_ns: int = 0
    unplaced: bool = False

    def cross(self, name: str) -> FloatArray | None:
        """(85, 61) of ``crosses``, those of one sensor; None for zero."""
        if name not in self.slow_names:
            return None
        place, size = self.slow_names.index(name), self.crosses.shape[1] // len(self.slow_names)
        return self.crosses[:, place * size : (place + 1) * size]


@dataclass(frozen=True, slots=True, eq=False)
class _Expected:
    """A frame against what was expected of it.

    Attributes:
        observation: (57, 53) derivative of the points by tangent and lengths of the state.
        innovation: (57,) metres, for a state without any correction.
        covariance: (57, 57) of the innovation.
        own: (19, 3, 3) its blocks of single points, with what curvature adds.
        unstretched: (19, 3, 3) the same without limbs that are too long or too short.
        cross: (85, 57) covariance of the state with the innovation.
        basis: of the slow errors; None where these are negligible.
    """

    observation: FloatArray
    innovation: FloatArray
    covariance: FloatArray
    own: FloatArray
    unstretched: FloatArray
    cross: FloatArray
    basis: _SlowBasis | None


class ExtendedKalmanFilter:
    """The filter ``ekf``.

    Attributes:
        model: the body.
        counters: what happened since the construction, for diagnostics.
        innovation_distance: the last frame's normalised innovation squared over all its accepted points.
        innovation_dimension: its expectation.
    """

    def __init__(self, parameters: EkfParameters | None = None, model: UpperBody | None = None) -> None:
        self.parameters = p = parameters or EkfParameters()
        self.model = model or UpperBody()
        self.ranges = Ranges(self.model)
        self.inverse = InverseKinematics(self.model, self.ranges)
        self._points = len(self.model.joints)
        self._nv, self._nl = self.model.nv, len(self.model.length_names)
        self._observed = self._nv + self._nl
        self._size = self._observed + self._nv
        self._tangent = slice(0, self._nv)
        self._lengths = slice(self._nv, self._observed)
        self._velocities = slice(self._observed, self._size)
        self._ball_rows = self.model.ball_v.reshape(-1)
        self._base_variance = BASE_STDDEV[self.model.joints] ** 2
        self._gate = float(chdtri(_DIMENSIONS, 1.0 - p.gate_probability))
        self._group, self._first_log_density = self._groups()
        self._log_density_bounds = self._first_log_density - _DENSITY_DOWN, self._first_log_density + _DENSITY_UP
        self._group_sum = np.zeros((len(self._first_log_density), self._nv))
        self._group_sum[self._group, np.arange(self._nv)] = 1.0
        self._limbs = tuple(f"{part}_{side}" for part in ("upper_arm", "forearm") for side in ("left", "right"))
        self._limb_points = self._limb_table()
        self._quick = self._quick_table()
        self._swift = np.zeros((len(self._quick), self._nv), dtype=np.bool_)
        for segment, turning in enumerate(self._quick):
            self._swift[segment, turning[turning >= 6]] = True
        self._slow_size = 3 * self._points + len(self._limbs)
        self._thumbs, self._by_thumbs = self._thumb_tables()
        # of the flat covariance the diagonals of its blocks: tangent, velocities, and between these
        t, v = self._tangent.start, self._velocities.start
        self._diagonal_blocks = np.array([(t, t), (v, v), (t, v), (v, t)])
        self._diagonals: dict[int, IntArray] = {}  # by the size of the covariance
        # of the points' covariance the blocks of each one alone, flat
        first = 3 * np.arange(self._points)[:, None] + np.arange(3)
        self._own: IntArray = (3 * self._points * first[:, :, None] + first[:, None, :]).astype(np.intp)
        self._pose_prior()
        self._lengths_covariance = proportions()
        self._prior_information = block_diag(np.diag(self._rest_information), np.linalg.inv(self._lengths_covariance))
        self.counters: dict[str, int] = dict.fromkeys(
            (
                "frames",
                "measured",
                "rejected",
                "restarts",
                "branches",
                "repeated_stamps",
                "late_frames",
                "taken_again",
                "too_late",
                "backward_jumps",
                "gaps",
                "frame_changes",
                "no_trunk",
                "broken_covariances",
                "orientations",
                "orientations_used",
                "orientations_rejected",
                "rates_rejected",
                "orientations_late",
                "orientations_refused",
                "slips",
            ),
            0,
        )
        self.reset()

    # --- what users call

    def reset(self) -> None:
        """Forget the person; the counters stay."""
        self._last: _State | None = None
        self._late: list[_Measurement | SegmentOrientation] = []
        self._frame_id = ""
        self._newest: Skeleton | None = None
        self._history: deque[tuple[_State, _Measurement | SegmentOrientation]] = deque()
        self._waiting: list[_Measurement] = []
        self._turned_only: dict[str, SegmentOrientation] = {}
        self._turned_since: int | None = None
        self._newest_of: dict[str, int] = {}
        self._started_by: tuple[str, int] | None = None
        self._last_handed_out: tuple[_State, FloatArray, Linearisation, FloatArray] | None = None
        self._last_displaced: tuple[int, FloatArray] | None = None
        self.innovation_distance = np.nan
        self.innovation_dimension = 0

    def start(
        self, q: FloatArray, lengths: FloatArray | None = None, stamp_ns: int = 0, frame_id: str = "world"
    ) -> None:
        """Set the pose instead of finding it by inverse kinematics from the first frame.

        Args:
            q: (35,) configuration.
            lengths: (21,) metres; those of an average person where None.
            stamp_ns: when it is so.
            frame_id: of the base.
        """
        self.reset()
        lengths = self.model.default_lengths() if lengths is None else lengths
        self._frame_id = frame_id
        stddev = np.sqrt(self._base_variance)
        self._state = self._new_state(stamp_ns, q, lengths, stddev, None)

    def update(self, skeleton: Skeleton, sensor: str = "") -> Skeleton | None:
        """Take one frame, and say what it shows: :meth:`take` and then :attr:`filtered`.

        Returns:
            None where the frame is a repetition, came late, or shows no trunk yet.
        """
        return self.filtered if self.take(skeleton, sensor) else None

    def take(self, skeleton: Skeleton, sensor: str = "") -> bool:
        """Take one frame; one that comes late counts from when the estimate is next needed, together with others.

        Args:
            skeleton: in a fixed frame with z up; ``/fused/skeleton``, or one sensor's brought into ``world``.
            sensor: whose it is, as each has its own noise.

        Returns:
            Whether there is an estimate of its time now: not where the frame is a repetition, came late, or shows no
            trunk yet.
        """
        measurement = self._measurement(skeleton, sensor)
        state = self._last
        if state is not None and measurement.stamp_ns >= state.stamp_ns and not self._is_awaited(measurement):
            state = self._state
        if state is not None and not self._in_time(measurement, state):
            return False
        state = self._last  # a jump of time may have reset it
        self.counters["frames"] += 1
        if state is not None and state.unplaced:
            return self._placed(measurement)
        if state is not None and (self._is_awaited(measurement) or self._is_late(measurement, state)):
            # orientations come sooner than frames of the same time, which are the newest of their kind all the same
            overtaken = self._is_awaited(measurement) or bool((state.sources.stamps >= measurement.stamp_ns).any())
            late = not overtaken or self._newest is None or measurement.stamp_ns < self._newest.stamp_ns
            self.counters["late_frames"] += late
            self._late.append(measurement)
            if not late:
                self._newest = skeleton
            return not late
        self._newest = skeleton
        if state is None:
            self._frame_id = skeleton.frame_id
            self._state = self._begun(measurement)
            return self._state is not None
        if not (state.sensors and state.fresh and state.stamp_ns == measurement.stamp_ns):
            self._state = self._remember(state, measurement)  # else it was started from this frame, after a gap
        return True

    def take_orientation(self, measurement: SegmentOrientation) -> bool:
        """Take the orientation of one segment, at its own time among frames and others.

        Where there are no skeletons, the body is started after ``start_after`` by orientations alone, its base at the
        origin with a deviation that says that nothing tells where it is. The first skeletons then start it anew.

        Returns:
            Whether there is an estimate of about its time now: not where it is a repetition or came late.
        """
        self.counters["orientations"] += 1
        state = self._last
        if state is None:
            return self._begun_turned(measurement)
        if not self._orientation_in_time(measurement, state):
            return False
        state = self._last
        if state is None:
            return self._begun_turned(measurement)
        late = self._is_late(measurement, state)
        self.counters["orientations_late"] += late
        # It waits until somebody asks: a camera's frame of an earlier time may still be to come before.
        self._late.append(measurement)
        if measurement.stamp_ns - state.stamp_ns > _LONGEST_WAIT_NS:
            self._last = self._replay(state)
        return not late

    @property
    def filtered(self) -> Skeleton | None:
        """The modelled joints after the last frame in its order, with covariances and velocities; None before a first.

        INFERRED where predicted, NOT_TRACKED where not modelled.
        """
        if self._state is None:
            return None
        newest = self._newest
        if newest is None:
            if not self._state.unplaced:
                return None
            newest = self._empty(self._state.stamp_ns)
        return self._output(self._state, newest)

    @property
    def estimate(self) -> ModelEstimate | None:
        """The state of the model after the last frame; None before a first."""
        return None if self._state is None else self._estimate(self._state)

    def predict(self, stamp_ns: int) -> tuple[Skeleton, ModelEstimate] | None:
        """What is to be expected at a later time, without any change of the filter; None where the person is lost."""
        state = self._state
        if state is None:
            return None
        last_ns = max(int(state.used_ns.max()), state.oriented_ns)
        if stamp_ns - last_ns > self.parameters.predict_for * NANOSECONDS:
            return None
        state = self._within(self._predicted(state, stamp_ns))
        return self._output(state, self._empty(stamp_ns)), self._estimate(state)

    # --- input

    def _measurement(self, skeleton: Skeleton, sensor: str) -> _Measurement:
        joints = self.model.joints
        measured = skeleton.valid[joints]
        positions = np.where(measured[:, None], skeleton.positions[joints], 0.0)
        states = skeleton.states[joints]
        inferred = np.where(states == _TRACKED, 1.0, INFERRED_FACTOR**2)
        model = self._base_variance * inferred
        if skeleton.covariances is not None:
            given = skeleton.covariances[joints]
            diagonal = given.diagonal(axis1=1, axis2=2)
            # a sum is finite where all its numbers are
            sound = (diagonal > 0.0).all(axis=1) & (np.abs(given).sum(axis=(1, 2)) < _MAX_COORDINATE**2)
            model = np.where(sound, diagonal.mean(axis=1), model)
        return _Measurement(sensor, skeleton.stamp_ns, positions, measured, model, skeleton)

    def _in_time(self, measurement: _Measurement, state: _State) -> bool:
        """Whether to take a frame; a jump of time, a gap or another frame of reference reset the filter."""
        p = self.parameters
        elapsed = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        last = state.sensors.get(measurement.sensor)
        if measurement.skeleton.frame_id != self._frame_id:
            self.counters["frame_changes"] += 1
            self.reset()
        elif elapsed > p.predict_for:
            self.counters["gaps"] += 1
            self._history.clear()
            self._late.clear()
            started = self._first_state(measurement, state)
            if started is None:
                return False  # what is known of person and sensors stays for the first frame that shows a trunk
            self._state = started
        elif self._is_known(measurement, state, last):
            self.counters["repeated_stamps"] += 1
            return False
        elif elapsed < -p.late_window:
            jump = elapsed < -max(1.0, 2.0 * p.late_window)
            self.counters["backward_jumps" if jump else "too_late"] += 1
            if jump:
                self.reset()
            return jump
        return True

    def _is_known(self, measurement: _Measurement, state: _State, last: _SensorState | None) -> bool:
        """Whether this sensor's frame of this stamp was taken before."""
        if measurement.stamp_ns > state.stamp_ns:
            return False
        if last is not None and measurement.stamp_ns in last.stamps:
            return True
        own = measurement.sensor, measurement.stamp_ns
        taken = (*self._late, *(each for _, each in self._history))
        return own == self._started_by or any(
            (each.sensor, each.stamp_ns) == own for each in taken if isinstance(each, _Measurement)
        )

    # --- orientations

    def _orientation_in_time(self, measurement: SegmentOrientation, state: _State) -> bool:
        """Whether to take an orientation. What one source says of the time resets nothing that cameras see."""
        p = self.parameters
        elapsed = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        alone = state.unplaced and (elapsed > p.predict_for or elapsed < -max(1.0, 2.0 * p.late_window))
        if measurement.frame_id != self._frame_id or (elapsed > p.predict_for and not alone):
            self.counters["orientations_refused"] += 1
            return False
        if alone:
            self.counters["gaps" if elapsed > 0.0 else "backward_jumps"] += 1
            self.reset()
            return True
        known = self._newest_of.get(measurement.source)
        if known is None or measurement.stamp_ns > known:
            self._newest_of[measurement.source] = measurement.stamp_ns
        elif any(
            each.stamp_ns == measurement.stamp_ns and each.source == measurement.source
            for each in (*self._late, *(each for _, each in self._history))
            if isinstance(each, SegmentOrientation)
        ):
            self.counters["repeated_stamps"] += 1
            return False
        if elapsed < -p.late_window:
            self.counters["too_late"] += 1
            return False
        return True

    def _begun_turned(self, measurement: SegmentOrientation) -> bool:
        """Start the body by orientations alone, where no skeleton comes for some time."""
        since, stamp_ns = self._turned_since, measurement.stamp_ns
        if since is None or abs(stamp_ns - since) > (self.parameters.start_after + 1.0) * NANOSECONDS:
            self._turned_only, since = {}, stamp_ns
        self._turned_since = since = min(since, stamp_ns)
        latest = self._turned_only.get(measurement.source)
        if latest is None or latest.stamp_ns < stamp_ns:
            self._turned_only[measurement.source] = measurement
        seen = self._waiting and abs(self._waiting[-1].stamp_ns - stamp_ns) < self.parameters.start_after * NANOSECONDS
        if seen or stamp_ns - since < self.parameters.start_after * NANOSECONDS:
            return False
        together = [each for each in self._turned_only.values() if each.frame_id == measurement.frame_id]
        self._frame_id = measurement.frame_id
        self._turned_only, self._turned_since, self._waiting = {}, None, []
        q = orientation.pose_of(self.model, self.ranges, together)
        unseen = np.full(self._points, np.inf)
        state = self._new_state(measurement.stamp_ns, q, self.model.default_lengths(), unseen, None)
        covariance = state.covariance.copy()
        covariance[:3, :3] = _UNPLACED_STDDEV**2 * _EYE3
        covariance[3:6, 3:6] = _UNTURNED_STDDEV**2 * _EYE3
        self._state = self._remember(state.but(covariance=covariance, unplaced=True), measurement)
        return True

    def _placed(self, measurement: _Measurement) -> bool:
        """Start anew by skeletons what orientations alone had started."""
        self._history.clear()
        self._late.clear()
        began = self._begun(measurement)
        if began is None:
            return False
        self._frame_id, self._newest = measurement.skeleton.frame_id, measurement.skeleton
        self._state, self._newest_of = began, {}
        return True

    def _oriented(self, state: _State, measurement: SegmentOrientation) -> _State:
        """A state corrected by an orientation, at its time; the same state where it comes too soon.

        Raises:
            LinAlgError: its covariance is none.
        """
        p, sources = self.parameters, state.sources
        number = sources.find(measurement.source)
        since = math.inf if number is None else (measurement.stamp_ns - int(sources.stamps[number])) / NANOSECONDS
        if since < _AHEAD_OF / p.orientation_rate:
            return state
        before_ns = state.oriented_ns or measurement.stamp_ns
        if measurement.stamp_ns - state.stamp_ns > _TOGETHER_NS:
            state = self._predicted(state, measurement.stamp_ns)
        segment = SEGMENT_NUMBER[measurement.segment]
        heard = measurement.stamp_ns - sources.stamps <= p.forget_after * NANOSECONDS
        if number is not None:
            heard[number] &= segment == sources.segments[number]
        if not heard.all():
            state = self._forgotten(state, heard)
        number = state.sources.find(measurement.source)
        known = number is not None
        if number is None:
            state = self._with_source(state, measurement)
            number = len(state.sources) - 1
        sources = state.sources
        own = slice(self._size + PER_SOURCE * number, self._size + PER_SOURCE * (number + 1))
        restated = sources.restated(number, measurement, p)
        if restated is not None:
            sources, left, new = restated
            errors = slice(own.start, own.start + len(left))
            covariance, crosses = state.covariance.copy(), state.crosses.copy()
            covariance[errors] *= left[:, None]
            covariance[:, errors] *= left
            covariance[errors, errors] += np.diag(new)
            crosses[errors] *= left[:, None]
            state = state.but(covariance=covariance, crosses=crosses, sources=sources)

        fade = math.exp(-since / _SLIP_TIME)
        lean, leaning = fade * sources.lean[number], fade * fade * float(sources.leaning[number])
        corrected, white = self._turned_by(state, measurement, number, own)
        distance = float(white @ white)
        near = distance < self._gate
        lean = lean + white * min(1.0, math.sqrt(self._gate / max(distance, 1e-9)))
        leaning += 1.0
        fits = near and float(lean @ lean) < _SLIPPED * leaning
        passed = min(since, p.slip_after) if known else 0.0  # of a new one nothing has passed
        unfit_for = 0.0 if fits else float(sources.unfit_for[number]) + passed
        if unfit_for > p.slip_after:
            self.counters["slips"] += 1
            state = state.but(covariance=orientation.slipped(state.covariance, own, p))
            lean, leaning, unfit_for, near = np.zeros(3), 0.0, 0.0, True
            corrected, _ = self._turned_by(state, measurement, number, own)
        if near:
            corrected = self._spun_by(corrected, measurement, number, own)
            before, after = (m.covariance.diagonal()[self._velocities] for m in (state, corrected))
            moved = state.moved + (corrected.velocity - state.velocity)
            moved_variance = state.moved_variance + np.maximum(before - after, 0.0)
            dt = (measurement.stamp_ns - before_ns) / NANOSECONDS
            state = corrected.but(
                log_density=self._densities_learnt(state, moved, moved_variance, after, dt),
                moved=moved,
                moved_variance=moved_variance,
                oriented_ns=measurement.stamp_ns,
            )
        self.counters["orientations_used" if near else "orientations_rejected"] += 1
        looked_at = state.sources.looked_at(number, measurement, p, unfit_for, lean, leaning)
        return self._within(self._bounded(state.but(sources=looked_at)))

    def _turned_by(
        self,
        state: _State,
        measurement: SegmentOrientation,
        number: int,
        own: slice,
    ) -> tuple[_State, FloatArray]:
        """The Kalman update by an orientation, linearised anew until it is close; and (3,) the normalised innovation.

        Args:
            state: of the orientation's time.
            measurement: the orientation.
            number: of its source.
            own: the rows of what is known of that.
        """
        t, v = self._tangent, self._velocities
        ahead = (measurement.stamp_ns - state.stamp_ns) / NANOSECONDS
        q = self.model.integrate(state.q, ahead * state.velocity) if ahead > 0.0 else state.q
        correction, white = np.zeros(len(state.covariance)), np.zeros(3)
        first: FloatArray | None = None
        for left in reversed(range(_LINEARISATIONS)):
            seen = orientation.expect(
                self.model,
                q,
                state.sources,
                number,
                measurement.rotation,
                None if first is None else correction[own],
            )
            by_tangent, by_source, innovation = seen.by_tangent, seen.by_source, seen.innovation
            if first is not None:
                for ball in self.model.ball_v:  # in the tangent of the state
                    by_tangent[:, ball] = by_tangent[:, ball] @ so3.right_jacobian(correction[ball])
                step = correction[t] + ahead * correction[v]
                innovation = innovation + by_tangent @ step + by_source @ correction[own]
            cross = by_tangent @ state.covariance[t] + by_source @ state.covariance[own]
            if ahead > 0.0:
                cross += by_tangent @ (ahead * state.covariance[v])
            s = (cross[:, t] + ahead * cross[:, v]) @ by_tangent.T + cross[:, own] @ by_source.T
            s.reshape(-1)[::4] += self.parameters.orientation_noise**2
            whitening = _whitening(s)
            white = whitening @ innovation
            first = white if first is None else first
            gain = whitening @ cross
            before, correction = correction, white @ gain
            turned = float(np.abs(correction[3 : self._nv]).max())
            if not left or turned < _FAR or np.abs(correction - before)[3 : self._nv].max() < _CLOSE:
                break
            step = correction[t] + ahead * (state.velocity + correction[v])
            q = self.model.integrate(state.q, step)
        assert first is not None
        covariance = state.covariance - gain.T @ gain
        kalman = gain.T @ whitening
        if state.settled:
            correction[self._lengths] = 0.0
            kalman[self._lengths] = 0.0
            covariance[self._lengths, self._lengths] = state.covariance[self._lengths, self._lengths]
        if len(state.null):
            for part in (correction[t], correction[self._velocities]):
                part -= (state.null @ part) @ state.null
        crosses = state.crosses
        if crosses.shape[1]:
            crosses = crosses - kalman @ (by_tangent @ (crosses[t] + ahead * crosses[v]) + by_source @ crosses[own])
        if turned >= _FAR:
            for ball in self.model.ball_v:
                turn = so3.right_jacobian(correction[ball])
                covariance[ball] = turn @ covariance[ball]
                covariance[:, ball] = covariance[:, ball] @ turn.T
                crosses[ball] = turn @ crosses[ball]
        return self._moved(state.but(covariance=covariance, crosses=crosses), correction), first

    def _spun_by(self, state: _State, measurement: SegmentOrientation, number: int, own: slice) -> _State:
        """The velocities corrected by the angular velocity that comes with an orientation; nothing else is.

        What it errs by (how the source sits, axes that are the person's own) it errs by alike all the time, and would
        teach the pose and its sources what is not so: these are considered but not corrected (Schmidt 1966).
        """
        rate, p = measurement.angular_velocity, self.parameters
        if rate is None or not p.rate_factor:
            return state
        v = self._velocities
        rotation, turning = self.model.turning(state.q, int(state.sources.segments[number]))
        innovation = rotation @ (state.sources.misalignment[number] @ rate) - turning @ state.velocity
        # about axes that are off by a misalignment that is known only so well
        misaligned = float(state.covariance.diagonal()[own][:3].mean())
        cross = turning @ state.covariance[v]
        s = cross[:, v] @ turning.T
        s.reshape(-1)[::4] += p.rate_factor**2 * measurement.angular_velocity_variance + misaligned * float(rate @ rate)
        whitening = _whitening(s)
        white = whitening @ innovation
        if float(white @ white) > self._gate:
            self.counters["rates_rejected"] += 1  # a blow, or the pose is far off
            return state
        half = whitening @ cross  # of it the columns of velocities are the gain's
        gain = half[:, v]
        taken = gain.T @ half
        covariance = state.covariance.copy()
        covariance[v] -= taken
        covariance[:, v] -= taken.T
        covariance[v, v] += gain.T @ gain
        correction = np.zeros(len(covariance))
        correction[v] = white @ gain
        if len(state.null):
            correction[v] -= (state.null @ correction[v]) @ state.null
        crosses = state.crosses
        if crosses.shape[1]:
            crosses = crosses.copy()
            crosses[v] -= gain.T @ (whitening @ (turning @ crosses[v]))
        return self._moved(state.but(covariance=covariance, crosses=crosses), correction)

    def _with_source(self, state: _State, measurement: SegmentOrientation) -> _State:
        """A state with one more source of orientations."""
        sources, added = state.sources.with_new(measurement, self.parameters)
        old = len(state.covariance)
        covariance = np.zeros((old + PER_SOURCE, old + PER_SOURCE))
        covariance[:old, :old] = state.covariance
        covariance[old:, old:] = added
        crosses = np.concatenate([state.crosses, np.zeros((PER_SOURCE, state.crosses.shape[1]))])
        # what thumbs have said so far was said with too much confidence
        doubtful = self._by_thumbs[sources.segments[-1]]
        covariance[doubtful, doubtful] += self.ranges.stddev[doubtful - 6] ** 2
        # so was all, as if a camera took joints to be elsewhere at other times, which from now on it is not taken to
        if not state.sources.names and any(sensor.stated for sensor in state.sensors.values()):
            known = slice(0, self._observed)
            lines = self.model.linearise(state.q, state.lengths)
            covariance[known, known] += self._displacement(state.but(sources=sources), lines, self._prior_information)
        # what was unobserved may be so no longer
        null = np.empty((0, self._nv))
        return state.but(sources=sources, covariance=covariance, crosses=crosses, null=null)

    def _without_thumbs(self, state: _State, measurement: _Measurement) -> _Measurement:
        """A frame without the thumbs of forearms or hands whose orientation is measured.

        A thumb is all that tells a camera how a forearm is turned about itself, and it is off for as long as it looks
        the same: by 50 degrees with a Kinect v2. Any alignment of an inertial sensor is better than what it would be
        corrected to.
        """
        unseen = self._thumbs[state.sources.segments].any(axis=0)
        return replace(measurement, measured=measurement.measured & ~unseen)

    def _unlearnt(self, state: _State) -> tuple[FloatArray, FloatArray] | None:
        """What a camera must not teach of sources: how their forearm or hand is turned about itself.

        Thumbs apart (:meth:`_without_thumbs`) nothing shows a camera that but which way an arm is bent, of which it is
        sure and wrong for as long as the arm looks the same. That combination of a source's numbers is only considered
        (Schmidt 1966): its gain is zero, along the direction in which what is known of the source varies with it.

        Returns:
            (n, 85 and more) combinations, and (85 and more, n) what takes them from a correction; None where there are
            none.
        """
        hidden = np.flatnonzero(self._thumbs[state.sources.segments].any(axis=1))
        if not len(hidden):
            return None
        axes = self.model.forward(state.q, state.lengths).rotations[state.sources.segments[hidden], :, 2]
        combinations = np.zeros((len(hidden), len(state.covariance)))
        back = np.zeros((len(state.covariance), len(hidden)))
        for place, (number, axis) in enumerate(zip(hidden, axes, strict=True)):
            own = slice(self._size + PER_SOURCE * int(number), self._size + PER_SOURCE * (int(number) + 1))
            combinations[place, own] = orientation.about(axis)
            spread = state.covariance[own, own] @ combinations[place, own]
            back[own, place] = spread / (combinations[place, own] @ spread)
        return combinations, back

    def _contradicts(self, state: _State, q: FloatArray) -> bool:
        """Whether another pose turns a segment far from where a source that fits has it."""
        segments = state.sources.segments[state.sources.unfit_for == 0.0]
        if not len(segments):
            return False
        now, then = (self.model.forward(each, state.lengths).rotations[segments] for each in (state.q, q))
        apart = so3.log(so3.matrix_to_quat(now @ then.swapaxes(-1, -2)))
        return bool(((apart * apart).sum(axis=1) > _CONTRADICTION**2).any())

    def _forgotten(self, state: _State, kept: BoolArray) -> _State:
        """A state with some (n,) of its sources of orientations."""
        rows = np.concatenate([np.ones(self._size, dtype=np.bool_), np.repeat(kept, PER_SOURCE)])
        return state.but(
            sources=state.sources.kept(kept), covariance=state.covariance[rows][:, rows], crosses=state.crosses[rows]
        )

    # --- time

    @property
    def _state(self) -> _State | None:
        """After all frames, the late ones in their places; None before a start."""
        if self._late and self._last is not None:
            self._last = self._replay(self._last)
        return self._last

    @_state.setter
    def _state(self, state: _State | None) -> None:
        self._last = state

    def _is_late(self, measurement: _Measurement | SegmentOrientation, state: _State) -> bool:
        """Whether it belongs before what was taken already."""
        if measurement.stamp_ns < state.stamp_ns:
            return True
        return bool(self._history) and _order(self._history[-1][1]) > _order(measurement)

    def _is_awaited(self, measurement: _Measurement) -> bool:
        """Whether orientations of later times wait to be taken, before which it has its place."""
        return any(
            isinstance(each, SegmentOrientation) and each.stamp_ns >= measurement.stamp_ns for each in self._late
        )

    def _remember(self, state: _State, measurement: _Measurement | SegmentOrientation) -> _State:
        """Take a frame in its order, and keep what a later, older one would have to be put before."""
        horizon = measurement.stamp_ns - self.parameters.late_window * NANOSECONDS
        while self._history and self._history[0][1].stamp_ns < horizon:
            self._history.popleft()
        self._history.append((state, measurement))
        return self._step(state, measurement)

    def _replay(self, state: _State) -> _State:
        """Go back to before the first late frame, and take all late and all later ones in their order.

        A connection that stalls delivers many at once: to go back for each of them would cost the later ones so many
        times.
        """
        oldest_ns = self._history[0][0].stamp_ns if self._history else state.stamp_ns
        late = [each for each in self._late if each.stamp_ns >= oldest_ns]  # others are older than all remembered ones
        self._late = []
        if not late:
            return state
        first = min(map(_order, late))
        again = []
        while self._history and _order(self._history[-1][1]) > first:
            state, measurement = self._history.pop()
            again.append(measurement)
        self.counters["taken_again"] += len(again)
        # of frames of one stamp the late ones come last
        for measurement in sorted(again[::-1] + late, key=_order):
            state = self._remember(state, measurement)
        return state

    def _step(self, state: _State, measurement: _Measurement | SegmentOrientation) -> _State:
        if isinstance(measurement, SegmentOrientation):
            try:
                return self._oriented(state, measurement)
            except np.linalg.LinAlgError:
                self.counters["broken_covariances"] += 1
                unseen = np.full(self._points, np.inf)
                anew = self._new_state(state.stamp_ns, state.q, state.lengths, unseen, None)
                return anew.but(sensors=state.sensors, unplaced=state.unplaced)
        state = self._predicted(state, measurement.stamp_ns)
        if state.sources.names:
            measurement = self._without_thumbs(state, measurement)
        try:
            return self._taken(state, measurement)
        except np.linalg.LinAlgError:
            # Rounding, or numbers beyond all measure, have made of the covariance what is none: nothing of it is kept.
            self.counters["broken_covariances"] += 1
            learnt = state.sensors
            unseen = np.full(self._points, np.inf)
            return self._first_state(measurement, None, learnt) or self._new_state(
                state.stamp_ns, state.q, state.lengths, unseen, None
            ).but(sensors=learnt)

    def _taken(self, state: _State, measurement: _Measurement) -> _State:
        """A state of the measurement's time, corrected by it.

        Raises:
            LinAlgError: its covariance is none.
        """
        back = measurement.measured & (measurement.stamp_ns - state.used_ns > _AWAY_NS)
        state = self._corrected(state, measurement)
        # another pose takes ten times as long to look for as a frame to filter
        if state.stamp_ns - state.attempted_ns > _REST_NS:
            if state.rejected_for.max() > self.parameters.reacquire_after:
                state = self._reacquired(state, measurement).but(attempted_ns=state.stamp_ns)
            elif back.any() and self._astray(state, measurement, back):
                points, stddev = self._as_fitted(measurement, state)
                state = self._restarted(state, points, stddev, _MUCH_BETTER).but(attempted_ns=state.stamp_ns)
            elif state.strain > _SUSPICIOUS:
                state = self._looked_anew(state, measurement)
        return self._within(self._bounded(self._measured(state, measurement)))

    def _looked_anew(self, state: _State, measurement: _Measurement) -> _State:
        """Look for another pose that fits better, the more seldom the more often that was of no use."""
        elapsed, rest = state.stamp_ns - state.attempted_ns, _REST_NS << min(state.attempts, _MOST_ATTEMPTS)
        if elapsed < rest or (state.strain < _STRAINED and state.settled and elapsed < _LOOK_NS):
            return state
        attempts = state.attempts + 1 if elapsed < _SOON * rest else 0
        return self._straightened(state, measurement).but(attempted_ns=state.stamp_ns, attempts=attempts)

    def _predicted(self, state: _State, stamp_ns: int) -> _State:
        """The motion model over the time that passed (integrated Ornstein-Uhlenbeck velocity)."""
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        if dt <= 0.0:
            return state
        tau = self.parameters.velocity_time
        fade = math.exp(-dt / tau)
        reach = tau * (1.0 - fade)
        density = np.exp(state.log_density)[self._group]
        if state.sources.names:
            speeds = (self._group_sum @ (state.velocity * state.velocity))[self._group]
            density += _OF_SPEED * self._swift[state.sources.segments].any(axis=0) * speeds
        step = reach * state.velocity
        q = self.model.integrate(state.q, step)

        turns = so3.quat_to_matrix(so3.exp(-step[self.model.ball_v]))
        t, v = self._tangent, self._velocities
        p = state.covariance.copy()
        crosses = math.exp(-dt / self._slow_time(state)) * state.crosses
        for part in (p, p.T, crosses):  # F P, then (F P) F^T, as rows and columns; and F C
            self._turned_back(part, turns)
            part[t] += reach * part[v]
            part[v] *= fade
        sources = state.sources
        if sources.names:
            share = orientation.advance(p, self._size, sources, dt, self.parameters)
            crosses.reshape(len(p), -1)[self._size :].reshape(len(sources), PER_SOURCE, -1)[:, 4:] *= share
            sources = sources.faded(share)
        # covariance of the integrals of white noise over dt
        vv = 0.5 * tau * (1.0 - fade * fade)
        tv = 0.5 * reach * reach
        tt = tau * tau * (dt - 2.0 * reach + vv)
        p.reshape(-1)[self._diagonals_of(len(p))] += np.array([[tt], [vv], [tv], [tv]]) * density

        fading = math.exp(-dt / _WHITENESS_TIME)
        return state.but(
            stamp_ns=stamp_ns,
            q=q,
            velocity=fade * state.velocity,
            covariance=p,
            moved=fading * state.moved,
            moved_variance=fading * fading * state.moved_variance,
            crosses=crosses,
            since_prior=state.since_prior + dt,
            tracked=state.tracked + dt,
            fresh=False,
            sources=sources,
        )

    def _slow_time(self, state: _State) -> float:
        """Seconds for which slow errors of cameras persist."""
        p = self.parameters
        return p.slow_time_beside_orientations if state.sources.names else p.slow_time

    def _diagonals_of(self, size: int) -> IntArray:
        """(4, 32) where a flat covariance of this size has the diagonals of its blocks."""
        if size not in self._diagonals:
            starts = self._diagonal_blocks @ [size, 1]
            self._diagonals[size] = starts[:, None] + (size + 1) * np.arange(self._nv)
        return self._diagonals[size]

    def _turned_back(self, errors: FloatArray, turns: FloatArray) -> None:
        """Turn the rows (85, n) of the base's and the shoulders' rotation in place, by (3, 3, 3) for each of these."""
        errors[self._ball_rows] = (turns @ errors.take(self.model.ball_v, axis=0)).reshape(len(self._ball_rows), -1)

    def _turning_back(self, step: FloatArray) -> FloatArray:
        """(32, 32) how an error of the tangent is seen from the moved configuration (adjoint, Sola eq. 82)."""
        turn = np.eye(self._nv)
        rows = self.model.ball_v
        turn[rows[:, :, None], rows[:, None, :]] = so3.quat_to_matrix(so3.exp(-step[rows]))
        return turn

    # --- measurement

    def _corrected(self, state: _State, measurement: _Measurement) -> _State:
        """The Kalman update with the points that pass the gate; what was learnt of the sensor."""
        dt = max(0.0, (measurement.stamp_ns - self._last_stamp(state, measurement)) / NANOSECONDS)
        sensor = state.sensors.get(measurement.sensor) or self._unknown_sensor(measurement)
        seen = self._expected(state, measurement, sensor)
        own = seen.own
        y = seen.innovation.reshape(-1, 3)
        distances = _squared_distance(own, y)
        near = distances < self._gate
        # a limb may set off faster than it is expected to: what it can do in the time that passed is no outlier
        if not near[measurement.measured].all():
            sudden = 0.5 * _SUDDEN * min(dt, _SUDDEN_TIME) ** 2
            near = _squared_distance(own + sudden**2 * _EYE3, y) < self._gate
        # what stays where the person is not believed to be, and where no other pose is found, draws it there slowly
        stubborn = measurement.measured & ~near & (state.rejected_for > self.parameters.reacquire_after)
        grown = np.where(stubborn, np.minimum(distances / _DRAWING, _MOST_GROWN), 1.0)
        used = measurement.measured & (near | stubborn)
        count = int(np.count_nonzero(used))
        self.counters["measured"] += count
        self.counters["rejected"] += int(np.count_nonzero(measurement.measured)) - count
        # a wrong pose must not pass for limbs that stretch
        unstretched = seen.unstretched
        lean, leaning, strain = self._leaning(state, y, unstretched, measurement.measured, distances, sensor.white, dt)

        rows: slice | IntArray = slice(0, 3 * self._points)
        if count < self._points:
            rows = np.flatnonzero(np.repeat(used, 3))
        rejected_for = np.where(used & near, 0.0, state.rejected_for + np.where(measurement.measured, dt, 0.0))
        used_ns = np.where(used, measurement.stamp_ns, state.used_ns)
        if not count:
            sensors = {**state.sensors, measurement.sensor: self._seen_by(sensor, measurement, used)}
            return state.but(
                sensors=sensors,
                rejected_for=rejected_for,
                used_ns=used_ns,
                lean=lean,
                leaning=leaning,
                strain=strain,
            )

        correction = np.zeros(len(state.covariance))
        for left in reversed(range(_LINEARISATIONS)):
            s = seen.covariance
            s.reshape(-1)[self._own] = grown[:, None, None] * seen.own
            whitening = _whitening(s[rows][:, rows])
            gain = whitening @ seen.cross[:, rows].T  # (k, 85): L^-1 (P H^T)^T
            white = whitening @ seen.innovation[rows]
            before, correction = correction, white @ gain
            covariance = state.covariance - gain.T @ gain
            turned = np.abs(correction[3 : self._nv]).max()
            if not left or turned < _FAR or np.abs(correction - before)[3 : self._nv].max() < _CLOSE:
                break
            # Far from where it was linearised the measurement says something else: linearise it anew about what was
            # found (iterated posterior linearisation, Garcia-Fernandez et al. 2015).
            seen = self._expected(state, measurement, sensor, correction[: self._observed], covariance)
        observation, basis = seen.observation, seen.basis
        unlearnt = self._unlearnt(state) if state.sources.names else None
        if unlearnt is not None:
            combinations, back = unlearnt
            taken = gain @ combinations.T
            correction -= back @ (combinations @ correction)
            covariance += back @ (taken.T @ taken) @ back.T
        # errors are told in the tangent of what is found
        turns = [(ball, so3.right_jacobian(correction[ball])) for ball in self.model.ball_v] if turned >= _FAR else []
        for ball, turn in turns:
            covariance[ball] = turn @ covariance[ball]
            covariance[:, ball] = covariance[:, ball] @ turn.T
        if state.settled:
            correction[self._lengths] = 0.0
            covariance[self._lengths, self._lengths] = state.covariance[self._lengths, self._lengths]
        if len(state.null):
            # what no point shows must not tremble with those that are seen
            for part in (correction[self._tangent], correction[self._velocities]):
                part -= (state.null @ part) @ state.null
        self.innovation_distance, self.innovation_dimension = float(white @ white), len(white)

        names, crosses = state.slow_names, state.crosses
        if measurement.sensor in names and basis is None:
            names, crosses = _without(names, crosses, measurement.sensor)
        elif measurement.sensor not in names and basis is not None:
            names = (*names, measurement.sensor)
            crosses = np.concatenate([crosses, np.zeros((len(crosses), self._slow_size))], axis=1)
        own_cross = None
        if names:
            # Slow errors are only considered (Schmidt 1966): C - K H C, and - K B of the sensor's own.
            kalman = gain.T @ whitening  # (85, k)
            if state.settled:
                kalman[self._lengths] = 0.0
            if unlearnt is not None:
                kalman -= back @ (combinations @ kalman)
            change = kalman @ observation[rows] @ crosses[: self._observed]
            if basis is not None:
                place = names.index(measurement.sensor) * self._slow_size
                own_change = change[:, place : place + self._slow_size]
                own_change[:, rows] += kalman * basis.points[rows]
                own_change[:, 3 * self._points :] += kalman @ basis.limbs[rows]
            crosses = np.subtract(crosses, change, out=change)
            if basis is not None:
                own_cross = crosses[:, place : place + self._slow_size]
            for ball, turn in turns:
                crosses[ball] = turn @ crosses[ball]
        moved = state.moved + correction[self._velocities]
        before, after = (m.diagonal()[self._velocities] for m in (state.covariance, covariance))
        moved_variance = state.moved_variance + np.maximum(before - after, 0.0)

        predicted_variance = own.reshape(-1, _EYE3.size) @ _MEAN_VARIANCE - sensor.white
        foreseeable = float(predicted_variance[used].max()) < _FORESEEABLE**2
        slow_scale, slow_estimate, information = (
            self._slow_learnt(sensor, measurement, whitening, white, rows, bool(state.sources.names))
            if foreseeable  # elsewhere the linearisation errs by more than the sensor
            else (sensor.slow, sensor.slow_estimate, sensor.slow_information)
        )
        if own_cross is not None and slow_scale is not sensor.slow:
            # What the slow errors did to the state so far is as much smaller as they are.
            before_that = np.maximum(sensor.slow, _NEGLIGIBLE_SLOW)
            ratio = np.where(sensor.slow > _NEGLIGIBLE_SLOW, slow_scale / before_that, 1.0)
            if (ratio != 1.0).any():
                ratio = self._per_error(ratio)
                covariance -= (own_cross * (1.0 - ratio)) @ own_cross.T
                own_cross *= np.sqrt(ratio)
        learnt = self._seen_by(sensor, measurement, used).but(
            slow=slow_scale,
            slow_estimate=slow_estimate,
            slow_information=information,
        )
        return state.but(
            q=self.model.integrate(state.q, correction[self._tangent]),
            lengths=state.lengths + correction[self._lengths],
            velocity=state.velocity + correction[self._velocities],
            covariance=covariance,
            log_density=self._densities_learnt(state, moved, moved_variance, after, dt),
            moved=moved,
            moved_variance=moved_variance,
            sensors={**state.sensors, measurement.sensor: learnt},
            slow_names=names,
            crosses=crosses,
            rejected_for=rejected_for,
            used_ns=used_ns,
            lean=lean,
            leaning=leaning,
            strain=strain,
            sources=state.sources if len(correction) == self._size else state.sources.moved(correction[self._size :]),
        )

    def _expected(
        self,
        state: _State,
        measurement: _Measurement,
        sensor: _SensorState,
        correction: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> _Expected:
        """What a sensor is expected to measure, linearised about the state or about what a correction makes of it.

        Args:
            state: of the measurement's time.
            measurement: the frame.
            sensor: its errors.
            correction: (53,) of tangent and lengths; None for none.
            covariance: (85, 85) after it.
        """
        q, lengths, t = state.q, state.lengths, self._tangent
        if correction is not None:
            q = self.model.integrate(q, correction[t])
            lengths = lengths if state.settled else lengths + correction[self._lengths]
        lines = self.model.linearise(q, lengths)
        observation = self._observation(lines)
        spread = state.covariance if covariance is None else covariance
        curvature = self.model.curvature(lines, spread[t, t])
        innovation = (measurement.positions - lines.posture.positions - curvature).reshape(-1)
        if correction is not None:
            for ball in self.model.ball_v:  # in the tangent of the state
                observation[:, ball] = observation[:, ball] @ so3.right_jacobian(correction[ball])
            known = self._nv if state.settled else self._observed
            innovation += observation[:, :known] @ correction[:known]

        # (85, 57) covariance of the state with the points as they are measured: P H^T + C B^T
        cross_covariance = state.covariance[:, : self._observed] @ observation.T
        basis = self._slow_basis(sensor.slow, measurement, lines.posture.positions)
        cross = state.cross(measurement.sensor)
        noise = sensor.white.repeat(3)
        if basis is None:
            s = observation @ cross_covariance[: self._observed]
        else:
            # H P H^T + B C^T H^T + H C B^T + B B^T
            half = 0.5 * cross_covariance
            if cross is not None:
                by_slow = basis.of(cross)
                cross_covariance += by_slow
                half += by_slow
            half = observation @ half[: self._observed]
            by_limbs = basis.limbs @ basis.limbs.T
            s = half + half.T + by_limbs
            noise += basis.points * basis.points
        s.reshape(-1)[:: len(s) + 1] += noise
        # a normal error x makes x^2 / 2 of mean m and of variance 2 m^2
        own = s.reshape(-1).take(self._own) + 2.0 * curvature[:, :, None] * curvature[:, None, :]
        unstretched = own if basis is None else own - by_limbs.reshape(-1).take(self._own)
        return _Expected(observation, innovation, s, own, unstretched, cross_covariance, basis)

    def _last_stamp(self, state: _State, measurement: _Measurement) -> int:
        sensor = state.sensors.get(measurement.sensor)
        return sensor.stamps[-1] if sensor is not None and sensor.stamps else measurement.stamp_ns

    # --- learning

    def _unknown_sensor(self, measurement: _Measurement) -> _SensorState:
        """What is taken of a sensor before it is known; slow errors of one that states how much it errs."""
        p = self.parameters
        slow = p.slow_scale if measurement.skeleton.covariances is not None else 0.0
        white = np.full(self._points, p.white_stddev**2)
        return _SensorState(
            (),
            np.empty((0, self._points, 3)),
            white,
            np.zeros(self._points),
            np.zeros(self._points),
            np.array([slow, 0.0]),
            np.array([slow, 0.0]),
            np.full(2, 4.0),
            measurement.skeleton.covariances is not None,
        )

    def _seen_by(self, sensor: _SensorState, measurement: _Measurement, used: BoolArray) -> _SensorState:
        """The variance of the white noise, from the third differences of the points that passed the gate."""
        points = np.where(used[:, None], measurement.positions, np.nan)
        stamps, frames = sensor.stamps, sensor.positions
        if len(stamps) == 3 and (measurement.stamp_ns - stamps[0]) / NANOSECONDS < _THIRD_DIFFERENCE_SPAN:
            factors = _third_difference((*stamps, measurement.stamp_ns))
            difference = (factors[:3] @ frames.reshape(3, -1)).reshape(-1, 3) + factors[3] * points
            squared = (difference * difference) @ _MEAN
            known = squared >= 0.0  # not NaN
            if known.any():
                sensor = self._white_learnt(sensor, squared, known)
        frames = np.concatenate([frames[-2:], points[None]])
        return sensor.but(stamps=(*stamps[-2:], measurement.stamp_ns), positions=frames)

    def _white_learnt(self, sensor: _SensorState, squared: FloatArray, known: BoolArray) -> _SensorState:
        """The sensor's noise with one more squared difference (19,) of the known points."""
        weight, differences = sensor.weight, sensor.differences
        early = float(weight.min()) < 2.0 * _POOL
        bound = differences
        if early:
            # what all points say together keeps one that was not seen yet from any value
            bound = np.maximum(bound, _typical(squared[known], 1.0))
        kept = np.minimum(weight, _NOISE_FRAMES)
        differences = np.where(
            known, (kept * differences + np.minimum(squared, _OUTLYING * bound)) / (kept + 1.0), differences
        )
        weight = np.where(known, kept + 1.0, weight)
        white = differences
        if early:
            seen = weight > 0.0
            share = np.maximum(1.0 - weight / (2.0 * _POOL), 0.0)
            white = differences + share * (_typical(differences[seen], float(np.median(weight[seen]))) - differences)
        return sensor.but(white=np.maximum(white, _FLOOR**2), differences=differences, weight=weight)

    def _slow_learnt(
        self,
        sensor: _SensorState,
        measurement: _Measurement,
        whitening: FloatArray,
        white: FloatArray,
        rows: slice | IntArray,
        oriented: bool,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """One step of maximum likelihood (Fisher scoring) for the scales of the slow variance.

        Returns:
            (2,) the scales to be used, (2,) their estimates and (2,) the information of these.
        """
        least = self._least_slow(sensor.white, measurement)
        if oriented and measurement.skeleton.covariances is not None:
            least[0] = max(least[0], self.parameters.slow_beside_orientations)
        # It changes slowly, and takes a while to compute.
        soon = sensor.stamps and measurement.stamp_ns // _SLOW_PERIOD_NS == sensor.stamps[-1] // _SLOW_PERIOD_NS
        # What is white is not known at first, and would be taken for slow.
        if soon or sensor.weight.max() < 2.0 * _POOL:
            scales = _kept(sensor.slow, np.maximum(sensor.slow, least))
            return scales, sensor.slow_estimate, sensor.slow_information
        basis = self._basis_of(measurement, measurement.positions)
        half = np.zeros((len(white), self._slow_size))
        half[:, rows] = whitening * basis.points[rows]
        half[:, 3 * self._points :] = whitening @ basis.limbs[rows]
        likely = white @ half
        gram = half.T @ half
        expected = gram.diagonal()
        points = 3 * self._points
        squares = likely**2
        # one that is far from all others says nothing, where all are far they say much
        shares = np.sort(squares[:points] / np.maximum(expected[:points], 1e-30))
        usual = max(1.0, float(shares[points // 2]) / _MEDIAN_OF_CHI2)  # their number is odd
        score = 0.5 * (np.minimum(squares, _SLOW_BOUND * usual * expected) - expected)
        squared = gram * gram
        scores = np.array([score[:points].sum(), score[points:].sum()])
        information = 0.5 * np.array([squared[:points, :points].sum(), squared[points:, points:].sum()])
        passed = _SLOW_PERIOD_NS / NANOSECONDS
        total = sensor.slow_information * np.exp(-passed / _SLOW_MEMORY) + information
        # the mean of what each frame says, which may be less than nothing
        estimate = sensor.slow_estimate + (information * (sensor.slow - sensor.slow_estimate) + scores) / total
        # an error is taken for real when it stands out: else every sensor would have a little of it
        real = estimate * np.sqrt(total) > _SIGNIFICANT
        scales = np.maximum(np.where(real, np.minimum(estimate, _MAX_SLOW), 0.0), least)
        return _kept(sensor.slow, scales), estimate, total

    def _least_slow(self, white: FloatArray, measurement: _Measurement) -> FloatArray:
        """(2,) the scales that there are at least: what a sensor's points do not tremble by, they are wrong by."""
        missing = self._points * _LEAST_ERROR**2 - float(white.sum())
        return np.array([max(missing, 0.0) / float(measurement.model_variance.sum()), 0.0])

    def _per_error(self, scales: FloatArray) -> FloatArray:
        """(61,) what belongs to each slow error, from (2,) what belongs to those of points and of limbs."""
        return np.repeat(scales, (3 * self._points, len(self._limbs)))

    def _slow_basis(self, scales: FloatArray, measurement: _Measurement, positions: FloatArray) -> _SlowBasis | None:
        """Displacement of the points by each slow error of unit variance; None where these are negligible."""
        if scales.max() < _NEGLIGIBLE_SLOW:
            return None
        return self._basis_of(measurement, positions, *np.sqrt(scales))

    def _basis_of(
        self, measurement: _Measurement, positions: FloatArray, of_points: float = 1.0, of_limbs: float = 1.0
    ) -> _SlowBasis:
        """The same for slow errors of points and limbs that are so many times the stated deviations.

        Each point is off by itself, and the upper arms and forearms are too long or too short in some poses, with all
        that hangs on them: along a limb a depth sensor finds its joints by a tenth of the length nearer or farther.
        """
        starts, ends, beyond = self._limb_points
        along = of_limbs * _STRETCH * (positions[ends] - positions[starts])
        return _SlowBasis(
            (of_points * np.sqrt(measurement.model_variance)).repeat(3),
            (beyond[:, None, :] * along.T).reshape(-1, len(self._limbs)),
        )

    def _densities_learnt(
        self, state: _State, moved: FloatArray, variance: FloatArray, remaining: FloatArray, dt: float
    ) -> FloatArray:
        """The spectral densities, from whether the corrections of the velocities lean to one side."""
        rate = self.parameters.density_rate * dt / _WHITENESS_TIME
        # coordinates that the measurement does not touch say nothing
        share = variance / (variance + _UNTOUCHED * remaining + 1e-30)
        ratio = np.minimum(moved * moved / (variance + 1e-30), _RATIO_BOUND) - 1.0
        lean = self._group_sum @ (share * ratio) / (self._group_sum @ share + 0.3)
        least, greatest = self._log_density_bounds
        if state.sources.names:
            least = least.copy()
            quick = np.concatenate([self._quick[segment] for segment in state.sources.segments.tolist()])
            least[self._group[quick]] = math.log(self.parameters.density_beside_orientations)
            greatest = np.maximum(greatest, least)
        result: FloatArray = np.minimum(np.maximum(state.log_density + rate * lean, least), greatest)
        return result

    def _measured(self, state: _State, measurement: _Measurement) -> _State:
        """The lengths that many poses tell, which take the place of those that the filter had."""
        if state.seen is None:
            return state
        sensor = state.sensors[measurement.sensor]
        seen = state.seen.seen(
            measurement.sensor,
            measurement.stamp_ns,
            measurement.positions,
            measurement.measured & (measurement.skeleton.states[self.model.joints] == _TRACKED),
            sensor.white,
            measurement.model_variance,
            float(sensor.slow[0]),
            math.sqrt(sensor.slow[1]) * _STRETCH,
        )
        news = seen.blocks is not state.seen.blocks and len(seen.blocks) >= _ENOUGH_BLOCKS
        state = state.but(seen=seen)
        if not news or state.tracked - state.measured_at < _LENGTHS_PERIOD:
            return state
        state = state.but(measured_at=state.tracked)
        found = seen.estimate()
        known = float(np.sqrt(found.covariance.diagonal()).max()) < self.parameters.settle_stddev
        if known and state.tracked > _SETTLE_AFTER * self.parameters.settle_time:
            state = state.but(seen=None)
        # The lengths' errors are new ones. What is known of the rest where the lengths are given stays as it is.
        before = state.covariance[self._lengths, self._lengths]
        follows = np.linalg.solve(before, state.covariance[self._lengths]).T
        crosses = state.crosses - follows @ state.crosses[self._lengths]
        covariance = state.covariance + follows @ (found.covariance - before) @ follows.T
        moved = self._moved(state.but(settled=False), follows @ (found.lengths - state.lengths))
        return moved.but(lengths=found.lengths, covariance=covariance, crosses=crosses, settled=True)

    # --- start, restart

    def _begun(self, measurement: _Measurement) -> _State | None:
        """The state after the first few frames, as many as tell a sensor's noise: without it the start is a guess."""
        if self._waiting and abs(measurement.stamp_ns - self._waiting[-1].stamp_ns) > _WAIT_NS:
            self._waiting.clear()
        if any((each.sensor, each.stamp_ns) == (measurement.sensor, measurement.stamp_ns) for each in self._waiting):
            self.counters["repeated_stamps"] += 1
            return None
        self._waiting.append(measurement)
        self._waiting.sort(key=lambda each: each.stamp_ns)
        by_sensor = [each for each in self._waiting if each.sensor == measurement.sensor]
        if len(by_sensor) < _START_FRAMES:
            return None
        sensors: dict[str, _SensorState] = {}
        for each in self._waiting:
            known = sensors.get(each.sensor) or self._unknown_sensor(each)
            known = self._seen_by(known, each, each.measured)
            slow = np.maximum(known.slow, self._least_slow(known.white, each))
            sensors[each.sensor] = known.but(slow=slow)
        # only the noise is kept: the frames themselves are still to come
        learnt = {name: sensor.but(stamps=(), positions=sensor.positions[:0]) for name, sensor in sensors.items()}
        first, *others = self._waiting
        self._waiting = []
        state = self._first_state(first, None, learnt)
        for each in others:
            state = self._remember(state, each) if state is not None else self._first_state(each, None, learnt)
        return state

    def _first_state(
        self, measurement: _Measurement, previous: _State | None, learnt: dict[str, _SensorState] | None = None
    ) -> _State | None:
        """The pose of one frame by inverse kinematics; None where no trunk is seen."""
        points = np.where(measurement.measured[:, None], measurement.positions, np.nan)
        known = learnt if learnt is not None else {} if previous is None else previous.sensors
        stddev = self._point_stddev(measurement, known)
        lengths = self._lengths_of(points) if previous is None else previous.lengths
        try:
            fit = self.inverse.solve(points, stddev, lengths)
        except ModelError:
            self.counters["no_trunk"] += 1
            return None
        self._started_by = measurement.sensor, measurement.stamp_ns
        state = self._new_state(measurement.stamp_ns, fit.q, lengths, stddev, previous)
        state = state.but(fresh=True, sensors=state.sensors if learnt is None else learnt)
        sensor = state.sensors.get(measurement.sensor) or self._unknown_sensor(measurement)
        sensor = self._seen_by(sensor, measurement, measurement.measured)
        return state.but(sensors={**state.sensors, measurement.sensor: sensor})

    def _new_state(
        self,
        stamp_ns: int,
        q: FloatArray,
        lengths: FloatArray,
        stddev: FloatArray,
        previous: _State | None,
        *,
        keep_lengths: bool = True,
    ) -> _State:
        """A state at rest at a pose, as uncertain as a fit to points of this deviation (19,) leaves it."""
        lines = self.model.linearise(q, lengths)
        weights = np.where(np.isfinite(stddev), 1.0 / stddev**2, 0.0)
        by_tangent = lines.jacobian.reshape(-1, self._nv)
        by_length = lines.length_jacobian.reshape(-1, self._nl)
        weighted = by_tangent * np.repeat(weights, 3)[:, None]
        information = weighted.T @ by_tangent
        information[np.arange(self._nv), np.arange(self._nv)] += self._rest_information
        tangent = np.linalg.inv(information)
        # the fit took the lengths for true: their errors are in the pose
        from_lengths = -tangent @ (weighted.T @ by_length)
        lengths_covariance = (
            previous.covariance[self._lengths, self._lengths]
            if previous is not None and keep_lengths
            else self._lengths_covariance
        )
        sources = _NOBODY if previous is None else previous.sources
        size = self._size + PER_SOURCE * len(sources)
        covariance = np.zeros((size, size))
        if previous is not None:
            covariance[self._size :, self._size :] = previous.covariance[self._size :, self._size :]
        t, n, v = self._tangent, self._lengths, self._velocities
        covariance[t, t] = tangent + from_lengths @ lengths_covariance @ from_lengths.T
        covariance[t, n] = from_lengths @ lengths_covariance
        covariance[n, t] = covariance[t, n].T
        covariance[n, n] = lengths_covariance
        covariance[v, v] = np.diag(self._velocity_variance)
        zero = np.zeros(self._nv)
        return _State(
            stamp_ns,
            q,
            lengths,
            zero,
            covariance,
            self._first_log_density if previous is None else previous.log_density,
            zero,
            zero,
            {} if previous is None else previous.sensors,
            (),
            np.empty((size, 0)),
            np.zeros(self._points),
            np.zeros((self._points, 3)),
            np.zeros(self._points),
            0.0,
            np.full(self._points, stamp_ns, dtype=np.intp),
            0.0,
            0.0 if previous is None else previous.tracked,
            False if previous is None else previous.settled,
            SegmentLengths(self.parameters.slow_time) if previous is None else previous.seen,
            np.empty((0, self._nv)),
            sources=sources,
        )

    def _reacquired(self, state: _State, measurement: _Measurement) -> _State:
        """Start the pose anew where another one fits the rejected points much better."""
        points, stddev = self._as_fitted(measurement, state)
        started = self._restarted(state, points, stddev, _MUCH_BETTER)
        if started is not state or state.settled or int(measurement.measured.sum()) < _WHOLE:
            return started
        # No pose fits: lengths that came from a wrong start would shut the right points out for ever.
        covariance = state.covariance.copy()
        covariance[self._lengths, self._lengths] += self._lengths_covariance
        return state.but(covariance=covariance)

    def _astray(self, state: _State, measurement: _Measurement, back: BoolArray) -> bool:
        """Whether an update by points (19,) that were away for long ended where they are not."""
        off = measurement.positions - self.model.forward(state.q, state.lengths).positions
        variance = self._point_stddev(measurement, state.sensors) ** 2 + _MISFIT**2
        return bool(((off**2).sum(axis=1) > self._gate * variance)[back].any())

    def _as_fitted(self, measurement: _Measurement, state: _State) -> tuple[FloatArray, FloatArray]:
        """(19, 3) points, NaN where not measured, and their deviations (19,)."""
        points = np.where(measurement.measured[:, None], measurement.positions, np.nan)
        return points, self._point_stddev(measurement, state.sensors)

    def _restarted(self, state: _State, points: FloatArray, stddev: FloatArray, share: float) -> _State:
        """A pose that fits points with at most a share of the present one's cost; else the present state."""
        try:
            # to tell whether a pose is worth it takes half the steps that it takes to tell the pose
            fit = self.inverse.solve(points, stddev, state.lengths, tolerance=_CLOSE)
            # lengths that were learnt in a wrong pose are wrong, too
            lengths = self._lengths_of(points)
            size = float(np.median(lengths / state.lengths))
            other = not state.settled or not 1.0 / _ANOTHER_SIZE < size < _ANOTHER_SIZE
            fresh = self.inverse.solve(points, stddev, lengths, fit.q) if other else fit
        except ModelError:
            return state
        if self._contradicts(state, fit.q) or (other and self._contradicts(state, fresh.q)):
            return state
        present = float(self.inverse.cost(state.q, points, stddev, state.lengths))
        whole = int(np.isfinite(points).all(axis=1).sum()) >= _WHOLE
        if other and whole and fresh.cost < share * min(fit.cost, present):
            self.counters["restarts"] += 1
            seen = SegmentLengths(self.parameters.slow_time) if state.settled else state.seen
            state = state.but(settled=False, tracked=0.0, seen=seen)
            return self._new_state(state.stamp_ns, fresh.q, lengths, stddev, state, keep_lengths=False)
        if fit.cost > share * present:
            return state
        self.counters["restarts"] += 1
        fit = self.inverse.solve(points, stddev, state.lengths, fit.q)
        return self._new_state(state.stamp_ns, fit.q, state.lengths, stddev, state)

    def _leaning(
        self,
        state: _State,
        innovation: FloatArray,
        covariance: FloatArray,
        measured: BoolArray,
        distances: FloatArray,
        white: FloatArray,
        dt: float,
    ) -> tuple[FloatArray, FloatArray, float]:
        """The faded mean of the innovations (19, 3), its weights (19,) and the strain."""
        fade = math.exp(-dt / _LEAN_TIME)
        bounded = np.minimum(1.0, np.sqrt(self._gate / np.maximum(distances, 1e-9)))  # one outlier is no lean
        weight = fade * state.leaning + measured
        step = measured / np.maximum(weight, 1.0)
        lean = state.lean + step[:, None] * (bounded[:, None] * innovation - state.lean)
        # variance of a faded mean of white innovations with this weight
        worth = (0.5 + 0.5 * fade) * weight
        # a body is no model: what is off by less than this needs no other pose
        averaged = white * (1.0 - 1.0 / np.maximum(worth, 1.0))  # only what is white averages out
        spread = covariance + (_MISFIT**2 - averaged)[:, None, None] * _EYE3
        strain = np.where(weight > _LEAN_FRAMES, _squared_distance(spread, lean), 0.0)
        return lean, weight, float(strain.max())

    def _straightened(self, state: _State, measurement: _Measurement) -> _State:
        """Start the pose anew where another one fits much better what the points have shown for some time.

        A filter can settle in a wrong pose that no single frame contradicts: an elbow that looks straight because
        the upper arm is turned the wrong way about itself.
        """
        sure = state.leaning > _LEAN_FRAMES
        posture = self.model.forward(state.q, state.lengths)
        points = np.where(sure[:, None], posture.positions + state.lean, np.nan)
        stddev = self._point_stddev(measurement, state.sensors)
        stddev = np.where(np.isfinite(stddev), np.sqrt(stddev**2 / np.maximum(state.leaning, 1.0) + _MISFIT**2), np.inf)
        turned = self._hands_turned(state, points, stddev)
        if turned is not state or state.strain < _STRAINED:
            return turned
        state = state.but(lean=np.zeros_like(state.lean), leaning=np.zeros(self._points), strain=0.0)
        return self._restarted(state, points, stddev, _MUCH_BETTER)

    def _hands_turned(self, state: _State, points: FloatArray, stddev: FloatArray) -> _State:
        """Start anew with a hand turned about itself where that is much likelier; else the present state.

        A hand that is bent and turned the wrong way about soon has lengths to match, a thumb that does not stand out.
        So the lengths count, too: what is average against what they were learnt to be.
        """
        lengths, unlikely = state.lengths, 0.0
        if not state.settled:
            lengths = self._lengths_of(points)
            off = state.lengths - lengths
            unlikely = 0.5 * float(off @ np.linalg.solve(self._lengths_covariance, off))
        fit = self.inverse.solve(points, stddev, lengths, state.q, tolerance=_CLOSE, alternatives=True)
        if not self.inverse.is_turned(state.q, fit.q) or self._contradicts(state, fit.q):
            return state
        stays = self.inverse.solve(points, stddev, state.lengths, state.q, tolerance=_CLOSE)
        if stays.cost + unlikely < fit.cost + _LIKELIER:
            return state
        self.counters["restarts"] += 1
        return self._new_state(state.stamp_ns, fit.q, lengths, stddev, state, keep_lengths=state.settled)

    def _point_stddev(self, measurement: _Measurement, sensors: Mapping[str, _SensorState]) -> FloatArray:
        """(19,) metres; infinity where not measured."""
        sensor = sensors.get(measurement.sensor) or self._unknown_sensor(measurement)
        return np.where(
            measurement.measured, np.sqrt(sensor.white + sensor.slow[0] * measurement.model_variance), np.inf
        )

    def _lengths_of(self, points: FloatArray) -> FloatArray:
        """(21,) average proportions at the size of the person that is seen."""
        lengths = self.model.default_lengths()
        neutral = self.model.forward(self.model.neutral(), lengths).positions
        starts, ends = self._bones
        seen = np.sqrt(((points[ends] - points[starts]) ** 2).sum(axis=1))
        expected = np.sqrt(((neutral[ends] - neutral[starts]) ** 2).sum(axis=1))
        ratio = seen / expected
        ratio = ratio[np.isfinite(ratio)]
        return lengths * float(np.clip(np.median(ratio), 0.5, 1.4)) if len(ratio) else lengths

    # --- priors

    def _groups(self) -> tuple[IntArray, FloatArray]:
        """(32,) the group of each coordinate that shares a density, and (groups,) their first log densities."""
        p = self.parameters
        keys: list[str] = []
        densities: list[float] = []
        groups = np.empty(self._nv, dtype=np.intp)
        for number, name in enumerate(self.model.coordinate_names):
            part = name.split("_")[0]
            side = name.rsplit("_", 1)[-1]
            if part == "base":
                # people walk and turn, and hardly rise or tilt
                kinds = {"x": "base_level", "y": "base_level", "z": "base_height", "rz": "base_turn"}
                key = kinds.get(side, "base_tilt")
            elif side in ("left", "right"):
                key = f"{part}_{side}"
            else:
                key = part
            if key not in keys:
                keys.append(key)
                limb, hand = key.startswith(("shoulder", "elbow")), key.startswith(("forearm", "wrist"))
                density = p.density_limb if limb else p.density_hand if hand else p.density_trunk
                base = {"base_level": p.density_translation, "base_height": p.density_translation}
                densities.append({**base, "base_turn": p.density_turn}.get(key, density))
            groups[number] = keys.index(key)
        return groups, np.log(densities)

    def _quick_table(self) -> list[IntArray]:
        """(12,) of each segment the coordinates that turn it quickly: those of its limb, of the trunk all."""
        found = []
        for segment in self.model.segment_names:
            side = segment.rsplit("_", 1)[-1]
            turning = self.model.turned_by(segment)
            own = [k for k in turning.tolist() if self.model.coordinate_names[k].endswith(f"_{side}")]
            found.append(np.array(own or turning, dtype=np.intp))
        return found

    def _limb_table(self) -> tuple[IntArray, IntArray, FloatArray]:
        """(4,) points at the start and (4,) at the end of each limb, and (19, 4) which points it carries."""
        point = {Joint(joint): number for number, joint in enumerate(self.model.joints)}
        starts, ends = [], []
        beyond = np.zeros((self._points, len(self._limbs)))
        chain = ("SHOULDER", "ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")
        for column, limb in enumerate(self._limbs):
            first = 0 if limb.startswith("upper_arm") else 1
            parts = [point[Joint[f"{name}_{limb.rsplit('_', 1)[1].upper()}"]] for name in chain]
            starts.append(parts[first])
            ends.append(parts[first + 1])
            beyond[parts[first + 1 :], column] = 1.0
        return np.array(starts, dtype=np.intp), np.array(ends, dtype=np.intp), beyond

    def _thumb_tables(self) -> tuple[BoolArray, list[IntArray]]:
        """(12, 19) the thumb at the end of each segment, if any; and the coordinates that rest on it."""
        thumbs = np.zeros((len(self.model.segment_names), self._points), dtype=np.bool_)
        coordinates = [np.empty(0, dtype=np.intp) for _ in self.model.segment_names]
        for number, name in enumerate(self.model.segment_names):
            if name.startswith(("forearm", "hand")):
                side = name.rsplit("_", 1)[1]
                thumbs[number] = self.model.joints == Joint[f"THUMB_{side.upper()}"]
                resting = ("forearm_pronation", "wrist_flexion", "wrist_deviation")
                places = [self.model.coordinate_names.index(f"{each}_{side}") for each in resting]
                coordinates[number] = np.array(places, dtype=np.intp)
        return thumbs, coordinates

    def _pose_prior(self) -> None:
        """What is known of a pose and of velocities without any measurement."""
        names = self.model.coordinate_names[6:]
        self._of_arms = np.isin(
            self.model.joints, [Joint[f"{name}_{side}"] for name in _BENT for side in ("LEFT", "RIGHT")]
        )
        self._twists = np.array([name.startswith(("shoulder_z", "forearm_pronation")) for name in names])
        trunk = np.array([name.startswith(("lumbar", "thoracic", "clavicle")) for name in names])
        self._posture = np.append(trunk, True)
        self._rest_information = np.full(self._nv, 1e-4)
        self._rest_information[6:] = 1.0 / self.ranges.stddev**2
        self._velocity_variance = np.full(self._nv, _FIRST_TURN_RATE**2)
        self._velocity_variance[:3] = _FIRST_SPEED**2
        path = {Joint(joint): number for number, joint in enumerate(self.model.joints)}
        bones = [(path[a], path[b]) for a, b in BONES if a in path and b in path]
        self._bones = np.array([a for a, _ in bones], dtype=np.intp), np.array([b for _, b in bones], dtype=np.intp)

    def _bounded(self, state: _State) -> _State:
        """Bring in the ranges of motion: softly push back what left them, and bound what nothing observes."""
        if state.since_prior < _PRIOR_PERIOD:
            return state
        soft = self.ranges.soft_coordinates(state.q)
        excess = self.ranges.excess_of(soft.values)
        gradients = np.zeros((self._nv - 5, self._nv))
        gradients[:-1, 6:] = soft.gradients
        gradients[-1, 6:] = self.ranges.twist @ soft.gradients
        values = np.append(soft.values - self.ranges.centre, self.ranges.twist @ soft.values)
        stddev = np.append(self.ranges.stddev, np.radians(TWIST_SHARING_STDDEV))
        tangent = self._free(state)[0][self._tangent, self._tangent]
        variance = ((gradients @ tangent) * gradients).sum(axis=1)
        # What is less sure than its range is told the middle of the range, just so surely that it is as sure as that:
        # as far as no orientation holds it, for what is told again and again is wrong by the same each time.
        limit = stddev**2
        unknown = variance > limit
        noise = variance * limit / np.maximum(variance - limit, 1e-12)
        state = state.but(since_prior=0.0)
        if state.seen is not None and state.tracked > self.parameters.settle_time:
            state = state.but(settled=True, seen=None)
        branch = self.ranges.nearest_branch(state.q)
        if branch is not None:
            return self._turned(state, *branch)
        state = self._unsure(state)
        if unknown.any():
            state = self._told(state, gradients[unknown], -values[unknown], noise[unknown], self._free(state))
        if state.sources.names:
            rows, repeated = self._posture, 2.0 * _POSTURE_TIME / _PRIOR_PERIOD
            whole = state.covariance, state.crosses
            state = self._told(state, gradients[rows], -values[rows], repeated * limit[rows], whole)
        vague = variance > (_VAGUE * stddev) ** 2
        if vague.any() and not state.sources.names:
            state = self._drawn(state, gradients[vague], values[vague], stddev[vague])
        beyond = excess != 0.0
        if beyond.any():
            state = self._pushed_back(state, gradients[:-1][beyond], excess[beyond])
        return state

    def _turned(self, state: _State, q: FloatArray, signs: FloatArray) -> _State:
        """The same state told by another configuration, whose tangent has other signs (32,)."""
        self.counters["branches"] += 1
        both = np.concatenate([signs, np.ones(self._nl), signs, np.ones(len(state.covariance) - self._size)])
        return state.but(
            q=q,
            velocity=state.velocity * signs,
            covariance=state.covariance * both * both[:, None],
            moved=state.moved * signs,
            crosses=state.crosses * both[:, None],
        )

    def _unsure(self, state: _State) -> _State:
        """Take back what the update believes to know of directions that no point shows.

        The unobserved directions are those of the estimate, which trembles; the update takes their turning from
        frame to frame for information (Huang, Mourikis and Roumeliotis 2010). Along each of them the covariance is
        brought back to what the ranges of motion say.
        """
        lines = self.model.linearise(state.q, state.lengths)
        jacobian = lines.jacobian.reshape(-1, self._nv)
        if state.sources.names:
            turning = lines.rotation_jacobian[state.sources.segments].reshape(-1, self._nv)
            jacobian = np.concatenate([jacobian, turning])
        _, singular, axes = np.linalg.svd(jacobian, full_matrices=False)
        null = axes[singular < _NULL * singular[0]]
        state = state.but(null=null)
        if not len(null):
            return state
        tangent = state.covariance[self._tangent, self._tangent]
        known = np.linalg.inv(null @ np.linalg.solve(tangent, null.T))
        allowed = _SPURIOUS * np.linalg.inv((null * self._rest_information) @ null.T)
        size, directions = np.linalg.eigh(allowed - known)
        missing = (directions * np.maximum(size, 0.0)) @ directions.T
        covariance = state.covariance.copy()
        covariance[self._tangent, self._tangent] += null.T @ missing @ null
        return state.but(covariance=covariance)

    def _drawn(self, state: _State, observation: FloatArray, values: FloatArray, stddev: FloatArray) -> _State:
        """The estimate drawn to the middle of the ranges, where nothing else holds it; the covariance stays.

        Without this, an angle that nothing observes would wander with the noise of those that are. Beside orientations
        it is done to what is handed out only (:meth:`_middled`): what cameras pull back again and again, as the
        covariance stays, would end up in the headings and misalignments of the sources.
        """
        cross_covariance = self._free(state)[0][:, self._tangent] @ observation.T
        s = observation @ cross_covariance[self._tangent] + np.diag(stddev**2)
        correction = -cross_covariance @ np.linalg.solve(s, values)
        correction[self._velocities] = 0.0
        correction[self._size :] = 0.0
        return self._moved(state, correction)

    def _within(self, state: _State) -> _State:
        """The nearest state, by the covariance, that is not far beyond any range of motion.

        Softly a range pushes back ten times a second; a velocity that runs on while nothing is seen, or a measurement
        that no body can follow, is stopped here at once.
        """
        if self.ranges.surely_within(state.q, _FAR_BEYOND):
            return state
        for _ in range(_PROJECTIONS):
            excess = self.ranges.excess(state.q)
            size = np.abs(excess)
            far = size > _FAR_BEYOND
            if not far.any():
                return state
            gradients = self.ranges.soft_coordinates(state.q).gradients[far]
            observation = np.zeros((len(gradients), self._nv))
            observation[:, 6:] = gradients
            back = excess[far] * (1.0 - _BACK_TO / size[far])
            state = self._pushed_back(state, observation, back, _HARD_STDDEV)
            velocity = state.velocity.copy()
            rate = gradients @ velocity[6:]
            outward = rate * excess[far] > 0.0
            velocity[6:] -= gradients.T @ np.where(outward, rate, 0.0)
            state = state.but(velocity=velocity)
        return state.but(q=self.ranges.clipped(state.q, _FAR_BEYOND))

    def _told(
        self,
        state: _State,
        observation: FloatArray,
        error: FloatArray,
        noise: FloatArray,
        part: tuple[FloatArray, FloatArray],
    ) -> _State:
        """The update by pseudo-measurements (k,) of rows (k, 32) of the tangent with variances (k,).

        Args:
            state: to be corrected.
            observation: rows.
            error: of what is observed.
            noise: variances.
            part: the covariance, and with the slow errors of cameras: all of it, or what may be corrected.
        """
        free, free_crosses = part
        cross_covariance = free[:, self._tangent] @ observation.T
        s = observation @ cross_covariance[self._tangent] + np.diag(noise)
        factor = _cholesky(s)
        gain, _ = dtrtrs(factor, cross_covariance.T, lower=1)
        white, _ = dtrtrs(factor, error, lower=1)
        covariance = state.covariance - gain.T @ gain
        if state.settled:
            covariance[self._lengths, self._lengths] = state.covariance[self._lengths, self._lengths]
        half, _ = dtrtrs(factor, observation @ free_crosses[self._tangent], lower=1)
        crosses = state.crosses - gain.T @ half
        if state.settled:
            crosses[self._lengths] = state.crosses[self._lengths]
        return self._moved(state.but(covariance=covariance, crosses=crosses), white @ gain)

    def _pushed_back(
        self, state: _State, observation: FloatArray, excess: FloatArray, stddev: float = _LIMIT_STDDEV
    ) -> _State:
        """The nearest state, by the covariance, within the limits; softly (Simon 2010, projection of the estimate).

        The covariance stays: that an angle is within its limits does not tell where.
        """
        cross_covariance = self._free(state)[0][:, self._tangent] @ observation.T
        s = observation @ cross_covariance[self._tangent]
        s[np.arange(len(s)), np.arange(len(s))] += np.radians(stddev) ** 2
        correction = -cross_covariance @ np.linalg.solve(s, excess)
        correction[self._size :] = 0.0  # as the covariance stays, sources would learn this again and again
        return self._moved(state, correction)

    def _free(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """The covariance of all, and with the slow errors of cameras, as far as orientations leave a pose free.

        A pose that is moved without any measurement must not turn what a source says the turn of: the source would be
        corrected instead, each time a little.
        """
        speaking = state.stamp_ns - state.sources.stamps < _HELD_FOR_NS
        if not speaking.any():
            return state.covariance, state.crosses
        turning = self.model.linearise(state.q, state.lengths).rotation_jacobian[state.sources.segments[speaking]]
        rows = turning.reshape(-1, self._nv)
        cross = state.covariance[:, self._tangent] @ rows.T
        s = rows @ cross[self._tangent]
        s[np.arange(len(s)), np.arange(len(s))] += _HELD_STDDEV**2
        held = np.linalg.solve(s, np.concatenate([cross.T, rows @ state.crosses[self._tangent]], axis=1))
        size = len(state.covariance)
        return state.covariance - cross @ held[:, :size], state.crosses - cross @ held[:, size:]

    def _moved(self, state: _State, correction: FloatArray) -> _State:
        """The state moved by a correction (85,)."""
        lengths = state.lengths if state.settled else state.lengths + correction[self._lengths]
        return state.but(
            q=self.model.integrate(state.q, correction[self._tangent]),
            lengths=lengths,
            velocity=state.velocity + correction[self._velocities],
            sources=state.sources if len(correction) == self._size else state.sources.moved(correction[self._size :]),
        )

    # --- output

    def _body(self) -> int:
        return 0 if self._newest is None else self._newest.body

    def _empty(self, stamp_ns: int) -> Skeleton:
        """A frame that shows nothing."""
        nowhere, unseen = np.full((N_JOINTS, 3), np.nan), np.zeros(N_JOINTS, dtype=np.uint8)
        return Skeleton(stamp_ns, self._frame_id, nowhere, unseen, self._body())

    def _observation(self, lines: Linearisation) -> FloatArray:
        """(57, 53) derivative of the points by tangent and lengths."""
        both = np.concatenate([lines.jacobian, lines.length_jacobian], axis=-1)
        return both.reshape(-1, self._observed)

    def _handed_out(self, state: _State) -> tuple[FloatArray, Linearisation, FloatArray]:
        """The configuration, where its points are, and the covariance (85, 85) to hand out: what the filter knows, and
        what it cannot.
        """
        if self._last_handed_out is None or self._last_handed_out[0] is not state:
            lines, covariance = self.model.linearise(state.q, state.lengths), state.covariance
            if self.parameters.offset_scale and any(sensor.stated for sensor in state.sensors.values()):
                covariance = covariance.copy()
                covariance[: self._observed, : self._observed] += self._displaced(state, lines)
            q = state.q
            if state.sources.names:
                q = self._middled(q, state.covariance[self._tangent, self._tangent])
                lines = self.model.linearise(q, state.lengths)
            self._last_handed_out = state, q, lines, covariance
        return self._last_handed_out[1:]

    def _middled(self, q: FloatArray, covariance: FloatArray) -> FloatArray:
        """(35,) a configuration of covariance (32, 32) told the middle of the ranges once, where it is vague."""
        soft = self.ranges.soft_coordinates(q)
        gradients = np.zeros((self._nv - 6, self._nv))
        gradients[:, 6:] = soft.gradients
        stddev = self.ranges.stddev
        vague = ((gradients @ covariance) * gradients).sum(axis=1) > (_VAGUE * stddev) ** 2
        vague &= self._twists
        rows = gradients[vague]
        cross = covariance @ rows.T
        away = soft.values[vague] - self.ranges.centre[vague]
        return self.model.integrate(q, -cross @ np.linalg.solve(rows @ cross + np.diag(stddev[vague] ** 2), away))

    def _displaced(self, state: _State, lines: Linearisation) -> FloatArray:
        """(53, 53) covariance of tangent and lengths by where sensors take the joints' centres to be.

        By constant offsets ``b`` of covariance ``B`` the pose that fits best is off by ``G b`` with
        ``G = (H^T W H + P^-1)^-1 H^T W``, where ``W`` is how the filter weighs the points and ``P`` what is known
        without any measurement: ``G B G^T``. To first order: forearms and hands, which are hardly longer than the
        offsets, err by more.
        """
        period = state.stamp_ns // _SLOW_PERIOD_NS
        if self._last_displaced is None or self._last_displaced[0] != period:  # it changes slowly, as the pose does
            information = self._prior_information
            if state.sources.names:
                information = information + self._held(state, lines)
            self._last_displaced = period, self._displacement(state, lines, information)
        return self._last_displaced[1]

    def _displacement(self, state: _State, lines: Linearisation, information: FloatArray) -> FloatArray:
        """The same, where (53, 53) information is what is known without any point."""
        weights = sum(
            (1.0 / (sensor.white + sensor.slow[0] * self._base_variance) for sensor in state.sensors.values()),
            np.zeros(self._points),
        )
        offsets = self.parameters.offset_scale * np.sqrt(self._base_variance)
        if state.sources.names:
            weights = np.where(self._thumbs[state.sources.segments].any(axis=0), 0.0, weights)
            offsets = np.where(self._of_arms, _ARM_OFFSETS * offsets, offsets)
        observation = self._observation(lines)
        weighted = observation.T * weights.repeat(_DIMENSIONS)
        gain = np.linalg.solve(weighted @ observation + information, weighted)
        displacement = gain * offsets.repeat(_DIMENSIONS)
        return displacement @ displacement.T

    def _held(self, state: _State, lines: Linearisation) -> FloatArray:
        """(53, 53) information on tangent and lengths by orientations, whatever cameras say."""
        own = state.covariance.diagonal()[self._size :].reshape(-1, PER_SOURCE)
        variance = own.sum(axis=1) / _DIMENSIONS  # of misalignment, heading and what persists together, per axis
        turning = lines.rotation_jacobian[state.sources.segments]
        information = np.zeros((self._observed, self._observed))
        information[self._tangent, self._tangent] = np.einsum("nij,nik,n->jk", turning, turning, 1.0 / variance)
        return information

    def _estimate(self, state: _State) -> ModelEstimate:
        q, _, told = self._handed_out(state)
        covariance = np.empty((2 * self._nv, 2 * self._nv))
        for row, rows in enumerate((self._tangent, self._velocities)):
            for column, columns in enumerate((self._tangent, self._velocities)):
                block = slice(row * self._nv, (row + 1) * self._nv), slice(column * self._nv, (column + 1) * self._nv)
                covariance[block] = told[rows, columns]
        return ModelEstimate(
            state.stamp_ns,
            self._frame_id,
            self._body(),
            q,
            state.velocity,
            covariance,
            state.lengths,
            np.sqrt(told.diagonal()[self._lengths]),
        )

    def _output(self, state: _State, skeleton: Skeleton) -> Skeleton:
        _, lines, told = self._handed_out(state)
        joints = self.model.joints
        observation = self._observation(lines)
        spread = observation @ told[: self._observed, : self._observed] @ observation.T
        positions, velocities = np.full((2, N_JOINTS, 3), np.nan)
        covariances = _UNKNOWN.copy()
        states = np.zeros(N_JOINTS, dtype=np.uint8)
        positions[joints] = lines.posture.positions
        velocities[joints] = (observation[:, self._tangent] @ state.velocity).reshape(-1, 3)
        covariances[joints] = spread.reshape(-1).take(self._own)
        used = state.used_ns == skeleton.stamp_ns
        states[joints] = np.where(used, skeleton.states[joints], _INFERRED)
        return Skeleton(state.stamp_ns, skeleton.frame_id, positions, states, skeleton.body, covariances, velocities)


def _order(measurement: _Measurement | SegmentOrientation) -> tuple[int, str]:
    """Where it belongs among others: by its time; of the same time, frames come before orientations."""
    return measurement.stamp_ns, measurement.source if isinstance(measurement, SegmentOrientation) else ""


def _without(names: tuple[str, ...], crosses: FloatArray, name: str) -> tuple[tuple[str, ...], FloatArray]:
    """``slow_names`` and ``crosses`` of a state without those of one sensor."""
    kept = np.repeat([each != name for each in names], crosses.shape[1] // len(names))
    return tuple(each for each in names if each != name), crosses[:, kept]


def _kept(before: FloatArray, after: FloatArray) -> FloatArray:
    """(2,) the new scales of slow errors, or the very same as before where they hardly differ."""
    pairs = zip(before.tolist(), after.tolist(), strict=True)
    return before if all(abs(b - a) <= _SLOW_STEP * a for a, b in pairs) else after


def _cholesky(matrix: FloatArray) -> FloatArray:
    """The lower factor; numpy's takes three times as long on one so small.

    Raises:
        LinAlgError: the matrix is not positive definite, or not finite.
    """
    factor: FloatArray
    # the transpose of a symmetric matrix need not be brought into Fortran's order
    factor, failed = dpotrf(matrix.T, lower=1)
    if failed or not math.isfinite(float(factor.trace())):
        raise np.linalg.LinAlgError("not positive definite")
    return factor


def _whitening(covariance: FloatArray) -> FloatArray:
    """(k, k) inverse of the lower factor. Products with it take a fraction of what solving takes for each.

    Raises:
        LinAlgError: as of :func:`_cholesky`.
    """
    inverse: FloatArray
    inverse, _ = dtrtri(_cholesky(covariance), lower=1, overwrite_c=1)  # above the diagonal it stays 0
    return inverse


def _squared_distance(covariances: FloatArray, vectors: FloatArray) -> FloatArray:
    """(n,) squared Mahalanobis distances of (n, 3) by (n, 3, 3); LAPACK takes three times as long for so small ones."""
    x, y, z = vectors.T
    xx, xy, xz, _, yy, yz, _, _, zz = covariances.reshape(-1, 9).T
    # C = L D L^T, and L w = v
    l10, l20 = xy / xx, xz / xx
    d1 = yy - l10 * xy
    rest = yz - l20 * xy
    l21 = rest / d1
    d2 = zz - l20 * xz - l21 * rest
    y = y - l10 * x
    z = z - l20 * x - l21 * y
    result: FloatArray = x * x / xx + y * y / d1 + z * z / d2
    return result


def _typical(variances: FloatArray, weight: float) -> float:
    """What several variances say together, each the mean of so many squared third differences, some of outliers."""
    freedom = _DIMENSIONS * (1.0 + (weight - 1.0) / _CORRELATED)
    # Wilson and Hilferty 1931: the median of chi-square over its mean
    return float(np.median(variances)) / (1.0 - 2.0 / (9.0 * freedom)) ** 3


def _third_difference(stamps: Sequence[int]) -> FloatArray:
    """(4,) factors of the third divided difference at these nanoseconds; their squares sum up to 1."""
    b, c, d = ((stamp - stamps[0]) / NANOSECONDS for stamp in stamps[1:])
    factors = (
        -1.0 / (b * c * d),
        1.0 / (b * (b - c) * (b - d)),
        1.0 / (c * (c - b) * (c - d)),
        1.0 / (d * (d - b) * (d - c)),
    )
    return np.array(factors) / math.hypot(*factors)

"""The linear Kalman filters of all 25 joints (Schlagenhauf 2017, chapters 3.7 and 5.4, algorithm 1).

Each joint has a filter of its own with the thesis's state: its position (zero-velocity model, eq. 5.11) or its position
and velocity (constant-velocity model, eq. 5.12). Unlike there, the process noise is a continuous white noise with the
time step that really passed, the measurement noise is the fused skeleton's own, and every innovation is gated.

A depth sensor's skeleton is wrong by centimetres but trembles by millimetres: most of its error stays for seconds (a
joint placed beside the anatomical one, a tilt by the viewing direction). A filter told that all of it were white would
average it away on paper only. So the measurement covariance ``R`` is split: ``white_noise_share`` of it drives the
gain, the rest is carried along and added to the covariance that is handed out; gating allows for all of it.

What no sensor shows does not fly on as it last moved: at constant velocity a hand that is hidden in mid-reach would be
a metre away after half a second. It is carried along by the nearest joint towards the trunk that is seen, and its own
movement against that one fades (an Ornstein-Uhlenbeck process, whose velocity has the initial deviation for ever).

A limb that is thrust forward is no outlier, and following it with the gain of a quiet one leaves it farther behind with
every frame until it is taken for one. So each joint's process noise grows with its surprising innovations, and is back
soon (adjustable level of the process noise, Bar-Shalom, Li and Kirubarajan 2001, section 11.2).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import chdtri

from body_tracking.calibration.joint_centres import JointCentres
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.measurement import BASE_STDDEV, INFERRED_FACTOR
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.core.skeleton import (
    BONES,
    N_JOINTS,
    BoolArray,
    FloatArray,
    IntArray,
    Skeleton,
    TrackingState,
)
from body_tracking.filters.arrival import Arrival, Arrivals
from body_tracking.filters.stacked import Stacked
from body_tracking.kinematics.motion import ACCELERATION_DENSITIES, joint_densities

ZERO_VELOCITY = "lkf_zero_velocity"
CONSTANT_VELOCITY = "lkf_constant_velocity"
LINEAR_MODELS = (ZERO_VELOCITY, CONSTANT_VELOCITY)

T_POSE = (
    "learn from a T-pose that is held still for a second where the sensors take the joints' centres to be, and take it "
    "off: straight arms are straight then; of skeletons that state covariances only"
)
"""What the parameter of this name does, in all filters that have it."""
_MAX_RANGE = 100.0
"""A coordinate beyond this many metres is no measurement of a person but a damaged number."""
_REFERENCE_DISTANCE = 2.0
"""Metres within which the measurement noise no longer shrinks."""
_EYE3 = np.eye(3)
_LEAST_VARIANCE = 1e-12
"""Square metres: a covariance that claims less in any direction, a micrometre, is damaged, and cannot be inverted."""
_SURPRISING, _MOST_SURPRISING = 4.0, 10.0
"""Times its expectation from which a normalised innovation squared raises the process noise, and up to which."""
_MOST_LEVEL = np.log(200.0)
"""Of a joint with 50 m/s2, the fastest that people punch, instead of 3."""
_ALL: IntArray = np.arange(N_JOINTS, dtype=np.intp)


def _towards_trunk() -> IntArray:
    """(25,) the next joint towards the base of the spine, which is its own."""
    towards = _ALL.copy()
    for parent, child in BONES:
        towards[child] = parent
    return towards


_TOWARDS_TRUNK = _towards_trunk()


class FilterError(BodyTrackingError):
    """A filter was asked for by an unknown name or with parameters that make no sense."""


@dataclass(frozen=True, slots=True)
class LinearKalmanParameters:
    """The settings of both linear filters; each field's metadata says what it is, its unit and its range.

    Raises:
        FilterError: a value out of its range.
    """

    acceleration_density_trunk: float = number_field(
        ACCELERATION_DENSITIES[0],
        "constant velocity: spectral density of the acceleration of spine, head, shoulders, hips, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    acceleration_density_limb: float = number_field(
        ACCELERATION_DENSITIES[1],
        "constant velocity: spectral density of the acceleration of elbows and knees, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    acceleration_density_extremity: float = number_field(
        ACCELERATION_DENSITIES[2],
        "constant velocity: spectral density of the acceleration of wrists, hands, ankles, feet, per axis",
        "m2/s3",
        1e-6,
        1e4,
    )
    velocity_density_trunk: float = number_field(
        0.02,
        "zero velocity: spectral density of the velocity of spine, head, shoulders, hips, per axis",
        "m2/s",
        1e-8,
        1e3,
    )
    velocity_density_limb: float = number_field(
        0.06, "zero velocity: spectral density of the velocity of elbows and knees, per axis", "m2/s", 1e-8, 1e3
    )
    velocity_density_extremity: float = number_field(
        0.2,
        "zero velocity: spectral density of the velocity of wrists, hands, ankles, feet, per axis",
        "m2/s",
        1e-8,
        1e3,
    )
    measurement_noise_scale: float = number_field(
        1.0,
        "where the skeleton brings no covariance: factor on the standard deviation per joint, tracking "
        "state and distance of body_tracking.core.measurement",
        "",
        0.01,
        100.0,
    )
    white_noise_share: float = number_field(
        0.06,
        "share of the measurement variance that is new in every frame, and is filtered; the rest is a slow "
        "error that no filter can remove, and is added to the covariance of the result",
        "",
        0.001,
        1.0,
    )
    adaptation: float = number_field(
        0.5,
        "by how much the logarithm of a joint's process noise rises with each normalised innovation squared "
        "beyond four times its expectation; 0 leaves the noise as it is",
        "",
        0.0,
        10.0,
    )
    adaptation_time: float = number_field(
        0.1, "time constant with which that fades: a thrust lasts that long", "s", 0.001, 100.0
    )
    initial_velocity_stddev: float = number_field(
        1.0, "standard deviation per axis of the velocity of a joint when it is first seen", "m/s", 1e-3, 100.0
    )
    gate_probability: float = number_field(
        0.9999,
        "a measurement is rejected where its innovation lies beyond this chi-square quantile (3 degrees of "
        "freedom); 1 rejects nothing",
        "",
        0.5,
        1.0,
    )
    reacquire_after: float = number_field(
        0.12,
        "a joint rejected without a break for longer than this is started anew on its measurement; much "
        "later the grown uncertainty would let it in as a sudden movement, and overshoot",
        "s",
        0.0,
        60.0,
    )
    predict_for: float = number_field(
        0.5, "a joint without an accepted measurement for longer than this is lost: not tracked, NaN", "s", 0.0, 60.0
    )
    reset_gap: float = number_field(
        1.0, "a gap between frames longer than this starts every joint anew", "s", 0.01, 600.0
    )

    reorder_window: float = number_field(
        0.1,
        "a frame older than the last one by no more than this came late and is ignored; an older one is a "
        "backward jump of time, which starts every joint anew",
        "s",
        0.0,
        10.0,
    )
    t_pose: bool = field(default=True, metadata={"doc": T_POSE})

    def __post_init__(self) -> None:
        check_fields(self, "linear filter", FilterError)


class LinearKalmanFilter:
    """25 independent linear Kalman filters, run as one stacked :class:`filterpy.kalman.KalmanFilter`.

    The process noise of a step of ``dt`` seconds is ``q dt`` (zero velocity: a random walk) or ``q`` times
    [[dt^3/3, dt^2/2], [dt^2/2, dt]] (constant velocity: white acceleration; Bar-Shalom 2001, eq. 6.2.2-12). Both make
    two half steps equal to one whole.

    A missing joint has an observation matrix of zeros, hence exactly no gain and no innovation (thesis, eq. 5.21-5.22).
    A rejected one goes back to its prior, which is the same.

    Attributes:
        counters: what happened since the construction, for diagnostics; joints are counted one by one.
        innovation_distances: (25,) squared Mahalanobis distance of the last frame's innovations by the white part of
            the noise (the normalised innovation squared, chi-square with 3 degrees of freedom where the model holds);
            NaN where a joint had no measurement or no prior.
    """

    def __init__(self, model: str, parameters: LinearKalmanParameters | None = None) -> None:
        """Set up without any joint known.

        Args:
            model: one of ``LINEAR_MODELS``.
            parameters: the defaults where None.

        Raises:
            FilterError: an unknown model.
        """
        from filterpy.common import Q_continuous_white_noise  # takes 0.8 s, which only who filters need pay

        if model not in LINEAR_MODELS:
            raise FilterError(f"unknown linear filter {model!r}, expected one of {', '.join(LINEAR_MODELS)}")
        self.model = model
        self.parameters = p = parameters or LinearKalmanParameters()
        if model == CONSTANT_VELOCITY:
            self._order = 2
            densities = (p.acceleration_density_trunk, p.acceleration_density_limb, p.acceleration_density_extremity)
            unit_step = Q_continuous_white_noise(2, dt=1.0, block_size=3, order_by_dim=False)
            powers = np.array([[3.0, 2.0], [2.0, 1.0]])
        else:
            self._order = 1
            densities = (p.velocity_density_trunk, p.velocity_density_limb, p.velocity_density_extremity)
            unit_step, powers = np.eye(3), np.array([[1.0]])
        # Every term is a power of dt: filterpy builds the noise once, for one second, and a step scales it.
        self._unit_noise: FloatArray = joint_densities(densities)[:, None, None] * unit_step
        self._noise_powers: FloatArray = np.kron(powers, np.ones((3, 3)))
        # an Ornstein-Uhlenbeck velocity of variance s driven by white noise of density q fades in 2 s / q
        self._fading_time: FloatArray = 2.0 * p.initial_velocity_stddev**2 / joint_densities(densities)
        self._gate = float(chdtri(3, 1.0 - p.gate_probability))
        self.counters: dict[str, int] = dict.fromkeys(
            ("measured", "predicted", "rejected", "reacquired", "lost", "damaged"), 0
        )
        self._arrivals = Arrivals(self.counters, p.reorder_window, p.reset_gap)
        self._centres = JointCentres(self.counters)
        self._restart()

    def reset(self) -> None:
        """Forget the person; the counters stay."""
        self._arrivals.reset()
        self._centres.reset()
        self._restart()

    def _restart(self) -> None:
        """Forget every joint."""
        from filterpy.kalman import KalmanFilter

        size = 3 * self._order
        self._kalman = KalmanFilter(dim_x=size, dim_z=3)
        self._kalman.x = Stacked.of(np.zeros((N_JOINTS, size, 1)))
        self._kalman.P = Stacked.of(np.broadcast_to(np.eye(size), (N_JOINTS, size, size)).copy())
        self._alive: BoolArray = np.zeros(N_JOINTS, dtype=bool)
        self._slow: FloatArray = np.zeros((N_JOINTS, 3, 3))
        self._level: FloatArray = np.zeros(N_JOINTS)
        self._unmeasured: FloatArray = np.zeros(N_JOINTS)
        self._rejected: FloatArray = np.zeros(N_JOINTS)
        self.innovation_distances: FloatArray = np.full(N_JOINTS, np.nan)

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """One step of algorithm 1 for every joint.

        Args:
            skeleton: in a fixed frame, usually ``/fused/skeleton``.

        Returns:
            The same body at the same stamp: position and covariance (position part of ``P`` and the slow part of the
            noise); velocity (constant velocity) or NaN (the zero-velocity model has none); and the state: the
            measurement's where it was used, INFERRED where the joint is predicted, NOT_TRACKED with NaN and an
            infinite covariance where it is lost or was never seen. None where the stamp repeats the last one or is a
            little older, or no joint is known.
        """
        arrival = self._arrivals.take(skeleton)
        if arrival is Arrival.IGNORED:
            return None
        if arrival is Arrival.AFTER_JUMP:
            self._centres.reset()
        if arrival is not Arrival.NEXT:  # after a gap it is still the same person
            self._restart()
        step = self._arrivals.elapsed if arrival is Arrival.NEXT else 0.0
        if self.parameters.t_pose:
            self._centres.update(skeleton)
        positions, measured = self._measurement(skeleton)
        noise = self._measurement_noise(skeleton, positions, measured)
        rejected = self._filter(positions, noise, measured & self._alive, step)
        self._book(step, measured, rejected)

        started = measured & (~self._alive | (self._rejected > self.parameters.reacquire_after))
        if started.any():
            self._start(started, positions, noise)
            self.counters["reacquired"] += int((started & rejected).sum())
        used = measured & (~rejected | started)
        slow = (1.0 - self.parameters.white_noise_share) * noise
        slow = self._centres.remaining(slow, np.where(measured[:, None], positions, np.nan), skeleton.stamp_ns)
        self._slow = np.where(used[:, None, None], slow, self._slow)
        return self._output(skeleton, used)

    def _measurement(self, skeleton: Skeleton) -> tuple[FloatArray, BoolArray]:
        """(25, 3) positions without a NaN or infinity, (25,) which of them are measurements."""
        # abs() < limit is False for NaN and infinity too
        sane = (np.abs(skeleton.positions) < _MAX_RANGE).all(axis=1)
        measured: BoolArray = sane & (skeleton.states > TrackingState.NOT_TRACKED)
        corrected = self._centres.corrected(skeleton.positions, measured, skeleton.stamp_ns)
        return np.where(measured[:, None], corrected, 0.0), measured

    def _measurement_noise(self, skeleton: Skeleton, positions: FloatArray, measured: BoolArray) -> FloatArray:
        """(25, 3, 3) covariance of the measurements, positive definite; the identity where there is none."""
        if skeleton.covariances is None:
            return self._modelled_noise(skeleton, positions, measured)
        noise = np.where(measured[:, None, None], skeleton.covariances, _EYE3)
        try:
            sound_all = noise.max() < _MAX_RANGE**2  # False for NaN and infinity too
            np.linalg.cholesky(noise - _LEAST_VARIANCE * _EYE3)
        except np.linalg.LinAlgError:
            sound_all = False
        if not sound_all:
            noise[~(np.abs(noise) < _MAX_RANGE**2).all(axis=(1, 2))] = 0.0
            sound = np.linalg.eigvalsh(noise)[:, 0] > _LEAST_VARIANCE
            self.counters["damaged"] += int((~sound).sum())
            noise = np.where(sound[:, None, None], noise, self._modelled_noise(skeleton, positions, measured))
        return noise

    def _modelled_noise(self, skeleton: Skeleton, positions: FloatArray, measured: BoolArray) -> FloatArray:
        """(25, 3, 3) by joint, tracking state and distance from the frame's origin, where a sensor stands."""
        inferred = np.where(skeleton.states == TrackingState.TRACKED, 1.0, INFERRED_FACTOR)
        distance = np.maximum(np.sqrt(np.einsum("ij,ij->i", positions, positions)) / _REFERENCE_DISTANCE, 1.0)
        stddev = self.parameters.measurement_noise_scale * BASE_STDDEV * inferred * distance
        return np.where(measured, stddev**2, 1.0)[:, None, None] * _EYE3

    def _filter(self, positions: FloatArray, noise: FloatArray, observed: BoolArray, step: float) -> BoolArray:
        """Predict all joints, update the observed ones, take back those beyond the gate; returns (25,) these."""
        kalman = self._kalman
        size = 3 * self._order
        carrier = self._carriers(observed)
        self._level *= np.exp(-step / self.parameters.adaptation_time)
        noise_of_step = self._unit_noise * step**self._noise_powers
        usual = np.exp(self._level)[:, None, None]
        if (carrier != _ALL).any():
            self._predict_carried(carrier, usual * noise_of_step, step)
        else:
            transition = np.eye(size)  # eq. 5.11, 5.12
            if self._order == 2:
                transition[:3, 3:] = step * _EYE3
            kalman.predict(F=transition, Q=usual * noise_of_step)

        observation = np.zeros((N_JOINTS, 3, size))  # eq. 5.11, 5.12; zero where nothing is observed (eq. 5.21)
        observation[:, :, :3] = observed[:, None, None] * _EYE3
        measurement = Stacked.of(np.where(observed[:, None], positions, 0.0)[:, :, None])
        white = self.parameters.white_noise_share * noise
        kalman.update(measurement, R=Stacked.of(white), H=Stacked.of(observation))
        distances = self._distances()
        self.innovation_distances = np.where(observed, distances, np.nan)
        suspects: BoolArray = np.array(distances > self._gate)
        surprise = np.clip(distances / 3.0 - _SURPRISING, 0.0, _MOST_SURPRISING - _SURPRISING)
        level = self._level
        self._level = np.minimum(level + self.parameters.adaptation * surprise, _MOST_LEVEL)
        if not suspects.any():
            self._carry(carrier, ~observed)
            return suspects

        # Too far for white noise: the slow error has changed (another sensor sees the joint now), or it is thrust
        # forward, or it is an outlier. Once more for these, with all of the noise of both kinds: a change is then
        # followed with a small kick to the velocity only.
        kalman.x, kalman.P = kalman.x_prior, kalman.P_prior
        raised = np.where(suspects[:, None, None], np.exp(self._level)[:, None, None] - usual, 0.0) * noise_of_step
        kalman.P = Stacked.of(np.asarray(kalman.P_prior) + raised)
        noise = np.where(suspects[:, None, None], noise, white)
        kalman.update(measurement, R=Stacked.of(noise), H=Stacked.of(observation))
        rejected: BoolArray = suspects & (self._distances() > self._gate)
        kalman.x[rejected] = kalman.x_prior[rejected]
        kalman.P[rejected] = kalman.P_prior[rejected]
        self._level[rejected] = level[rejected]  # nobody moves like that
        self._carry(carrier, ~observed | rejected)
        return rejected

    def _carriers(self, observed: BoolArray) -> IntArray:
        """(25,) which joint carries each along: itself where it is seen, now and when it was last looked for."""
        loose = ~observed | (self._unmeasured > 0.0)
        carrier = _ALL
        if self._order == 2 and loose.any():
            for _ in _ALL:  # as far as the longest chain at most
                further = np.where(loose[carrier], _TOWARDS_TRUNK[carrier], carrier)
                if (further == carrier).all():
                    break
                carrier = further
        return carrier

    def _predict_carried(self, carrier: IntArray, noise: FloatArray, step: float) -> None:
        """Predict all joints; those with another carrier (25,) move with it, and less and less against it.

        With ``tau`` the fading time, ``f = exp(-step / tau)``, ``r = tau (1 - f)`` and ``u`` the carrier's velocity,
        ``x' = x + r v + (step - r) u`` and ``v' = f v + (1 - f) u``; the noise is that of an integrated
        Ornstein-Uhlenbeck velocity (Gillespie 1996, eq. 2.8-2.9), which for a long ``tau`` is that of eq. 5.12. Where
        nothing on the way is seen the base of the spine carries, and goes on as it last moved, if that is known.
        """
        free = carrier != _ALL
        carrying = np.where(self._alive[carrier, None, None], self._kalman.x[carrier, 3:], 0.0)
        tau = np.where(free, self._fading_time, 1.0)
        fade = np.where(free, np.exp(-step / tau), 1.0)
        reach = np.where(free, tau * (1.0 - fade), step)
        transition = np.zeros((N_JOINTS, 6, 6))
        transition[:] = np.eye(6)
        transition[:, :3, 3:] = reach[:, None, None] * _EYE3
        transition[:, 3:, 3:] = fade[:, None, None] * _EYE3
        control = np.zeros((N_JOINTS, 6, 3))
        control[:, :3] = (step - reach)[:, None, None] * _EYE3
        control[:, 3:] = (1.0 - fade)[:, None, None] * _EYE3

        # per unit density: of velocity, of both, of position
        vv = 0.5 * tau * (1.0 - fade**2)
        tv = 0.5 * reach**2
        tt = tau**2 * (step - 2.0 * reach + vv)
        blocks = np.stack([np.stack([tt, tv], axis=-1), np.stack([tv, vv], axis=-1)], axis=-2)
        density = self._unit_noise[:, 3, 3]
        noise = np.where(free[:, None, None], density[:, None, None] * np.kron(blocks, _EYE3), noise)
        self._kalman.predict(u=Stacked.of(carrying), B=Stacked.of(control), F=Stacked.of(transition), Q=noise)

    def _carry(self, carrier: IntArray, unseen: BoolArray) -> None:
        """What the measurements corrected of a carrier's motion, its unseen joints (25,) do, too."""
        if self._order == 2:
            carried = unseen & (carrier != _ALL)
            correction = self._kalman.x - self._kalman.x_prior
            self._kalman.x[carried] += correction[carrier[carried]]

    def _distances(self) -> FloatArray:
        """(25,) squared Mahalanobis distances of the last update's innovations; 0 where nothing was observed."""
        innovation = np.asarray(self._kalman.y)
        distances: FloatArray = (innovation * (np.asarray(self._kalman.SI) @ innovation)).sum(axis=(1, 2))
        return distances

    def _book(self, step: float, measured: BoolArray, rejected: BoolArray) -> None:
        """Age the joints that got no measurement, and give up those for which it was too long."""
        accepted = measured & ~rejected
        self._unmeasured = np.where(accepted, 0.0, self._unmeasured + step)
        # a missing frame between two rejected ones is no break: only an accepted measurement is
        self._rejected = np.where(accepted, 0.0, np.where(rejected, self._rejected + step, self._rejected))
        lost = self._alive & (self._unmeasured > self.parameters.predict_for)
        self._alive &= ~lost
        self.counters["lost"] += int(lost.sum())
        self.counters["rejected"] += int(rejected.sum())

    def _start(self, joints: BoolArray, positions: FloatArray, noise: FloatArray) -> None:
        """Set joints to their measurement, at rest, with its covariance."""
        kalman = self._kalman
        kalman.x[joints] = 0.0
        kalman.x[joints, :3, 0] = positions[joints]
        kalman.P[joints] = np.diag([0.0] * 3 + [self.parameters.initial_velocity_stddev**2] * (3 * self._order - 3))
        kalman.P[joints, :3, :3] = self.parameters.white_noise_share * noise[joints]
        self._alive |= joints
        self._level[joints] = self._unmeasured[joints] = self._rejected[joints] = 0.0

    def _output(self, skeleton: Skeleton, used: BoolArray) -> Skeleton | None:
        alive = self._alive
        self.counters["measured"] += int(used.sum())
        self.counters["predicted"] += int((alive & ~used).sum())
        if not alive.any():
            return None
        state = self._kalman.x[:, :, 0]
        # copies, and plain arrays: what is handed out must not change with the next frame
        positions: FloatArray = np.array(state[:, :3])
        covariances: FloatArray = np.asarray(self._kalman.P)[:, :3, :3] + self._slow
        velocities: FloatArray = np.array(state[:, 3:]) if self._order == 2 else np.full((N_JOINTS, 3), np.nan)
        states = np.where(used, skeleton.states, np.uint8(TrackingState.INFERRED))
        if not alive.all():
            positions[~alive] = velocities[~alive] = np.nan
            covariances[~alive] = np.diag([np.inf] * 3)
            states[~alive] = TrackingState.NOT_TRACKED
        return Skeleton(
            skeleton.stamp_ns,
            skeleton.frame_id,
            positions,
            states,
            skeleton.body,
            covariances,
            velocities,
        )

"""The linear Kalman filters of all 25 joints (Schlagenhauf 2017, chapters 3.7 and 5.4, algorithm 1).

Each joint has a filter of its own with the thesis's state: its position (zero-velocity model, eq. 5.11) or its position
and velocity (constant-velocity model, eq. 5.12). Unlike there, the process noise is a continuous white noise with the
time step that really passed, the measurement noise is the fused skeleton's own, and every innovation is gated.

The errors of a depth sensor's skeleton are centimetres, its white noise millimetres: most errors persist for seconds (a
joint offset from the anatomical one, a tilt by the viewing direction). A filter with all of it as white noise would
understate its covariance. So the measurement covariance ``R`` is split: ``white_noise_share`` of it determines the
gain, the rest is added to the output covariance; the gate uses all of it.

At constant velocity a joint that is hidden in mid-reach would be a metre away after half a second. Instead, a hidden
joint moves with the nearest seen joint towards the trunk, and its velocity relative to that one decays (an
Ornstein-Uhlenbeck process whose stationary velocity has the initial standard deviation).

A sudden movement is no outlier, but with the gain of a slow one the filter would lag until it is rejected. So each
joint's process noise grows with large innovations and decays soon (adjustable level of the process noise, Bar-Shalom,
Li and Kirubarajan 2001, section 11.2).
"""

from __future__ import annotations

import numpy as np

from body_tracking.calibration.joint_centres import JointCentres
from body_tracking.core.chi_square import gate
from body_tracking.core.measurement import BASE_STDDEV, INFERRED_FACTOR
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
from body_tracking.filters.joint_smoothing import JointFrame, JointSmoother
from body_tracking.filters.parameters import FilterError, LinearKalmanParameters
from body_tracking.filters.stacked import StackedKalmanFilter
from body_tracking.kinematics.motion import joint_densities

ZERO_VELOCITY = "lkf_zero_velocity"
CONSTANT_VELOCITY = "lkf_constant_velocity"
LINEAR_MODELS = (ZERO_VELOCITY, CONSTANT_VELOCITY)

_MAX_RANGE = 100.0
"""Metres: a larger coordinate is damaged data."""
_REFERENCE_DISTANCE = 2.0
"""Metres: the modelled measurement noise is proportional to the distance from here on, and constant below."""
_EYE3 = np.eye(3)
_LEAST_VARIANCE = 1e-12
"""Square metres: a covariance with a smaller eigenvalue is damaged, and cannot be inverted."""
_SURPRISING, _MOST_SURPRISING = 4.0, 10.0
"""Multiples of its expectation between which a normalised innovation squared raises the process noise."""
_MOST_LEVEL = np.log(200.0)
"""Greatest log of the factor on the process noise: accelerations of 50 m/s2, a fast punch, instead of 3."""
_ALL: IntArray = np.arange(N_JOINTS, dtype=np.intp)


def _towards_trunk() -> IntArray:
    """(25,) the next joint towards the base of the spine; the base itself for the base."""
    towards = _ALL.copy()
    for parent, child in BONES:
        towards[child] = parent
    return towards


_TOWARDS_TRUNK = _towards_trunk()


class LinearKalmanFilter(JointSmoother):
    """25 independent linear Kalman filters, run as one :class:`StackedKalmanFilter`.

    The process noise of a step of ``dt`` seconds is ``q dt`` (zero velocity: a random walk) or ``q`` times
    [[dt^3/3, dt^2/2], [dt^2/2, dt]] (constant velocity: white acceleration; Bar-Shalom 2001, eq. 6.2.2-12). Both make
    two half steps equal to one whole.

    A missing joint has an observation matrix of zeros, hence neither gain nor innovation (thesis, eq. 5.21-5.22). A
    rejected one is reset to its prior, which is equivalent.

    Attributes:
        counters: events since the construction, for diagnostics; joints are counted individually.
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
        if model not in LINEAR_MODELS:
            raise FilterError(f"unknown linear filter {model!r}, expected one of {', '.join(LINEAR_MODELS)}")
        self.model = model
        self.parameters = p = parameters or LinearKalmanParameters()
        if model == CONSTANT_VELOCITY:
            self._order = 2
            densities = (p.acceleration_density_trunk, p.acceleration_density_limb, p.acceleration_density_extremity)
            unit_step = np.kron([[1.0 / 3.0, 0.5], [0.5, 1.0]], _EYE3)
            powers = np.array([[3.0, 2.0], [2.0, 1.0]])
        else:
            self._order = 1
            densities = (p.velocity_density_trunk, p.velocity_density_limb, p.velocity_density_extremity)
            unit_step, powers = np.eye(3), np.array([[1.0]])
        # every term is a power of dt: the noise is built once, for one second, and a step scales it
        self._unit_noise: FloatArray = joint_densities(densities)[:, None, None] * unit_step
        self._noise_powers: FloatArray = np.kron(powers, np.ones((3, 3)))
        # an Ornstein-Uhlenbeck velocity of variance s driven by white noise of density q fades in 2 s / q
        self._fading_time: FloatArray = 2.0 * p.initial_velocity_stddev**2 / joint_densities(densities)
        self._gate = gate(3, 1.0 - p.gate_probability)
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

    def forget_joint_centres(self) -> None:
        """Forget what a T-pose has shown of the person."""
        self._centres.reset()

    def _restart(self) -> None:
        """Forget every joint."""
        size = 3 * self._order
        covariances = np.broadcast_to(np.eye(size), (N_JOINTS, size, size)).copy()
        self._kalman = StackedKalmanFilter(np.zeros((N_JOINTS, size, 1)), covariances)
        self._alive: BoolArray = np.zeros(N_JOINTS, dtype=bool)
        self._slow: FloatArray = np.zeros((N_JOINTS, 3, 3))
        self._jumped: FloatArray = np.zeros((N_JOINTS, 3))
        self._level: FloatArray = np.zeros(N_JOINTS)
        self._unmeasured: FloatArray = np.zeros(N_JOINTS)
        self._rejected: FloatArray = np.zeros(N_JOINTS)
        self._started: BoolArray = np.zeros(N_JOINTS, dtype=bool)
        self._transition: FloatArray = np.eye(size)
        self._prior_covariance: FloatArray = np.zeros((N_JOINTS, size, size))
        self.innovation_distances: FloatArray = np.full(N_JOINTS, np.nan)

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """One step of algorithm 1 for every joint.

        Args:
            skeleton: in a fixed frame, usually ``/fused/skeleton``.

        Returns:
            The same body at the same stamp: position and covariance (position part of ``P``, the slow part of the
            noise, and the last jump); velocity (constant velocity) or NaN (the zero-velocity model has none); and the
            state: the measurement's where it was used, INFERRED where the joint is predicted, NOT_TRACKED with NaN and
            an infinite covariance where it is lost or was never seen. None for a repeated or late stamp, and where no
            joint is known.
        """
        arrival = self._arrivals.take(skeleton)
        if arrival is Arrival.IGNORED:
            return None
        if arrival is Arrival.AFTER_JUMP:
            self._centres.reset()
        if arrival is not Arrival.NEXT:
            self._restart()
        step = self._arrivals.elapsed if arrival is Arrival.NEXT else 0.0
        if self.parameters.t_pose:
            self._centres.update(skeleton)
        positions, measured = self._measurement(skeleton)
        noise = self._measurement_noise(skeleton, positions, measured)
        sudden, rejected = self._filter(positions, noise, measured & self._alive, step)
        self._update_ages(step, measured, rejected)

        started = measured & (~self._alive | (self._rejected > self.parameters.reacquire_after))
        if started.any():
            self._start(started, positions, noise)
            self.counters["reacquired"] += int((started & rejected).sum())
        # after a jump either position may be wrong; the more frames confirm the new one, the less the old one counts
        self._jumped *= np.exp(-step / max(self.parameters.reacquire_after, 1e-3))
        jumped = sudden | started & rejected
        if jumped.any():
            self._jumped[jumped] = (self._kalman.x - self._kalman.x_prior)[jumped, :3, 0]
        self._started = started
        used = measured & (~rejected | started)
        slow = (1.0 - self.parameters.white_noise_share) * noise
        self._slow = np.where(used[:, None, None], slow, self._slow)
        return self._output(skeleton, used)

    def _measurement(self, skeleton: Skeleton) -> tuple[FloatArray, BoolArray]:
        """(25, 3) finite positions, (25,) whether they are measured."""
        # abs() < limit is False for NaN and infinity too
        sane = (np.abs(skeleton.positions) < _MAX_RANGE).all(axis=1)
        measured: BoolArray = sane & (skeleton.states > TrackingState.NOT_TRACKED)
        corrected = self._centres.corrected(skeleton.positions, measured, skeleton.stamp_ns)
        return np.where(measured[:, None], corrected, 0.0), measured

    def _measurement_noise(self, skeleton: Skeleton, positions: FloatArray, measured: BoolArray) -> FloatArray:
        """(25, 3, 3) covariance of the measurements, positive definite; the identity for missing joints."""
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
        """(25, 3, 3) covariance by joint, tracking state and distance from the origin, where a sensor stands."""
        inferred = np.where(skeleton.states == TrackingState.TRACKED, 1.0, INFERRED_FACTOR)
        distance = np.maximum(np.sqrt(np.einsum("ij,ij->i", positions, positions)) / _REFERENCE_DISTANCE, 1.0)
        stddev = self.parameters.measurement_noise_scale * BASE_STDDEV * inferred * distance
        return np.where(measured, stddev**2, 1.0)[:, None, None] * _EYE3

    def _filter(
        self, positions: FloatArray, noise: FloatArray, observed: BoolArray, step: float
    ) -> tuple[BoolArray, BoolArray]:
        """Predict all joints, update the observed ones, reject those beyond the gate.

        Returns:
            (25,) those that moved suddenly, farther than white noise explains, and (25,) those that are rejected.
        """
        kalman = self._kalman
        size = 3 * self._order
        carrier = self._carriers(observed)
        self._level *= np.exp(-step / self.parameters.adaptation_time)
        noise_of_step = self._unit_noise * step**self._noise_powers
        scale = np.exp(self._level)[:, None, None]
        if (carrier != _ALL).any():
            self._predict_carried(carrier, scale * noise_of_step, step)
        else:
            transition = np.eye(size)  # eq. 5.11, 5.12
            if self._order == 2:
                transition[:3, 3:] = step * _EYE3
            kalman.predict(F=transition, Q=scale * noise_of_step)
            self._transition = transition

        observation = np.zeros((N_JOINTS, 3, size))  # eq. 5.11, 5.12; zero where nothing is observed (eq. 5.21)
        observation[:, :, :3] = observed[:, None, None] * _EYE3
        measurement = np.where(observed[:, None], positions, 0.0)[:, :, None]
        white = self.parameters.white_noise_share * noise
        kalman.update(measurement, R=white, H=observation)
        distances = self._distances()
        self.innovation_distances = np.where(observed, distances, np.nan)
        suspects: BoolArray = np.array(distances > self._gate)
        surprise = np.clip(distances / 3.0 - _SURPRISING, 0.0, _MOST_SURPRISING - _SURPRISING)
        self._prior_covariance = kalman.P_prior
        level = self._level
        self._level = np.minimum(level + self.parameters.adaptation * surprise, _MOST_LEVEL)
        if not suspects.any():
            self._carry(carrier, ~observed)
            return suspects, suspects

        # Too far for white noise: a change of the slow error (another sensor sees the joint), a sudden movement, or an
        # outlier. Update these again with white and slow noise: a change of the slow error then disturbs the velocity
        # only little.
        kalman.x, kalman.P = kalman.x_prior, kalman.P_prior
        raised = np.where(suspects[:, None, None], np.exp(self._level)[:, None, None] - scale, 0.0) * noise_of_step
        kalman.P = kalman.P_prior + raised
        prior_covariance = kalman.P
        noise = np.where(suspects[:, None, None], noise, white)
        kalman.update(measurement, R=noise, H=observation)
        rejected: BoolArray = suspects & (self._distances() > self._gate)
        kalman.x[rejected] = kalman.x_prior[rejected]
        kalman.P[rejected] = kalman.P_prior[rejected]
        self._prior_covariance = np.where(rejected[:, None, None], kalman.P_prior, prior_covariance)
        self._level[rejected] = level[rejected]  # an outlier does not raise the noise
        self._carry(carrier, ~observed | rejected)
        return suspects & ~rejected, rejected

    def _carriers(self, observed: BoolArray) -> IntArray:
        """(25,) the joint that carries each one: itself if it is observed now and was in the last frame."""
        loose = ~observed | (self._unmeasured > 0.0)
        carrier = _ALL
        if self._order == 2 and loose.any():
            for _ in _ALL:  # bounds the longest chain
                further = np.where(loose[carrier], _TOWARDS_TRUNK[carrier], carrier)
                if (further == carrier).all():
                    break
                carrier = further
        return carrier

    def _predict_carried(self, carrier: IntArray, noise: FloatArray, step: float) -> None:
        """Predict all joints; those with another carrier (25,) move with it, and their relative velocity decays.

        With ``tau`` the fading time, ``f = exp(-step / tau)``, ``r = tau (1 - f)`` and ``u`` the carrier's velocity,
        ``x' = x + r v + (step - r) u`` and ``v' = f v + (1 - f) u``; the noise is that of an integrated
        Ornstein-Uhlenbeck velocity (Gillespie 1996, eq. 2.8-2.9), which for a long ``tau`` is that of eq. 5.12. Where
        no joint on the way is seen, the carrier is the base of the spine at its last velocity, if known.
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
        self._kalman.predict(F=transition, Q=noise, control=control @ carrying)
        self._transition = transition

    def _carry(self, carrier: IntArray, unseen: BoolArray) -> None:
        """Apply the corrections of the carriers to their unseen joints (25,)."""
        if self._order == 2:
            carried = unseen & (carrier != _ALL)
            correction = self._kalman.x - self._kalman.x_prior
            self._kalman.x[carried] += correction[carrier[carried]]

    def _distances(self) -> FloatArray:
        """(25,) squared Mahalanobis distances of the last update's innovations; 0 where nothing was observed."""
        innovation = self._kalman.y
        distances: FloatArray = (innovation * (self._kalman.SI @ innovation)).sum(axis=(1, 2))
        return distances

    def _update_ages(self, step: float, measured: BoolArray, rejected: BoolArray) -> None:
        """Age the joints without a measurement, and drop those without one for too long."""
        accepted = measured & ~rejected
        self._unmeasured = np.where(accepted, 0.0, self._unmeasured + step)
        # only an accepted measurement resets the time of rejection, a missing one does not
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
        # copies, and plain arrays: the output must not change with the next frame
        positions: FloatArray = np.array(state[:, :3])
        covariances: FloatArray = self._kalman.P[:, :3, :3] + self._systematic()
        velocities: FloatArray = np.array(state[:, 3:]) if self._order == 2 else np.full((N_JOINTS, 3), np.nan)
        states = np.where(used, skeleton.states, np.uint8(TrackingState.INFERRED))
        if not alive.all():
            positions[~alive] = velocities[~alive] = np.nan
            covariances[~alive] = np.diag([np.inf] * 3)
            states[~alive] = TrackingState.NOT_TRACKED
        stamp_ns, frame_id, body = skeleton.stamp_ns, skeleton.frame_id, skeleton.body
        return Skeleton(stamp_ns, frame_id, positions, states, body, covariances, velocities)

    def _systematic(self) -> FloatArray:
        """(25, 3, 3) square metres: covariance of the errors that no filter removes, slow ones and the last jump."""
        return self._slow + self._jumped[:, :, None] * self._jumped[:, None, :]

    def last_frame(self, filtered: Skeleton) -> JointFrame:
        """The estimate after the last frame, with its filtered skeleton, for ``filters.smoothing``."""
        kalman, alive, continued = self._kalman, self._alive, self._alive & ~self._started
        posterior, prior = (kalman.x, kalman.P), (kalman.x_prior, self._prior_covariance)
        return JointFrame.of(filtered, posterior, self._systematic(), alive, continued, self._transition, prior)

"""The thesis's extended Kalman filter, for comparison (Schlagenhauf 2017, chapter 5.5, algorithm 2).

As published: the state is 26 angles and 26 rates (eq. 5.13), the model one of constant angular velocity with a fixed
time step (eq. 5.16), process and measurement noise are constant, the subject starts in the T-pose, which is theta = 0,
and the base of the spine stands still where it was then. Segment lengths come from the calibration in the T-pose; a
missing joint has neither innovation nor gain (eq. 5.21-5.22). Only line 8 of the filter is corrected: the innovation is
``z - h(s)``, not ``z - H s``. (Her errors in calibration and weights are corrected in ``calibration`` and ``fusion``.)

Its weaknesses are kept: of 26 directions in the space of angles six are never observed, eight not in the T-pose, and
the angles drift along them; there is no gate; time without a frame is not predicted. Its covariances are too small, and
singular along the segments. The package has better filters.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from body_tracking.core.measurement import left_right_axes
from body_tracking.core.parameters import check_fields, number_field
from body_tracking.core.skeleton import (
    N_JOINTS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)
from body_tracking.filters.arrival import Arrival, Arrivals
from body_tracking.filters.parameters import FilterError
from body_tracking.kinematics.schlagenhauf26 import Schlagenhauf26

SCHLAGENHAUF_EKF = "schlagenhauf_ekf"

_STARTS: IntArray = np.array(
    [Joint.SPINE_BASE, Joint.SPINE_MID]
    + [Joint.SPINE_SHOULDER, Joint.SHOULDER_LEFT, Joint.ELBOW_LEFT, Joint.WRIST_LEFT]
    + [Joint.SPINE_SHOULDER, Joint.SHOULDER_RIGHT, Joint.ELBOW_RIGHT, Joint.WRIST_RIGHT],
    dtype=np.intp,
)
"""(10,) first joints of the segments L1 to L10 (table 3.3), which end at the model's joints."""
_OTHER_SIDE: IntArray = np.array([0, 1, 6, 7, 8, 9, 2, 3, 4, 5], dtype=np.intp)
_NARROWEST = 0.05
"""Least horizontal width of shoulders and hips for a heading, metres."""


@dataclass(frozen=True, slots=True)
class SchlagenhaufParameters:
    """The settings; each field's metadata has its meaning, unit and range.

    The thesis states Q (figure 5.11, not for which quantities) but neither R nor P(0|0). The R with the
    least position error on simulated people in her three motions (with white noise of 5 and 20 mm and with the errors
    of simulated sensors) makes the comparison fair: 4 to 7 mm do as well, 10 mm costs up to 6 mm of position error,
    30 mm up to 25. P(0|0) is how well a person holds a T-pose; a tenth or three times of it change less than 1 mm.

    Raises:
        FilterError: a value out of its range.
    """

    process_noise: float = number_field(
        1e-4,
        "Q: variance added in every frame to each angle (rad2) and to each rate (rad2/s2); figure 5.11",
        "",
        1e-12,
        1e4,
    )
    measurement_stddev: float = number_field(
        0.005, "square root of R: standard deviation of each coordinate of each measured joint", "m", 1e-4, 10.0
    )
    initial_angle_stddev: float = number_field(0.1, "square root of P(0|0) of the angles", "rad", 1e-6, 10.0)
    initial_rate_stddev: float = number_field(0.1, "square root of P(0|0) of the rates", "rad/s", 1e-6, 100.0)
    time_step: float = number_field(
        1.0 / 30.0, "time step from frame to frame, independent of their stamps", "s", 1e-3, 1.0
    )
    calibration_frames: int = field(
        default=50,
        metadata={
            "doc": "frames in the T-pose at the start, of which the medians give segment lengths, place and heading; "
            "section 5.3.1",
            "unit": "",
            "min": 1,
            "max": 10_000,
        },
    )
    reset_gap: float = number_field(
        1.0,
        "a gap between frames longer than this is counted; it is a step like any other, as a restart would "
        "need the T-pose",
        "s",
        0.01,
        600.0,
    )
    reorder_window: float = number_field(
        0.1,
        "a frame older than the last one by no more than this is late and ignored; an older one is a backward "
        "jump of time, which restarts with a new T-pose",
        "s",
        0.0,
        10.0,
    )

    def __post_init__(self) -> None:
        check_fields(self, "filter of the thesis", FilterError)


class SchlagenhaufKalmanFilter:
    """Her filter on her model, one step of ``filterpy.kalman.ExtendedKalmanFilter`` a frame.

    The model of eq. 3.22-3.26 is that of eq. 5.13-5.16: f is linear, h the model's forward kinematics (eq. 5.19).

    Attributes:
        parameters: the settings.
        model: her model, placed where the subject stood; at the origin until calibrated.
        lengths: (10,) metres, L1 to L10; NaN until calibrated.
        innovations: (10, 3) metres, z - h(s) of the last frame, in the order of the model's joints; NaN where a joint
            was missing.
        counters: events since the construction, for diagnostics; joints are counted individually.
    """

    def __init__(self, parameters: SchlagenhaufParameters | None = None) -> None:
        """Set up, waiting for the T-pose; the default parameters where None."""
        self.parameters = parameters or SchlagenhaufParameters()
        self.counters: dict[str, int] = dict.fromkeys(("calibrating", "measured", "predicted", "diverged"), 0)
        self._arrivals = Arrivals(self.counters, self.parameters.reorder_window, self.parameters.reset_gap)
        self._forget()

    @property
    def q(self) -> FloatArray:
        """(26,) radians: the estimated angles."""
        return np.array(self._kalman.x[: self.model.nq])

    @property
    def velocity(self) -> FloatArray:
        """(26,) radians per second: the estimated rates."""
        return np.array(self._kalman.x[self.model.nq :])

    @property
    def covariance(self) -> FloatArray:
        """(52, 52) of angles and rates, P(k|k)."""
        return np.array(self._kalman.P)

    @property
    def calibrated(self) -> bool:
        """Whether the T-pose has been seen, and the filter runs."""
        return bool(np.isfinite(self.lengths).all())

    def reset(self) -> None:
        """Forget the subject and wait for a T-pose; the counters stay."""
        self._arrivals.reset()
        self._forget()

    def _forget(self) -> None:
        self.model = Schlagenhauf26()
        self.lengths: FloatArray = np.full(len(self.model.length_names), np.nan)
        self.innovations: FloatArray = np.full((len(self.model.joints), 3), np.nan)
        self._t_pose: deque[FloatArray] = deque(maxlen=self.parameters.calibration_frames)
        self._start()

    def _start(self) -> None:
        """s(0|0) is the T-pose at rest."""
        from filterpy.kalman import ExtendedKalmanFilter  # takes 0.8 s: import only for this filter

        p, n = self.parameters, self.model.nq
        kalman = ExtendedKalmanFilter(dim_x=2 * n, dim_z=3 * len(self.model.joints))
        kalman.x = np.zeros(2 * n)
        kalman.P = np.diag(np.repeat([p.initial_angle_stddev**2, p.initial_rate_stddev**2], n))
        kalman.F = np.eye(2 * n) + p.time_step * np.eye(2 * n, k=n)  # eq. 5.16
        kalman.Q = p.process_noise * np.eye(2 * n)
        kalman.R = p.measurement_stddev**2 * np.eye(kalman.dim_z)
        self._kalman = kalman

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """One step of algorithm 2.

        Args:
            skeleton: in a fixed frame with z up, usually ``/fused/skeleton``.

        Returns:
            The same body at the same stamp: the model's ten joints with covariance and velocity, and SpineBase at its
            place in the T-pose, without error. The state is the measurement's where it was used, INFERRED where the
            joint is predicted or fixed; joints that the model does not have are NOT_TRACKED, NaN, with an infinite
            covariance. None during the calibration in the T-pose, and for a repeated or late stamp.
        """
        arrival = self._arrivals.take(skeleton)
        if arrival is Arrival.IGNORED:
            return None
        if arrival is Arrival.AFTER_JUMP:
            self._forget()
        positions = np.where(skeleton.valid[:, None], skeleton.positions, np.nan)
        if not self.calibrated:
            self.counters["calibrating"] += 1
            self._t_pose.append(positions)
            if len(self._t_pose) == self._t_pose.maxlen:
                self._calibrate(np.array(self._t_pose))
            return None
        measured = skeleton.valid[self.model.joints]
        self._filter(positions[self.model.joints], measured)
        return self._output(skeleton, measured)

    def _calibrate(self, positions: FloatArray) -> None:
        """Lengths, position and heading from (n, 25, 3) metres in the T-pose; no change without position or heading.

        A length that is never seen is that of the other side, or of average proportions.
        """
        base = _median(positions[:, Joint.SPINE_BASE])
        axes = _median(left_right_axes(positions))[:, :2]  # of shoulders and hips, seen from above
        left = axes[np.isfinite(axes).all(axis=1)].sum(axis=0)
        if not np.isfinite(base).all() or np.hypot(*left) < _NARROWEST:
            return
        x, y = left / np.hypot(*left)
        self.model = Schlagenhauf26(base, np.array([[y, x, 0.0], [-x, y, 0.0], [0.0, 0.0, 1.0]]))

        spans = positions[:, self.model.joints] - positions[:, _STARTS]
        lengths = _median(np.sqrt((spans * spans).sum(axis=2)))
        lengths = np.where(np.isfinite(lengths), lengths, lengths[_OTHER_SIDE])
        average = self.model.default_lengths()
        known = np.isfinite(lengths)
        scale = float(np.median(lengths[known] / average[known])) if known.any() else 1.0
        self.lengths = np.where(known, lengths, scale * average)
        self._t_pose.clear()

    def _filter(self, positions: FloatArray, measured: BoolArray) -> None:
        """Predict (lines 2-3) and update (lines 5-9) with (10, 3) metres, of which (10,) are measured.

        A joint that is not measured has neither innovation nor gain (section 5.5.2, eq. 5.21-5.22).
        """
        kalman, n = self._kalman, self.model.nq
        kalman.predict()
        here = self.model.linearise(kalman.x[:n], self.lengths)
        expected = here.posture.positions
        seen = np.where(measured[:, None], positions, expected)  # no innovation where nothing is seen (eq. 5.21)
        observation = np.zeros((kalman.dim_z, 2 * n))
        # rows of zeros give no gain (eq. 5.22)
        observation[:, :n] = (here.jacobian * measured[:, None, None]).reshape(kalman.dim_z, n)
        try:
            kalman.update(seen.ravel(), lambda _: observation, lambda _: expected.ravel())
            sound = bool(np.isfinite(kalman.x).all() and np.isfinite(kalman.P).all())
        except (ValueError, np.linalg.LinAlgError):  # S is singular, or holds a NaN or an infinity
            sound = False
        self.innovations = np.where(measured[:, None], seen - expected, np.nan)
        self.counters["measured"] += int(measured.sum())
        self.counters["predicted"] += int((~measured).sum())
        if not sound:
            self.counters["diverged"] += 1
            self._start()

    def _output(self, skeleton: Skeleton, measured: BoolArray) -> Skeleton:
        """h(s(k|k)) (line 10) with its covariance by P(k|k)."""
        n, joints = self.model.nq, self.model.joints
        here = self.model.linearise(self._kalman.x[:n], self.lengths)
        positions, velocities = np.full((N_JOINTS, 3), np.nan), np.full((N_JOINTS, 3), np.nan)
        covariances = np.tile(np.diag([np.inf] * 3), (N_JOINTS, 1, 1))
        states = np.full(N_JOINTS, TrackingState.NOT_TRACKED, dtype=np.uint8)
        positions[joints] = here.posture.positions
        velocities[joints] = here.jacobian @ self._kalman.x[n:]
        covariances[joints] = here.jacobian @ self._kalman.P[:n, :n] @ here.jacobian.swapaxes(1, 2)
        states[joints] = np.where(measured, skeleton.states[joints], TrackingState.INFERRED)
        positions[Joint.SPINE_BASE] = self.model.base_position
        velocities[Joint.SPINE_BASE] = 0.0
        covariances[Joint.SPINE_BASE] = 0.0
        states[Joint.SPINE_BASE] = TrackingState.INFERRED
        return Skeleton(skeleton.stamp_ns, skeleton.frame_id, positions, states, skeleton.body, covariances, velocities)


def _median(values: FloatArray) -> FloatArray:
    """Median over the first axis without NaN; NaN where all values are."""
    known = np.isfinite(values).any(axis=0)
    result = np.full(values.shape[1:], np.nan)
    result[known] = np.nanmedian(values[:, known], axis=0)
    return result

"""The thesis's linear Kalman filters, for comparison (Schlagenhauf 2017, sections 3.7 and 5.4, algorithm 1).

As published, without corrections. ``thesis_lkf1`` is her LKF1 (section 5.7), the zero-velocity model (eq. 3.6-3.9 and
5.11); ``thesis_lkf2`` is her LKF2, the constant-velocity model (eq. 3.10-3.11 and 5.12). All 25 joints are filtered
alike and each by itself (section 5.4); the measurement is the fused joint position (section 5.4.1). Process and
measurement noise are constant (eq. 3.14-3.15), the time step is the sampling time, and every frame is one step. A joint
that no sensor tracks has neither innovation nor gain (section 5.5.2, eq. 5.21-5.22). There is no gate, and a joint is
never lost: at constant velocity a hidden hand keeps its velocity for as long as it is hidden.

The simplest reading of what the thesis does not specify:

====================  ================================================================================================
Q                     figures 5.7 and 5.9 state "Q = 0.005" for LKF2, without a unit: that number times the identity,
                      in metres and metres per second, the units of Kinect; the same for LKF1
R                     not stated: a number times the identity; see :class:`ThesisLkfParameters`
s(0|0), P(0|0)        not stated: a joint starts at rest where it is first measured; that frame is k = 0 for it
sampling time         not stated: 1/30 s, the sensors' (sections 4.2.1 and 5.2)
frames without a      algorithm 1 waits for a new measurement (line 4): time without a frame does not pass for it
measurement
====================  ================================================================================================

The covariance includes white noise only, not a Kinect's persistent errors of centimetres. ``filters.linear`` has better
filters with the same models.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from body_tracking.core.parameters import check_fields, number_field
from body_tracking.core.skeleton import N_JOINTS, BoolArray, FloatArray, Skeleton, TrackingState
from body_tracking.filters.arrival import Arrival, Arrivals
from body_tracking.filters.parameters import FilterError

THESIS_LKF1 = "thesis_lkf1"
THESIS_LKF2 = "thesis_lkf2"


@dataclass(frozen=True, slots=True)
class ThesisLkfParameters:
    """The settings of both filters; each field's metadata has its meaning, unit and range.

    Q is the thesis's (figures 5.7 and 5.9). R is not stated in it; this is the largest power of ten that costs no
    accuracy. The mean error of her ten joints, without each joint's offset, of four simulated people in her three
    motions and her fusion is 45.5 mm for any smaller R. With this one it is 45.8 mm (LKF1) and 46.0 mm (LKF2), and the
    jitter 10 % less; ten times as much costs 5 mm and 30 ms of delay, a hundred times 28 mm and 120 ms. P(0|0), here
    that of the first measurement, has no influence after five frames.

    Raises:
        FilterError: a value out of its range.
    """

    process_noise: float = number_field(
        0.005,
        "Q: variance added in every frame to each coordinate of a position (m2) and of a velocity (m2/s2); "
        "figures 5.7 and 5.9",
        "",
        1e-12,
        1e4,
    )
    measurement_noise: float = number_field(
        0.001, "R: variance of each coordinate of each measured joint", "m2", 1e-8, 100.0
    )
    initial_variance: float = number_field(
        0.001,
        "P(0|0): variance of each coordinate of a position (m2) and of a velocity (m2/s2) where a joint is first "
        "measured",
        "",
        1e-12,
        1e4,
    )
    time_step: float = number_field(
        1.0 / 30.0, "the sampling time: the time step from frame to frame, independent of their stamps", "s", 1e-3, 1.0
    )
    reorder_window: float = number_field(
        0.1,
        "a frame older than the last one by no more than this is late and ignored; an older one is a backward "
        "jump of time, which restarts every joint",
        "s",
        0.0,
        10.0,
    )

    def __post_init__(self) -> None:
        check_fields(self, "linear filter of the thesis", FilterError)


class _ThesisLinearFilter(ABC):
    """Algorithm 1 for 25 joints at once: stacks of the thesis's vectors and matrices, one of each joint.

    The model is s(k+1) = F s(k) + w(k) and z(k) = H s(k) + v(k): eq. 3.12-3.13 without an input u, and eq. 3.6-3.7,
    where F and H are called A and C.

    Attributes:
        parameters: the settings.
        F: (n, n) state transition, n = 3 or 6.
        H: (3, n) observation.
        Q: (n, n) covariance of the process noise (eq. 3.14).
        R: (3, 3) covariance of the measurement noise (eq. 3.15).
        s: (25, n) state estimates; zeros where a joint is not known yet.
        P: (25, n, n) their error covariances.
        counters: events since the construction, for diagnostics; joints are counted individually.
    """

    def __init__(self, parameters: ThesisLkfParameters | None = None) -> None:
        """Set up without any joint known; the default parameters where None."""
        self.parameters = p = parameters or ThesisLkfParameters()
        self.F, self.H = self._model(p.time_step)
        self.Q: FloatArray = p.process_noise * np.eye(len(self.F))
        self.R: FloatArray = p.measurement_noise * np.eye(len(self.H))
        self.counters: dict[str, int] = {"measured": 0, "predicted": 0}
        self._arrivals = Arrivals(self.counters, p.reorder_window)
        self._forget()

    @staticmethod
    @abstractmethod
    def _model(time_step: float) -> tuple[FloatArray, FloatArray]:
        """F and H."""

    def reset(self) -> None:
        """Forget the person; the counters stay."""
        self._arrivals.reset()
        self._forget()

    def _forget(self) -> None:
        self._known: BoolArray = np.zeros(N_JOINTS, dtype=bool)
        self.s: FloatArray = np.zeros((N_JOINTS, len(self.F)))
        self.P: FloatArray = np.tile(self.parameters.initial_variance * np.eye(len(self.F)), (N_JOINTS, 1, 1))

    def update(self, skeleton: Skeleton) -> Skeleton | None:
        """One step of algorithm 1 (lines 2-9) for every joint.

        Args:
            skeleton: in a fixed frame, usually ``/fused/skeleton``.

        Returns:
            The same body at the same stamp: position and covariance of s(k|k) and P(k|k); velocity (LKF2) or NaN (the
            state of LKF1 has none); and the state: the measurement's where it was used, INFERRED where the joint is
            predicted, NOT_TRACKED with NaN and an infinite covariance where it was never measured. None for a repeated
            or late stamp, and where no joint is known.
        """
        arrival = self._arrivals.take(skeleton)
        if arrival is Arrival.IGNORED:
            return None
        if arrival is Arrival.AFTER_JUMP:
            self._forget()
        measured = skeleton.valid
        z = np.where(measured[:, None], skeleton.positions, 0.0)
        self._step(z, measured)
        first = measured & ~self._known
        self._start(z, first)
        self.counters["measured"] += int(measured.sum())
        self.counters["predicted"] += int((self._known & ~measured).sum())
        return self._output(skeleton, measured) if self._known.any() else None

    def _step(self, z: FloatArray, measured: BoolArray) -> None:
        """Predict and update all joints, with (25, 3) metres, of which (25,) are measured; unknown ones do not matter.

        Eq. 3.16-3.21. The gain is zero where a joint is missing (section 5.5.2), so that lines 7 and 8 leave the
        prediction (eq. 5.21-5.22). Line 8 is computed in Joseph's form, which is the same matrix: the printed form may
        become negative by rounding when a joint is measured again after a long time.
        """
        F, H, Q, R = self.F, self.H, self.Q, self.R
        self.s = self.s @ F.T  # line 2, eq. 3.16
        self.P = F @ self.P @ F.T + Q  # line 3, eq. 3.17

        innovation = z - self.s @ H.T  # eq. 3.18
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + R)  # line 6, eq. 3.21
        K[~measured] = 0.0
        self.s = self.s + (K @ innovation[:, :, None])[:, :, 0]  # line 7, eq. 3.19
        kept = np.eye(len(F)) - K @ H
        self.P = kept @ self.P @ kept.swapaxes(1, 2) + K @ R @ K.swapaxes(1, 2)  # line 8, eq. 3.20

    def _start(self, z: FloatArray, joints: BoolArray) -> None:
        """Set joints (25,) to s(0|0), their measurement at rest, and P(0|0)."""
        self.s[joints] = z[joints] @ self.H  # H is [I] or [I 0]: its transpose puts a position into a state
        self.P[joints] = self.parameters.initial_variance * np.eye(len(self.F))
        self._known |= joints

    def _output(self, skeleton: Skeleton, measured: BoolArray) -> Skeleton:
        """s(k|k) (line 9) with its covariance in P(k|k)."""
        known = self._known
        states = np.where(measured, skeleton.states, np.uint8(TrackingState.INFERRED))
        states[~known] = TrackingState.NOT_TRACKED
        positions = np.where(known[:, None], self.s[:, :3], np.nan)
        velocities = np.full((N_JOINTS, 3), np.nan)
        velocities[known, : self.s.shape[1] - 3] = self.s[known, 3:]
        covariances = np.where(known[:, None, None], self.P[:, :3, :3], np.diag([np.inf] * 3))
        return Skeleton(skeleton.stamp_ns, skeleton.frame_id, positions, states, skeleton.body, covariances, velocities)


class ThesisLkf1(_ThesisLinearFilter):
    """LKF1: the zero-velocity model (eq. 3.8-3.9, 5.11), whose state is a joint's position, s = [x y z]."""

    @staticmethod
    def _model(time_step: float) -> tuple[FloatArray, FloatArray]:
        return np.eye(3), np.eye(3)


class ThesisLkf2(_ThesisLinearFilter):
    """LKF2: the constant-velocity model (eq. 3.10-3.11, 5.12), s = [x y z vx vy vz]."""

    @staticmethod
    def _model(time_step: float) -> tuple[FloatArray, FloatArray]:
        return np.eye(6) + time_step * np.eye(6, k=3), np.eye(3, 6)

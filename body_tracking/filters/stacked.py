"""Independent linear Kalman filters with states of the same size, computed together."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import FloatArray


class StackedKalmanFilter:
    """The Kalman filters of n independent states, each equation one multiplication of n matrices.

    The equations are those of ``filterpy.kalman.KalmanFilter`` in their order, with the covariance of the update in
    Joseph's form. They stand here because importing filterpy takes a node half a second.

    Attributes:
        x: (n, size, 1) states.
        P: (n, size, size) their covariances.
        x_prior, P_prior: both after the last prediction.
        y: (n, k, 1) innovations of the last update.
        SI: (n, k, k) inverses of their covariances.
    """

    def __init__(self, x: FloatArray, P: FloatArray) -> None:
        self.x, self.P = x, P
        self.x_prior, self.P_prior = x, P
        self.y: FloatArray = np.zeros((len(x), 0, 1))
        self.SI: FloatArray = np.zeros((len(x), 0, 0))

    def predict(self, F: FloatArray, Q: FloatArray, control: FloatArray | None = None) -> None:
        """One step.

        Args:
            F: (size, size) or (n, size, size) transition.
            Q: (size, size) or (n, size, size) covariance of the process noise.
            control: (n, size, 1) added to the states.
        """
        x = F @ self.x
        self.x = x if control is None else x + control
        self.P = F @ self.P @ F.swapaxes(-1, -2) + Q
        self.x_prior, self.P_prior = self.x.copy(), self.P.copy()

    def update(self, z: FloatArray, R: FloatArray, H: FloatArray) -> None:
        """Correct the states by measurements (n, k, 1) with covariances (n, k, k), observed by H (n, k, size)."""
        transposed = H.swapaxes(-1, -2)
        self.y = z - H @ self.x
        cross = self.P @ transposed
        self.SI = np.linalg.inv(H @ cross + R).astype(np.float64, copy=False)
        gain = cross @ self.SI
        self.x = self.x + gain @ self.y
        kept = np.eye(self.x.shape[1]) - gain @ H
        self.P = kept @ self.P @ kept.swapaxes(-1, -2) + gain @ R @ gain.swapaxes(-1, -2)

"""Output of a state: skeletons and estimates."""

from __future__ import annotations

import numpy as np

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.skeleton import N_JOINTS, FloatArray, Skeleton, TrackingState
from body_tracking.filters.ekf import kernels
from body_tracking.filters.ekf.displacement import Displacement
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.priors import VAGUE, Priors
from body_tracking.filters.ekf.state import State, StateSpace

_INFERRED = np.uint8(TrackingState.INFERRED)
_UPDATES = 2
_UNKNOWN = np.zeros((N_JOINTS, 3, 3))
_UNKNOWN[:] = np.diag([np.inf] * 3)


class Output:
    """Makes skeletons and estimates of a state.

    Args:
        space: of the states.
        displacement: of the filter.
        priors: of the filter.
        parameters: of the filter.
    """

    def __init__(
        self, space: StateSpace, displacement: Displacement, priors: Priors, parameters: EkfParameters
    ) -> None:
        self._space, self._model, self._ranges = space, space.model, space.ranges
        self._displacement, self._priors, self._parameters = displacement, priors, parameters
        names = space.model.coordinate_names[6:]
        self._twists = np.array([name.startswith(("shoulder_z", "forearm_pronation")) for name in names])
        self._postural = np.flatnonzero(np.append(space.prior.postural, [True] * 3))
        self._posture_variance = space.prior_table.stddev[self._postural] ** 2
        elevations = np.array([name.startswith("clavicle_elevation") for name in names] + [False] * 3)
        self._followed = elevations[self._postural]
        self._without_lengths = np.delete(np.arange(space.size), space.lengths)
        self._last_handed_out: tuple[State, FloatArray, FloatArray] | None = None

    def forget(self) -> None:
        """Forget the person."""
        self._last_handed_out = None

    def _handed_out(self, state: State) -> tuple[FloatArray, FloatArray]:
        """(35,) configuration for the output, and its covariance (85, 85) with lengths and velocities.

        The filter tracks the joint centres as the sensors see them. The covariance of their unknown offsets from the
        anatomical ones is added here. Then follows an iterated update by the posture prior (``kinematics.posture``),
        once for each output and never fed back. It turns no segment whose orientation is measured.
        """
        space = self._space
        if self._last_handed_out is None or self._last_handed_out[0] is not state:
            q, covariance = state.q, state.covariance[: space.size, : space.size].copy()
            pose = slice(space.observed)
            offsets, disputed = self._displacement.displaced(state)
            covariance[pose, pose] += offsets
            if state.sources.names:
                q = self._centred(q, state.covariance[space.tangent, space.tangent])
            if self._parameters.posture:
                free, _ = self._priors.free(state, covariance, np.empty((space.size, 0), dtype=np.float32))
                held = 0.0 if free is covariance else covariance - free
                q = self._upright(q, state, free)
                covariance = free + held
            changes = np.stack([disputed, state.jump])
            covariance[pose, pose] += changes.T @ changes
            self._last_handed_out = state, q, covariance
        return self._last_handed_out[1:]

    def _upright(self, q: FloatArray, state: State, covariance: FloatArray) -> FloatArray:
        """(35,) configuration after the update by the posture prior; changes its covariance (85, 85) in place.

        An offset of a shoulder changes the elevation of its clavicle by nearly the same angle in every pose. So the
        prior corrects the mean of this elevation, and the filter keeps the changes. A prior of each pose alone would
        draw a raised shoulder down (docs/tried.md, "Shoulders that rise").
        """
        mean = np.full(len(self._postural), np.nan)
        if state.mean_posture is not None and state.sensors:  # orientations alone do not show a clavicle's motion
            mean[self._followed] = state.mean_posture[self._postural][self._followed]
        return kernels.upright(
            q,
            state.lengths,
            covariance,
            self._postural,
            self._posture_variance,
            mean,
            self._model.tree,
            self._space.prior_table,
            _UPDATES,
        )

    def _centred(self, q: FloatArray, covariance: FloatArray) -> FloatArray:
        """(35,) configuration, updated by the middle of the ranges of vague twists; its covariance is (32, 32)."""
        soft = self._ranges.soft_coordinates(q)
        gradients = np.zeros((self._space.nv - 6, self._space.nv))
        gradients[:, 6:] = soft.gradients
        stddev = self._ranges.stddev
        vague = ((gradients @ covariance) * gradients).sum(axis=1) > (VAGUE * stddev) ** 2
        vague &= self._twists
        rows = gradients[vague]
        cross = covariance @ rows.T
        away = soft.values[vague] - self._ranges.centre[vague]
        return self._model.integrate(q, -cross @ np.linalg.solve(rows @ cross + np.diag(stddev[vague] ** 2), away))

    def estimate(self, state: State, frame_id: str, body: int) -> ModelEstimate:
        """The state of the model.

        Args:
            state: of the filter.
            frame_id: of the base.
            body: number of the person.
        """
        space = self._space
        q, known = self._handed_out(state)
        return ModelEstimate(
            state.stamp_ns,
            frame_id,
            body,
            q,
            state.velocity,
            known.take(self._without_lengths, 0).take(self._without_lengths, 1),
            state.lengths,
            np.sqrt(known.diagonal()[space.lengths]),
        )

    def skeleton(self, state: State, skeleton: Skeleton) -> Skeleton:
        """The modelled joints, with frame, body and tracking states of a skeleton.

        A joint is INFERRED where predicted, NOT_TRACKED where not modelled.
        """
        space = self._space
        q, covariance = self._handed_out(state)
        lines = self._model.linearised(q, state.lengths)
        joints = self._model.joints
        observation = lines.observation
        positions, velocities = np.full((2, N_JOINTS, 3), np.nan)
        covariances = _UNKNOWN.copy()
        states = np.zeros(N_JOINTS, dtype=np.uint8)
        positions[joints] = lines.posture.positions
        velocities[joints] = (observation[:, space.tangent] @ state.velocity).reshape(-1, 3)
        covariances[joints] = kernels.point_covariances(
            observation, np.ascontiguousarray(covariance[: space.observed, : space.observed])
        )
        used = state.used_ns == skeleton.stamp_ns
        states[joints] = np.where(used, skeleton.states[joints], _INFERRED)
        return Skeleton(state.stamp_ns, skeleton.frame_id, positions, states, skeleton.body, covariances, velocities)

"""Motion model of a person."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray
from body_tracking.filters.ekf.kernels import carry, transported
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.sources import PER_SOURCE, advance
from body_tracking.filters.ekf.state import State, StateSpace

_SIDES, _ARM = ("left", "right"), ("shoulder", "elbow", "forearm", "wrist")
_OF_SPEED = 16.0
"""1/s: additional density of the acceleration, per square of the joint's speed, of elbows and of joints that turn a
segment whose orientation is measured. A limb swung twice a second accelerates by 4 pi times its speed for about a tenth
of a second; with too small a density fast elbows lag by 60 ms, and the lag of a measured segment would be attributed to
errors of its source. Shoulders are too noisy about the upper arm's axis (people who walk err more with it)."""
_DOUBT_TIME = 0.65
"""Seconds: decay time of the evidence of frames that contradict the state; successive frames share their errors."""
_DENSITY = {
    "base_level": 1.0,
    "base_height": 1.0,
    "base_turn": 20.0,
    "base_tilt": 2.0,
    "spine": 2.0,
    "arm": 3.0,
}
"""Spectral densities of accelerations, chosen on simulated people: m2/s3 of the base's place, rad2/s3 of the rest.
People walk and turn at once, and hardly rise or tilt; neck and clavicles move as the spine; arm: shoulder to wrist."""
_BESIDE_ORIENTATIONS = 50.0
"""rad2/s3: least density of the joints that turn a segment whose orientation is measured. Orientations are quick and
need no smoothing; the lag of a smoothed pose would be attributed to errors of their sources."""


class Motion:
    """Integrated Ornstein-Uhlenbeck velocities.

    Args:
        space: of the states.
        parameters: of the filter.
    """

    def __init__(self, space: StateSpace, parameters: EkfParameters) -> None:
        self._space, self._model, self._parameters = space, space.model, parameters
        self._balls = np.ascontiguousarray(space.model.ball_v[:, 0])
        self._same_joint, self._density = self._densities()
        self._quick = self._quick_table()
        self._swift = self._quick.copy()
        self._swift[:, :6] = False
        self._elbows = np.array([name.startswith("elbow") for name in self._model.coordinate_names])

    def predicted(self, state: State, stamp_ns: int) -> State:
        """A state predicted to a time by the motion model (integrated Ornstein-Uhlenbeck velocity)."""
        space = self._space
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        if dt <= 0.0:
            return state
        tau = self._parameters.velocity_time
        fade, reach = self._faded(dt)
        density, swift = self._density, self._elbows
        if state.sources.names:
            quick = self._quick[state.sources.segments].any(axis=0)
            density = np.where(quick, np.maximum(density, _BESIDE_ORIENTATIONS), density)
            swift = swift | self._swift[state.sources.segments].any(axis=0)
        density = density + _OF_SPEED * swift * (self._same_joint @ (state.velocity * state.velocity))
        step = reach * state.velocity
        q = self._model.integrate(state.q, step)

        # covariance of the integrals of white noise over dt
        vv = 0.5 * tau * (1.0 - fade * fade)
        tv = 0.5 * reach * reach
        tt = tau * tau * (dt - 2.0 * reach + vv)
        p, crosses = transported(
            state.covariance,
            state.crosses,
            self._turns(step),
            self._balls,
            reach,
            fade,
            math.exp(-dt / self._parameters.slow_time),
            np.array([[tt], [vv], [tv]]) * density,
        )
        sources = state.sources
        if sources.names:
            share = advance(p, space.size, sources, dt)
            crosses.reshape(len(p), -1)[space.size :].reshape(len(sources), PER_SOURCE, -1)[:, 4:] *= share
            sources = sources.faded(share)
        believed = math.exp(-dt / max(self._parameters.reacquire_after, 1e-3))
        return state.but(
            stamp_ns=stamp_ns,
            q=q,
            velocity=fade * state.velocity,
            covariance=p,
            crosses=crosses,
            jump=believed * state.jump,
            since_prior=state.since_prior + dt,
            tracked=state.tracked + dt,
            fresh=False,
            sources=sources,
            doubt=math.exp(-dt / _DOUBT_TIME) * state.doubt if state.doubt else 0.0,
        )

    def carry(self, part: FloatArray, state: State, stamp_ns: int) -> None:
        """Multiply rows (85, n) by the transition of :meth:`predicted` from the left, in place."""
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        fade, reach = self._faded(dt)
        carry(part, self._turns(reach * state.velocity), self._balls, reach, fade)

    def _faded(self, dt: float) -> tuple[float, float]:
        """Decay factor of a velocity over ``dt`` seconds, and displacement per unit of velocity, in seconds."""
        fade = math.exp(-dt / self._parameters.velocity_time)
        return fade, self._parameters.velocity_time * (1.0 - fade)

    def _turns(self, step: FloatArray) -> FloatArray:
        """(3, 3, 3) rotations of the free rotations' tangents by a step (32,)."""
        return so3.quat_to_matrix(so3.exp(-step[self._model.ball_v]))

    def _densities(self) -> tuple[FloatArray, FloatArray]:
        """(32, 32) 1 for two coordinates of the same joint, else 0, and (32,) the density of each."""
        joints: list[str] = []
        densities: list[float] = []
        for name in self._model.coordinate_names:
            part, side = name.split("_")[0], name.rsplit("_", 1)[-1]
            kinds = {"x": "base_level", "y": "base_level", "z": "base_height", "rz": "base_turn"}
            joint = kinds.get(side, "base_tilt") if part == "base" else f"{part}_{side}" if side in _SIDES else part
            joints.append(joint)
            densities.append(_DENSITY.get(joint, _DENSITY["arm" if joint.startswith(_ARM) else "spine"]))
        same = np.array([[float(one == other) for other in joints] for one in joints])
        return same, np.array(densities)

    def _quick_table(self) -> BoolArray:
        """(12, 32) which coordinates turn a segment quickly: those of its limb, or all that turn it for the trunk."""
        names = self._model.coordinate_names
        found = np.zeros((len(self._model.segment_names), len(names)), dtype=np.bool_)
        for number, segment in enumerate(self._model.segment_names):
            turning = self._model.turned_by(segment).tolist()
            own = [k for k in turning if names[k].endswith("_" + segment.rsplit("_", 1)[-1])]
            found[number, own or turning] = True
        return found

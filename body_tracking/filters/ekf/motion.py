"""Motion model of a person, with adaptive noise densities."""

from __future__ import annotations

import math

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray
from body_tracking.filters.ekf.kernels import carry, transported
from body_tracking.filters.ekf.parameters import EkfParameters
from body_tracking.filters.ekf.sources import PER_SOURCE, advance
from body_tracking.filters.ekf.state import State, StateSpace

_WHITENESS_TIME = 0.25
"""Seconds over which corrections of a velocity are summed: about what the filter takes to follow a movement."""
_OF_SPEED = 16.0
"""1/s: with orientations, additional density of a joint's acceleration per square of its speed. A limb swung twice a
second has 4 pi times its speed as acceleration for about a tenth of a second; with too small a density the lag would be
attributed to errors of the sources."""
_DOUBT_TIME = 0.65
"""Seconds for which frames that contradict the state are remembered: one errs as those shortly before."""
_UNTOUCHED = 0.02
_RATIO_BOUND = 8.0
_DENSITY_DOWN, _DENSITY_UP = 3.0, 4.0


class Motion:
    """Integrated Ornstein-Uhlenbeck velocities, and the densities of the noise that drives them.

    Args:
        space: of the states.
        parameters: of the filter.

    Attributes:
        first_log_density: (groups,) log of the spectral densities before anything is learnt.
    """

    def __init__(self, space: StateSpace, parameters: EkfParameters) -> None:
        self._space, self._model, self._parameters = space, space.model, parameters
        self._balls = np.ascontiguousarray(space.model.ball_v[:, 0])
        self._group, self.first_log_density = self._groups()
        self._log_density_bounds = self.first_log_density - _DENSITY_DOWN, self.first_log_density + _DENSITY_UP
        self._group_sum = np.zeros((len(self.first_log_density), space.nv))
        self._group_sum[self._group, np.arange(space.nv)] = 1.0
        self._quick = self._quick_table()
        self._swift = np.zeros((len(self._quick), space.nv), dtype=np.bool_)
        for segment, turning in enumerate(self._quick):
            self._swift[segment, turning[turning >= 6]] = True

    def predicted(self, state: State, stamp_ns: int) -> State:
        """The motion model over the time that passed (integrated Ornstein-Uhlenbeck velocity)."""
        space = self._space
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        if dt <= 0.0:
            return state
        tau = self._parameters.velocity_time
        fade, reach = self._faded(dt)
        density = np.exp(state.log_density)[self._group]
        if state.sources.names:
            speeds = (self._group_sum @ (state.velocity * state.velocity))[self._group]
            density += _OF_SPEED * self._swift[state.sources.segments].any(axis=0) * speeds
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
            math.exp(-dt / self._slow_time(state)),
            np.array([[tt], [vv], [tv]]) * density,
        )
        sources = state.sources
        if sources.names:
            share = advance(p, space.size, sources, dt, self._parameters)
            crosses.reshape(len(p), -1)[space.size :].reshape(len(sources), PER_SOURCE, -1)[:, 4:] *= share
            sources = sources.faded(share)
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
            doubt=math.exp(-dt / _DOUBT_TIME) * state.doubt if state.doubt else 0.0,
        )

    def carry(self, part: FloatArray, state: State, stamp_ns: int) -> None:
        """Multiply rows (85, n) by the transition of :meth:`predicted` from the left, in place."""
        dt = (stamp_ns - state.stamp_ns) / NANOSECONDS
        fade, reach = self._faded(dt)
        carry(part, self._turns(reach * state.velocity), self._balls, reach, fade)

    def _faded(self, dt: float) -> tuple[float, float]:
        """Share of a velocity after a time, and by how many seconds of it the position moves."""
        fade = math.exp(-dt / self._parameters.velocity_time)
        return fade, self._parameters.velocity_time * (1.0 - fade)

    def _turns(self, step: FloatArray) -> FloatArray:
        """(3, 3, 3) rotations of the free rotations' tangents by a step (32,)."""
        return so3.quat_to_matrix(so3.exp(-step[self._model.ball_v]))

    def _slow_time(self, state: State) -> float:
        """Seconds for which slow errors of cameras persist."""
        p = self._parameters
        return p.slow_time_beside_orientations if state.sources.names else p.slow_time

    def densities_learnt(
        self, state: State, moved: FloatArray, variance: FloatArray, remaining: FloatArray, dt: float
    ) -> FloatArray:
        """Adapt the spectral densities to the mean corrections of the velocities."""
        rate = self._parameters.density_rate * dt / _WHITENESS_TIME
        # coordinates that the measurement does not touch say nothing
        share = variance / (variance + _UNTOUCHED * remaining + 1e-30)
        ratio = np.minimum(moved * moved / (variance + 1e-30), _RATIO_BOUND) - 1.0
        lean = self._group_sum @ (share * ratio) / (self._group_sum @ share + 0.3)
        least, greatest = self._log_density_bounds
        if state.sources.names:
            least = least.copy()
            quick = np.concatenate([self._quick[segment] for segment in state.sources.segments.tolist()])
            least[self._group[quick]] = math.log(self._parameters.density_beside_orientations)
            greatest = np.maximum(greatest, least)
        result: FloatArray = np.minimum(np.maximum(state.log_density + rate * lean, least), greatest)
        return result

    def _groups(self) -> tuple[IntArray, FloatArray]:
        """(32,) the group of each coordinate that shares a density, and (groups,) their first log densities."""
        p = self._parameters
        keys: list[str] = []
        densities: list[float] = []
        groups = np.empty(self._space.nv, dtype=np.intp)
        for number, name in enumerate(self._model.coordinate_names):
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
        for segment in self._model.segment_names:
            side = segment.rsplit("_", 1)[-1]
            turning = self._model.turned_by(segment)
            own = [k for k in turning.tolist() if self._model.coordinate_names[k].endswith(f"_{side}")]
            found.append(np.array(own or turning, dtype=np.intp))
        return found

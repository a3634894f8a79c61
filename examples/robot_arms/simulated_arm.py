"""An arm in MuJoCo whose joints have position servos, and a controller that reaches each point in a stated time."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


class SimulatedArm:
    """Follows set points as a robot with ``joint_trajectory_controller`` or ``forward_command_controller`` does.

    Args:
        file: the MuJoCo model; an actuator per joint, with the joint's name.
        joints: n names, in the order of commands.
        home: (n,) radians: initial positions.

    Attributes:
        set_point: (n,) radians: the present set points of the servos.
    """

    def __init__(self, file: Path, joints: Sequence[str], home: FloatArray) -> None:
        self._model = mujoco.MjModel.from_xml_path(str(file))
        self._data = mujoco.MjData(self._model)
        self._places = [self._model.joint(name).qposadr[0] for name in joints]
        self._speeds = [self._model.joint(name).dofadr[0] for name in joints]
        self._actuators = [self._model.actuator(name).id for name in joints]
        self._bodies = [self._model.joint(name).bodyid[0] for name in joints]
        self._tip = self._model.site("tip").id
        self._goal, self._remaining = home.copy(), 0.0
        self.set_point = home.copy()
        self._data.qpos[self._places] = home
        self._data.ctrl[self._actuators] = home
        mujoco.mj_forward(self._model, self._data)

    @property
    def position(self) -> FloatArray:
        """(n,) radians: positions of the joints."""
        return np.array(self._data.qpos[self._places])

    @property
    def velocity(self) -> FloatArray:
        """(n,) rad/s: velocities of the joints."""
        return np.array(self._data.qvel[self._speeds])

    @property
    def points(self) -> FloatArray:
        """(n + 1, 3) metres: places of the joints and of the tip; z up."""
        return np.vstack([self._data.xpos[self._bodies], self._data.site_xpos[self._tip]])

    def go_to(self, position: FloatArray, seconds: float = 0.0) -> None:
        """Move the set points linearly to (n,) radians within some seconds."""
        self._goal, self._remaining = position.copy(), seconds

    def advance(self, seconds: float) -> None:
        """Simulate some seconds."""
        step = self._model.opt.timestep
        for _ in range(round(seconds / step)):
            share = min(step / self._remaining, 1.0) if self._remaining > 0.0 else 1.0
            self.set_point = self.set_point + share * (self._goal - self.set_point)
            self._remaining = max(0.0, self._remaining - step)
            self._data.ctrl[self._actuators] = self.set_point
            mujoco.mj_step(self._model, self._data)

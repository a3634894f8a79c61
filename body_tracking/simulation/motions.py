"""The thesis's test motions (Schlagenhauf 2017, chapters 4.3.3 and 5.6), as smooth functions of time.

Each starts and ends in a T-pose; moves between rest and motion are minimum-jerk.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from body_tracking.simulation.figure import Pose
from body_tracking.simulation.trajectories import minimum_jerk
from body_tracking.skeleton import FloatArray

TPOSE_S = 3.0
"""Seconds of T-pose at the beginning."""
_MOVE_S = 1.0
_END_S = 1.5


def _step(time: FloatArray, start: float, duration: float) -> FloatArray:
    """0 before, 1 after, minimum-jerk between."""
    return minimum_jerk((time - start) / duration)


def _swing(time: FloatArray, start: float, period: float, repetitions: int) -> FloatArray:
    """From 0 to 1 and back, ``repetitions`` times."""
    phase = np.clip((time - start) / period, 0.0, repetitions)
    result: FloatArray = 0.5 - 0.5 * np.cos(2.0 * np.pi * phase)
    return result


@dataclass(frozen=True, slots=True)
class Motion:
    """A motion with a name.

    Attributes:
        name: of the motion, and of its recording.
        duration: seconds, with the T-poses.
        pose: (n,) seconds to the pose then.
    """

    name: str
    duration: float
    pose: Callable[[FloatArray], Pose]


def _pose(
    time: FloatArray,
    active: FloatArray,
    plane: FloatArray,
    elevation: FloatArray,
    rotation: FloatArray,
    elbow: FloatArray,
    trunk: FloatArray,
) -> Pose:
    """Degrees of both arms and of the trunk, blended with a T-pose by ``active``, and the sway of a standing person."""

    def arms(angle: FloatArray, rest: float) -> FloatArray:
        return np.radians(np.repeat((rest + active * (angle - rest))[:, None], 2, axis=1))

    # Standing people sway by some millimetres at some tenths of a hertz, and bring the trunk along.
    sway = 0.006 * np.stack([np.sin(1.9 * time), np.sin(1.3 * time + 1.0), 0.0 * time], axis=1)
    leaning = np.stack([1.5 * np.sin(1.1 * time + 0.5), 1.0 * np.sin(0.8 * time + 2.0), 0.0 * time], axis=1)
    return Pose(
        trunk=np.radians(trunk + leaning),
        plane=arms(plane, 5.0),
        elevation=arms(elevation, 88.0),
        rotation=arms(rotation, 0.0),
        elbow=arms(elbow, 8.0),
        sway=sway,
    )


def _active(time: FloatArray, moving: float) -> FloatArray:
    return _step(time, TPOSE_S, _MOVE_S) - _step(time, TPOSE_S + _MOVE_S + moving, _MOVE_S)


def _wave(time: FloatArray) -> Pose:
    """Upper arms out, forearms up, both swinging in the frontal plane."""
    swing = _swing(time, TPOSE_S + _MOVE_S, 1.6, 5)
    zero = np.zeros_like(time)
    return _pose(
        time,
        _active(time, 8.0),
        plane=zero + 10.0,
        elevation=92.0 + 18.0 * swing,
        rotation=zero - 80.0,
        elbow=100.0 - 60.0 * swing,
        trunk=np.zeros((len(time), 3)),
    )


def _slow_down(time: FloatArray) -> Pose:
    """Both arms forward, palms down, pressing down and rising again in the sagittal plane."""
    swing = _swing(time, TPOSE_S + _MOVE_S, 2.0, 4)
    zero = np.zeros_like(time)
    return _pose(
        time,
        _active(time, 8.0),
        plane=zero + 82.0,
        elevation=105.0 - 60.0 * swing,
        rotation=zero - 60.0,
        elbow=60.0 - 35.0 * swing,
        trunk=np.stack([6.0 * swing, zero, zero], axis=1),
    )


def _twist(time: FloatArray) -> Pose:
    """Arms out, the trunk turning from side to side by 50 degrees."""
    start, period, repetitions = TPOSE_S + _MOVE_S, 3.6, 3
    phase = np.clip((time - start) / period, 0.0, repetitions)
    envelope = _step(time, start, 0.9) - _step(time, start + repetitions * period - 0.9, 0.9)
    turn = 50.0 * envelope * np.sin(2.0 * np.pi * phase)
    zero = np.zeros_like(time)
    return _pose(
        time,
        _active(time, repetitions * period),
        plane=zero,
        elevation=zero + 75.0,
        rotation=zero,
        elbow=zero + 10.0,
        trunk=np.stack([zero, 0.05 * turn, turn], axis=1),
    )


MOTIONS: tuple[Motion, ...] = (
    Motion("tpose_wave", TPOSE_S + 2 * _MOVE_S + 8.0 + _END_S, _wave),
    Motion("tpose_slow_down", TPOSE_S + 2 * _MOVE_S + 8.0 + _END_S, _slow_down),
    Motion("tpose_torso_twist", TPOSE_S + 2 * _MOVE_S + 10.8 + _END_S, _twist),
)
"""The three motions of the thesis."""

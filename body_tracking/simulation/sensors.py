"""What a Kinect v2 would have said of a person, when, and how wrongly.

Errors: white noise of millimetres and a slow bias of centimetres, both growing with the square of the distance; joints
behind the trunk or the head are inferred, wrong by a decimetre, or not tracked; outliers; frames that are lost; a clock
of its own; a transport delay that varies.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from body_tracking.calibration.result import ClockModel, SensorPose
from body_tracking.kinematics.motion import EXTREMITY, JOINT_CLASSES, LIMB
from body_tracking.sensors import RecordedFrame
from body_tracking.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton, TrackingState


@dataclass(frozen=True, slots=True)
class Errors:
    """How much a simulated sensor errs; lengths in metres, for a person 2 m away.

    Attributes:
        white: standard deviation of the noise that is new in each frame, for the trunk.
        bias: standard deviation of the slow error, for the trunk.
        bias_s: its correlation time, seconds.
        inferred: standard deviation of the error of an inferred joint.
        inferred_s: its correlation time, seconds.
        outliers: probability that a joint starts to be an outlier in a frame; it lasts one to three frames.
        lost: probability that a frame is lost.
        lost_run: frames lost in a row, once in a recording.
        delay: seconds from capture to receipt, at least.
        delay_jitter: seconds added on average.
    """

    white: float = 0.002
    bias: float = 0.016
    bias_s: float = 3.0
    inferred: float = 0.060
    inferred_s: float = 0.4
    outliers: float = 0.0003
    lost: float = 0.015
    lost_run: int = 6
    delay: float = 0.022
    delay_jitter: float = 0.003


@dataclass(frozen=True, slots=True)
class SimulatedSensor:
    """A sensor at its place, with its clock and its errors.

    Attributes:
        pose: of its optical frame in ``world``; its name is the sensor's.
        clock: its clock against the reference clock.
        phase: seconds of its first frame after the start.
        errors: how much it errs.
    """

    pose: SensorPose
    clock: ClockModel = field(default_factory=ClockModel)
    phase: float = 0.0
    errors: Errors = field(default_factory=Errors)

    def capture_times(self, duration: float, rng: np.random.Generator) -> FloatArray:
        """(n,) seconds at which it takes its frames: 30 Hz of its own clock, with the jitter of its shutter."""
        period = 1.0 / (30.0 * (1.0 + self.clock.drift_ppm * 1e-6))
        times = np.arange(self.phase, duration, period)
        return times + rng.normal(scale=0.0002, size=len(times))

    def observe(
        self, times: FloatArray, truth: FloatArray, start_ns: int, received_from_ns: int, rng: np.random.Generator
    ) -> list[RecordedFrame]:
        """The frames that arrive.

        Args:
            times: (n,) seconds of the captures after the start.
            truth: (n, 25, 3) metres, true joints in ``world`` at these times.
            start_ns: the start in the reference clock.
            received_from_ns: the start in the receiver's clock.
            rng: where all chance comes from.
        """
        seen = (truth - self.pose.translation) @ self.pose.rotation
        positions, states = self._err(seen, _occlusion(seen), rng)
        lost = rng.random(len(times)) < self.errors.lost
        run = int(rng.integers(len(times) // 2, len(times) - self.errors.lost_run))
        lost[run : run + self.errors.lost_run] = True
        delays = self.errors.delay + rng.gamma(1.0, self.errors.delay_jitter, len(times))
        # a connection keeps the order: a frame that is held up holds up those behind it
        received = np.maximum.accumulate(times + delays)
        frames = []
        for k in np.flatnonzero(~lost):
            stamp_ns = self.clock.to_sensor(start_ns + round(times[k] * NANOSECONDS))
            skeleton = Skeleton(stamp_ns, f"{self.pose.sensor}_optical_frame", positions[k], states[k])
            frames.append(
                RecordedFrame(self.pose.sensor, received_from_ns + round(received[k] * NANOSECONDS), (skeleton,))
            )
        return frames

    def _err(
        self, seen: FloatArray, hidden: FloatArray, rng: np.random.Generator
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """True joints in the optical frame to (n, 25, 3) reported ones and their (n, 25) states."""
        errors, shape = self.errors, seen.shape
        scale = np.select([JOINT_CLASSES == EXTREMITY, JOINT_CLASSES == LIMB], [2.0, 1.3], 1.0)[:, None]
        growth = (np.linalg.norm(seen, axis=2, keepdims=True) / 2.0) ** 2
        noise = errors.white * rng.normal(size=shape) * [1.0, 1.0, 1.5]
        slow = errors.bias * _slow(shape, errors.bias_s, rng)
        guess = errors.inferred * _slow(shape, errors.inferred_s, rng)
        inferred = hidden > 0.0
        states = np.where(inferred, TrackingState.INFERRED, TrackingState.TRACKED).astype(np.uint8)
        states[hidden > 0.7] = TrackingState.NOT_TRACKED
        positions: FloatArray = seen + growth * (scale * (noise + slow) + np.where(inferred[:, :, None], guess, 0.0))
        positions += _outliers(shape, errors.outliers, rng)
        positions[states == TrackingState.NOT_TRACKED] = np.nan
        return positions, states


def _slow(shape: tuple[int, ...], seconds: float, rng: np.random.Generator) -> FloatArray:
    """Unit variance, correlated over the first axis (30 Hz) with a time constant; from its steady state on."""
    keep = np.exp(-1.0 / (30.0 * seconds))
    drive = rng.normal(size=shape) * np.sqrt(1.0 - keep**2)
    drive[0] = rng.normal(size=shape[1:])
    result: FloatArray = lfilter([1.0], [1.0, -keep], drive, axis=0)
    return result


def _outliers(shape: tuple[int, ...], probability: float, rng: np.random.Generator) -> FloatArray:
    """Jumps of 15 to 40 cm in any direction that last one to three frames."""
    jumps = np.zeros(shape)
    for frame, joint in np.argwhere(rng.random(shape[:2]) < probability):
        direction = rng.normal(size=3)
        length = rng.uniform(0.15, 0.4)
        jumps[frame : frame + rng.integers(1, 4), joint] = length * direction / np.linalg.norm(direction)
    return jumps


_ARMS: BoolArray = np.array([joint.name.split("_")[0] in ("ELBOW", "WRIST", "HAND", "THUMB") for joint in Joint])
_BALLS = [Joint.HEAD, Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT]
_RADII: FloatArray = np.array([0.15] * 10 + [0.10, 0.10, 0.10])
"""Metres: ten balls along the trunk, then the head and the shoulders."""


def _occlusion(seen: FloatArray) -> FloatArray:
    """How deep each joint of the arms lies behind the trunk, the head or a shoulder.

    Args:
        seen: (n, 25, 3) metres in the optical frame.

    Returns:
        (n, 25) 0 where it is seen, to 1 where its line of sight goes through the middle of one of them.
    """
    base, top = seen[:, Joint.SPINE_BASE], seen[:, Joint.SPINE_SHOULDER]
    along = np.linspace(0.0, 1.0, 10)[None, :, None]
    blockers = np.concatenate([base[:, None] + along * (top - base)[:, None], seen[:, _BALLS]], axis=1)
    distance = np.linalg.norm(seen, axis=2)
    sight = seen / distance[:, :, None]
    depth = np.einsum("njx,nbx->njb", sight, blockers)
    miss = np.linalg.norm(blockers[:, None] - depth[..., None] * sight[:, :, None], axis=3)
    behind = depth < distance[:, :, None] - _RADII
    cover = np.where(behind, np.clip(1.0 - miss / _RADII, 0.0, 1.0), 0.0).max(axis=2)
    result: FloatArray = np.where(_ARMS, cover, 0.0)
    return result

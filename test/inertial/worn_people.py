"""Simulated people with inertial sensors, fed to a tracker as a node would."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.imu import ImuSample
from body_tracking.core.measurement import joint_stddev
from body_tracking.core.orientation import SegmentOrientation
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.inertial.parameters import TrackingParameters
from body_tracking.inertial.simulated import ImuSamples, SimulatedImu, usual_mounting
from body_tracking.inertial.tracking import InertialTracker
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import START_NS, Setup, SimulatedRecording, simulate

MODEL = UpperBody()
FOREARMS = ("forearm_left", "forearm_right")


def sensor(segment: str, really_on: str = "", **changes: object) -> SimulatedImu:
    """A raw sensor without magnetometer, at 50 Hz."""
    on = really_on or segment
    return replace(SimulatedImu(segment, on, usual_mounting(on), 50.0, magnetometer=False), **changes)  # type: ignore[arg-type]


def recorded(
    motion: str, imus: tuple[SimulatedImu, ...], seconds: float | None = None, seed: int = 0
) -> SimulatedRecording:
    """One person before one camera."""
    return simulate(Setup(motion, around((0.0,)), imus=imus, seconds=seconds, seed=seed))


def samples_of(imu: SimulatedImu, samples: ImuSamples) -> list[tuple[int, str, ImuSample]]:
    """(time of receipt, stated segment, reading) of each sample."""
    found = []
    for k, stamp_ns in enumerate(samples.stamps_ns.tolist()):
        sample = ImuSample(
            stamp_ns,
            f"{imu.name}_link",
            None if samples.orientation is None else samples.orientation[k],
            None if samples.orientation is None else samples.orientation_covariance[k],
            samples.angular_velocity[k],
            samples.linear_acceleration[k],
            None if samples.magnetic_field is None else samples.magnetic_field[k],
        )
        found.append((int(samples.received_ns[k]), imu.name, sample))
    return found


@dataclass(eq=False)
class Fed:
    """A tracker's outputs for a recording."""

    tracker: InertialTracker
    recording: SimulatedRecording
    orientations: list[SegmentOrientation]
    skeletons: list[Skeleton]
    named: list[tuple[float, str]]

    def true_rotations(self, stamps_ns: list[int]) -> FloatArray:
        """(n, 12, 3, 3) of the nearest captures."""
        truth = self.recording.truths[0]
        nearest = np.clip(np.searchsorted(truth.stamps_ns, stamps_ns), 1, len(truth.stamps_ns) - 1)
        before = np.asarray(stamps_ns) - truth.stamps_ns[nearest - 1]
        share = before / (truth.stamps_ns[nearest] - truth.stamps_ns[nearest - 1])
        q = MODEL.integrate(
            truth.q[nearest - 1], share[:, None] * MODEL.difference(truth.q[nearest - 1], truth.q[nearest])
        )
        return MODEL.forward(q, truth.person.lengths).rotations

    def errors(self, segment: str, since: float) -> tuple[FloatArray, FloatArray]:
        """(n, 3) rotation vectors, radians about world's axes, and (n, 3) stated deviations."""
        published = [
            each
            for each in self.orientations
            if each.segment == segment and (each.stamp_ns - START_NS) / NANOSECONDS >= since
        ]
        true = self.true_rotations([each.stamp_ns for each in published])[:, SEGMENTS.index(segment)]
        found = np.array([each.rotation for each in published])
        stddev = np.array([np.sqrt(each.covariance.diagonal()) for each in published])
        return so3.rotation_vectors(found @ true.swapaxes(-1, -2)), stddev


def feed(
    recording: SimulatedRecording,
    parameters: TrackingParameters | None = None,
    meddle: Callable[[float, InertialTracker, ImuSample], ImuSample] | None = None,
    camera_stddev: float | None = None,
    seconds: float = np.inf,
) -> Fed:
    """All readings and frames in the order of receipt; the camera's truly placed.

    Args:
        recording: of one person.
        parameters: of the tracker; by default with fewer skeletons than usual, which take their time, and with all
            orientations.
        meddle: changes a reading, given the seconds from the beginning.
        camera_stddev: metres, of a camera with white noise in the place of the simulated one.
        seconds: how much of the recording is fed.
    """
    stated = tuple(imu.name for imu, _ in recording.imus)
    tracker = InertialTracker(
        stated, TrackingParameters(rate=2.0, orientation_rate=50.0) if parameters is None else parameters
    )
    events: list[tuple[int, str, object]] = [e for imu, samples in recording.imus for e in samples_of(imu, samples)]
    (camera,) = recording.sensors
    rng = np.random.default_rng(0)
    truth = recording.truths[0]
    for frame in recording.frames:
        seen = frame.skeletons[0]
        if camera_stddev is not None:
            instant = min(int(np.searchsorted(truth.stamps_ns, seen.stamp_ns)), len(truth.stamps_ns) - 1)
            clean = truth.skeleton(instant)
            noisy = clean.positions + camera_stddev * rng.normal(size=(25, 3))
            stated = np.tile(camera_stddev**2 * np.eye(3), (25, 1, 1))
            events.append((frame.received_ns, "", replace(clean, positions=noisy, covariances=stated, velocities=None)))
            continue
        variance = joint_stddev(seen.positions, seen.states) ** 2
        known = np.where(np.isfinite(variance), variance, 1e6)
        placed = replace(
            seen,
            frame_id="world",
            positions=camera.pose.apply(seen.positions),
            covariances=known[:, None, None] * np.eye(3),
        )
        events.append((frame.received_ns, "", placed))
    events.sort(key=lambda each: each[:2])
    fed = Fed(tracker, recording, [], [], [])
    begin = events[0][0]
    for received_ns, name, what in events:
        now = (received_ns - begin) / NANOSECONDS
        if now > seconds:
            break
        if isinstance(what, Skeleton):
            tracker.take_skeleton(what, received_ns)
        else:
            assert isinstance(what, ImuSample)
            if meddle is not None:
                what = meddle(now, tracker, what)
            output = tracker.add(name, what, received_ns)
            if output.orientation is not None:
                fed.orientations.append(output.orientation)
            if output.skeleton is not None:
                fed.skeletons.append(output.skeleton)
        if not fed.named or now - fed.named[-1][0] > 0.2:
            fed.named += [(now, line) for line in tracker.problems(received_ns)] or [(now, "")]
    return fed

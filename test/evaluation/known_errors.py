"""Estimates of a simulated person with known errors, beside targets of the marker system on the same person."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.signal import lfilter
from worn_targets import ARM, WornTargets, wear_targets

from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.evaluation.estimated_segments import EstimatedSegments
from body_tracking.evaluation.hand_eye import Track
from body_tracking.evaluation.marker_reference import MarkerReference
from body_tracking.evaluation.reading import AngleSeries
from body_tracking.kinematics.conventions import angles_of
from body_tracking.messages.angles import angles_to_joint_states
from body_tracking.messages.model import estimate_to_joint_state
from body_tracking.pipeline import graph
from body_tracking.recording.rosbag2 import BAG_MESSAGES, BagWriter
from body_tracking.simulation.people import MODEL, Person
from body_tracking.simulation.repertoire import make_movement

OFFSET, DRIFT = 1.7, 50e-6
"""Of the marker system's clock at the estimate's time 0."""
START_NS = 1_700_000_000 * NANOSECONDS
RATE = 30.0
NOISY = (
    *("base_rx", "base_ry", "base_rz", "clavicle_protraction_left", "clavicle_elevation_left"),
    *("shoulder_x_left", "shoulder_y_left", "shoulder_z_left", "elbow_flexion_left", "forearm_pronation_left"),
)


@dataclass(frozen=True, eq=False)
class Scene:
    """An estimate with known errors.

    Attributes:
        times: (n,) s of the estimate.
        true: (n, 35) and
        found: (n, 35) configurations.
        stddev: radians that the estimate states of each coordinate.
        worn: the targets.
    """

    times: FloatArray
    true: FloatArray
    found: FloatArray
    stddev: float
    worn: WornTargets

    def estimate(self) -> EstimatedSegments:
        """As read from a bag."""
        stamps_ns = np.array([state.stamp_ns for state in self.states], dtype=np.int64)
        position, stddev = (
            np.stack([getattr(each, part) for each in self.angles]) for part in ("position", "position_stddev")
        )
        series = AngleSeries(stamps_ns, self.angles[0].names, position, stddev)
        rotations = MODEL.forward(self.found, MODEL.default_lengths()).rotations
        return EstimatedSegments(Path("estimate"), graph.MODEL_STATE, stamps_ns, rotations, series, "model", ())

    def reference(self) -> MarkerReference:
        """As read from a bag."""
        covariances = self.worn.covariances
        tracks = {
            name: Track(self.worn.times, self.worn.rotations[:, k], covariances)
            for k, name in enumerate(self.worn.segments)
        }
        segments = {name: name for name in self.worn.segments}
        return MarkerReference(Path("markers"), START_NS, tracks, segments, None, ())

    @cached_property
    def states(self) -> list[ModelEstimate]:
        """States of the model."""
        nv = MODEL.nv
        covariance = self.stddev**2 * np.eye(2 * nv)
        rates, lengths = np.zeros(nv), MODEL.default_lengths()
        stamps_ns = [START_NS + round(time * NANOSECONDS) for time in self.times.tolist()]
        return [
            ModelEstimate(stamp_ns, "world", 0, q, rates, covariance, lengths, np.zeros_like(lengths))
            for stamp_ns, q in zip(stamps_ns, self.found, strict=True)
        ]

    @cached_property
    def angles(self) -> list[JointAngles]:
        """Their angles in the convention ``model``."""
        made: list[JointAngles] = []
        for state in self.states:
            made.append(angles_of(state, MODEL, "model", made[-1] if made else None))
        return made

    def write_estimate(self, folder: Path) -> Path:
        """A bag with the states of the model and its angles."""
        topic = graph.joint_states_topic(graph.DEFAULT_BODY)
        with BagWriter(folder, flush_interval_s=float("inf")) as bag:
            for each in (graph.MODEL_STATE, topic, f"{topic}_stddev"):
                bag.add_topic(each, JOINT_STATE)
            for state, angles in zip(self.states, self.angles, strict=True):
                messages = (
                    estimate_to_joint_state(state, MODEL, BAG_MESSAGES),
                    *angles_to_joint_states(angles, graph.DEFAULT_BODY, "model", BAG_MESSAGES),
                )
                for each, message in zip((graph.MODEL_STATE, topic, f"{topic}_stddev"), messages, strict=True):
                    bag.write_message(each, message, state.stamp_ns)
        return folder


def correlated_noise(rng: np.random.Generator, shape: tuple[int, ...], seconds: float) -> FloatArray:
    """Unit normal noise with an exponential autocorrelation along the first axis."""
    decay = np.exp(-1.0 / (RATE * seconds))
    white = rng.normal(size=shape)
    white[1:] *= np.sqrt(1.0 - decay**2)
    return np.asarray(lfilter([1.0], [1.0, -decay], white, axis=0))


def scene(
    seed: int,
    motion: str = "reaching",
    *,
    seconds: float = 40.0,
    error_deg: float = 3.0,
    bias_deg: float = 0.0,
    correlation: float = 0.3,
    markers_deg: float = 0.15,
    segments: tuple[str, ...] = ARM,
) -> Scene:
    """A person in a movement of the repertoire.

    Args:
        seed: of person, manner and errors.
        motion: of the repertoire.
        seconds: of it, about.
        error_deg: standard deviation of the estimate's error in the rotation of the pelvis and in each coordinate
            of the left arm.
        bias_deg: constant error of the elbow's flexion.
        correlation: seconds, correlation time of the former.
        markers_deg: white noise of the targets' orientations.
        segments: that carry targets.
    """
    rng = np.random.default_rng([seed, 20260101])
    movement = make_movement(motion, Person.draw(rng), rng, seconds)
    times = np.arange(0.4, movement.duration - 0.4, 1.0 / RATE) + rng.uniform(0.0, 0.01)
    stamps = np.arange(0.0, movement.duration, 0.5 / RATE)
    worn = wear_targets(
        *(stamps, movement.course(stamps).q, rng),
        segments=segments,
        stddev=float(np.radians(markers_deg)),
        offset=OFFSET,
        drift=DRIFT,
    )
    true = movement.course(times).q
    error = np.zeros((len(times), MODEL.nv))
    columns = [MODEL.coordinate_names.index(name) for name in NOISY]
    error[:, columns] = np.radians(error_deg) * correlated_noise(rng, (len(times), len(columns)), correlation)
    error[:, MODEL.coordinate_names.index("elbow_flexion_left")] += np.radians(bias_deg)
    return Scene(times, true, MODEL.integrate(true, error), float(np.radians(error_deg)), worn)

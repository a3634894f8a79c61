"""Segment orientations of a person in a recording, and joint angles as rotations between pairs of segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, IntArray
from body_tracking.evaluation.hand_eye import Track
from body_tracking.evaluation.reading import (
    AngleSeries,
    EvaluationError,
    bodies,
    model_angles,
    read_angles,
    read_joint_states,
    read_skeletons,
    true_model_angles,
)
from body_tracking.kinematics.conventions import CONVENTIONS, Chain, convention
from body_tracking.kinematics.euler import EulerAngles, EulerSequences
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.pipeline import graph
from body_tracking.recording.rig import RigReader

_ANY: Final = (-180.0, 180.0)
_MIDDLE: Final = (-90.0, 90.0)


@dataclass(frozen=True, slots=True, eq=False)
class EstimatedSegments:
    """A person's segments over time.

    Attributes:
        source: the bag or file.
        topic: source of the orientations.
        stamps_ns: (n,) capture times, increasing, nanoseconds.
        rotations: (n, 12, 3, 3) segment to world, in the order of ``SEGMENTS``.
        angles: in one of ``CONVENTIONS``.
        convention: of the angles.
        warnings: one per line.
    """

    source: Path
    topic: str
    stamps_ns: IntArray
    rotations: FloatArray
    angles: AngleSeries
    convention: str
    warnings: tuple[str, ...]

    @property
    def seconds(self) -> FloatArray:
        """(n,) s after the first instant."""
        seconds: FloatArray = (self.stamps_ns - self.stamps_ns[0]) / NANOSECONDS
        return seconds

    def track(self, rotations: FloatArray) -> Track:
        """Track of rotations (n, 3, 3) at the own instants; unknown ones are left out."""
        whole = np.isfinite(rotations).all(axis=(-1, -2))
        return Track(self.seconds[whole], rotations[whole], np.zeros((int(whole.sum()), 3, 3)))


def read_segments(path: Path, topic: str | None = None, body: str | None = None) -> EstimatedSegments:
    """The estimated segments and angles in a bag.

    The orientations come from ``/filtered/model_state``, published by the filter ``ekf``. Without it, or if a topic is
    given, they come from the body model fitted to the skeletons, as in ``joint_angles``.

    Args:
        path: a bag folder or an mcap file.
        topic: of skeletons; None for ``/filtered/skeleton``, or ``/fused/skeleton`` if that is missing.
        body: id of the person whose angles are read; None for the first in the bag.

    Raises:
        BagError: no such bag, or it is unreadable.
        EvaluationError: neither a state of the model nor skeletons with covariances, or no angles of this person.
    """
    model = UpperBody()
    with RigReader(path) as bag:
        state = None if topic is not None else read_joint_states(bag, graph.MODEL_STATE, "")
        angles = read_angles(bag, body)[1] if body is not None or bodies(bag) else None
        warnings = list(bag.warnings)
        if state is not None and state.names == model.coordinate_names:
            whole = np.isfinite(state.position).all(axis=1)
            stamps, topic = state.stamps_ns[whole], graph.MODEL_STATE
            q = model.integrate(model.neutral(), state.position[whole])
            computed = None
        else:
            topic = topic or next(
                (each for each in (graph.FILTERED, graph.FUSED) if each in bag.topics), graph.FILTERED
            )
            from body_tracking.kinematics.skeleton_fit import SkeletonFit  # imports numba: half a second

            fit, fitted = SkeletonFit(), []
            skeletons = read_skeletons(bag, topic)
            for skeleton in skeletons:
                estimate = fit.update(skeleton)
                if estimate is not None:
                    fitted.append(estimate)
            if skeletons and not fitted:
                raise EvaluationError(
                    f"{path}: none of the {len(skeletons)} skeletons of {topic} has a trunk with covariances"
                )
            stamps = np.array([each.stamp_ns for each in fitted], dtype=np.int64)
            q = np.array([each.q for each in fitted]).reshape(-1, model.nq)
            computed = fitted
        if len(stamps) < 2:
            raise EvaluationError(
                f"{path}: holds neither {graph.MODEL_STATE} nor skeletons on {topic}; make some with replay"
            )
    rotations = model.forward(q, model.default_lengths()).rotations
    of_names = {convention(each, model).names: each for each in CONVENTIONS}
    name = None if angles is None else of_names.get(angles.names)
    if angles is None or name is None:
        if computed is None:
            lacking = "no joint angles" if angles is None else "joint angles of no convention of the body model"
            raise EvaluationError(
                f"{path}: holds {graph.MODEL_STATE}, but {lacking}; replay with --convention model makes them"
            )
        if angles is not None:
            warnings.append(
                f"{path}: its joint angles are of no convention of the body model; those compared here are of the "
                f"convention model, from {topic}"
            )
        angles, name = model_angles(computed, model, "model"), "model"
    return EstimatedSegments(path, topic, stamps, rotations, angles, name, tuple(warnings))


def read_true_segments(path: Path) -> EstimatedSegments | None:
    """The true segments and angles in a simulated bag; convention ``model``, standard deviations zero.

    Raises:
        BagError: no such bag, or it is unreadable.

    Returns:
        The segments; None without a true state of the model.
    """
    model = UpperBody()
    with RigReader(path) as bag:
        state = read_joint_states(bag, graph.TRUE_MODEL_STATE, "")
        warnings = bag.warnings
    if state is None or state.names != model.coordinate_names:
        return None
    angles = true_model_angles(state, model, "model")
    rotations = model.forward(model.integrate(model.neutral(), state.position), model.default_lengths()).rotations
    return EstimatedSegments(
        *(path, graph.TRUE_MODEL_STATE, state.stamps_ns, rotations),
        *(replace(angles, stddev=np.zeros_like(angles.stddev)), "model", tuple(warnings)),
    )


def joint_chains(name: str, mounted: frozenset[str], model: UpperBody) -> tuple[Chain, ...]:
    """The joint angles of a convention that are rotations between two of the mounted segments.

    Args:
        name: one of ``CONVENTIONS``.
        mounted: names of segments with a target.
        model: the body.

    Returns:
        Chains between segments: those of the convention, and one for each joint whose angles are coordinates of the
        model. A third axis that the model does not have has no name.
    """
    found = convention(name, model)
    chains = [
        chain for chain in found.chains if chain.parent in mounted and chain.child in mounted and any(chain.names)
    ]
    neutral = model.linearise(model.neutral(), model.default_lengths())
    for segment, where in enumerate(model.segment_coordinates):
        names = model.coordinate_names[where]
        parent = model.parents[segment]
        if parent < 0 or not set(names) & set(found.names) or not {SEGMENTS[parent], SEGMENTS[segment]} <= mounted:
            continue
        # in the neutral pose all frames are aligned, and the joint's axes are those of its coordinates
        axes = np.rint(neutral.rotation_jacobian[segment][:, where].T)
        if len(axes) == 2:
            sequence = EulerAngles((axes[0], np.cross(axes[1], axes[0]), axes[1]), (_ANY, _MIDDLE, _ANY))
            chains.append(Chain((names[0], None, names[1]), SEGMENTS[parent], SEGMENTS[segment], sequence))
        elif len(axes) == 3:
            sequence = EulerAngles((axes[0], axes[1], axes[2]), (_ANY, _MIDDLE, _ANY))
            chains.append(Chain((names[0], names[1], names[2]), SEGMENTS[parent], SEGMENTS[segment], sequence))
    return tuple(chains)


def split_near(chain: Chain, rotations: FloatArray, near: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Angles of a chain over time: among equivalent triples, those nearest to given ones.

    Args:
        chain: the joint.
        rotations: (n, 3, 3) of the child in the parent.
        near: (n, 3) radians.

    Returns:
        (n, 3) radians and (n, 3, 3) their derivatives by a rotation in the parent's frame.
    """
    # one sequence for all instants
    split = EulerSequences([chain.angles]).split(rotations, np.zeros((len(rotations), 3)), near)
    return split.angles, split.gradients

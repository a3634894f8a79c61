"""Single joints between two targets from a recording of both (Gaschler 2011, sections 5.1 and 5.2).

A closed form (:mod:`body_tracking.markers.joint_starts`) initialises the maximum likelihood adjustment
(:mod:`body_tracking.markers.chain_likelihood`). A fit states its quality: smaller motions give larger standard
deviations, and a verdict with warnings reports a motion that is too small, about one axis only, or not of the joint's
kind.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.chain_likelihood import maximise
from body_tracking.markers.joint_model import Joint, JointKind
from body_tracking.markers.joint_starts import closed_form
from body_tracking.markers.joint_tree import tree_of
from body_tracking.markers.pose_table import PoseTable

MIN_FRAMES: Final = 10
"""Least number of frames with both targets."""
SMALL_MOTION: Final = np.radians(5.0)
"""RMS of the rotation from its mean; corresponds to an evenly filled range of +-9 deg. Below it, errors are ten times
those of a full range, and constant errors (calibration, soft tissue) are no longer small compared with the motion."""
ONE_AXIS: Final = 0.1
"""Ratio of the second principal rotation to the first, below which the motion is about one axis."""
MISFIT_WARNING: Final = 1.3
MISFIT: Final = 3.0
"""Errors in units of the poses' noise, above which the poses do not fit the joint."""
NOT_RIGID: Final = 3.0
"""RMS distance of balls from their target in units of their noise, above which the target is not rigid."""


class JointFitError(BodyTrackingError):
    """Raised for too few frames with both targets."""


class Verdict(StrEnum):
    """Quality of a fit; the enum's order is from best to worst."""

    GOOD = "good"
    SMALL_MOTION = "small_motion"
    """The standard deviations hold, but are large."""
    ONE_AXIS = "one_axis"
    """A ball or universal joint that turned about one axis only: the centre is known up to a line."""
    NOT_OF_KIND = "not_of_kind"
    """The errors exceed the poses' noise by far: another kind of joint, soft tissue, a target that slipped."""
    NOT_RIGID = "not_rigid"
    """The balls of a target move against each other."""


_WORST: Final = tuple(Verdict)


@dataclass(frozen=True, slots=True, eq=False)
class JointFit:
    """A fitted joint and its quality.

    Attributes:
        joint: with its covariance.
        frames: number used.
        motion: (3,) radians: RMS rotation of the child in the parent about the three principal axes of the motion, from
            its mean, the largest first, without the contribution of the poses' noise.
        scale: root of the reduced chi squared: errors in units of the poses' noise.
        gap: metres: RMS distance between the centre by the parent's pose and by the child's.
        turn: radians: RMS of the rotation that the joint does not permit; 0 for a ball joint.
        verdict: the worst that applies.
        warnings: one line per problem.
    """

    joint: Joint
    frames: int
    motion: FloatArray
    scale: float
    gap: float
    turn: float
    verdict: Verdict
    warnings: tuple[str, ...]


def relative_poses(poses: PoseTable) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) and translations (n, 3) of the second target of a table in its first."""
    inverse = poses.rotations[:, 0].swapaxes(-1, -2)
    arm = (poses.translations[:, 1] - poses.translations[:, 0])[..., None]
    return inverse @ poses.rotations[:, 1], (inverse @ arm)[..., 0]


def fit_joint(name: str, kind: JointKind, poses: PoseTable, parent: str, child: str) -> JointFit:
    """A joint of a given kind between two targets of a table.

    A ball joint: Gaschler section 5.1, figures 5.1-5.2, eq. 5.1. A hinge: section 5.2, figure 5.5, eq. 5.8-5.9. A
    universal joint has two perpendicular axes that meet.

    Raises:
        JointFitError: fewer than :data:`MIN_FRAMES` frames with both targets.
    """
    pair = poses.only((parent, child))
    if len(pair) < MIN_FRAMES:
        raise JointFitError(
            f"joint {name}: {len(pair)} frames with both {parent} and {child}, at least {MIN_FRAMES} are needed"
        )
    rotations, translations = relative_poses(pair)
    start = closed_form(name, parent, child, kind, rotations, translations)
    found = maximise(tree_of([start]), pair, MISFIT_WARNING)
    joint = found.tree.joints[0]
    motion = principal_motion(pair, rotations)
    problems = [*_motion_problems(kind, motion), *_rigidity_problems(pair)]
    if Verdict.ONE_AXIS in [problem for problem, _ in problems]:
        joint = _nearest_on_line(joint)
    apart = joint.parent_centre - rotations @ joint.child_centre - translations
    gap, turn = float(np.sqrt((apart**2).sum(axis=-1).mean())), _turn(joint, rotations)
    problems += _misfit_problems(joint, found.scale, gap, turn)
    verdict = max((problem for problem, _ in problems), key=_WORST.index, default=Verdict.GOOD)
    warnings = tuple(f"{name}: {text}" for _, text in problems)
    return JointFit(joint, len(pair), motion, found.scale, gap, turn, verdict, warnings)


def principal_motion(pair: PoseTable, rotations: FloatArray) -> FloatArray:
    """(3,) :attr:`JointFit.motion` of a pair of targets with relative rotations (n, 3, 3)."""
    turns = so3.rotation_vectors(rotations @ so3.mean_rotation(rotations).T)
    squares = np.linalg.eigvalsh(turns.T @ turns / len(turns))[::-1]
    noise = np.trace(pair.covariance[:, :, 3:, 3:], axis1=-2, axis2=-1).sum(axis=1).mean() / 3.0
    result: FloatArray = np.sqrt(np.maximum(squares - noise, 0.0))
    return result


def _motion_problems(kind: JointKind, motion: FloatArray) -> list[tuple[Verdict, str]]:
    first, second, _ = np.degrees(motion)
    least = np.degrees(SMALL_MOTION)
    if kind is JointKind.HINGE:
        if motion[0] >= SMALL_MOTION:
            return []
        return [(Verdict.SMALL_MOTION, f"it turned by {first:.2g} deg RMS only; at least {least:.0f} are needed")]
    if motion[1] < ONE_AXIS * motion[0]:
        unknown = "the centre is known up to a line" if kind is JointKind.BALL else "the second axis is not known"
        text = f"it turned about one axis only ({first:.2g} deg RMS, {second:.2g} about others): {unknown}"
        return [(Verdict.ONE_AXIS, text)]
    if motion[1] < SMALL_MOTION:
        text = f"it turned by {second:.2g} deg RMS only about a second axis; at least {least:.0f} are needed"
        return [(Verdict.SMALL_MOTION, text)]
    return []


def _rigidity_problems(pair: PoseTable) -> list[tuple[Verdict, str]]:
    problems = []
    for target, ratios in zip(pair.targets, pair.rigidity.T, strict=True):
        ratios = ratios[np.isfinite(ratios)]
        ratio = float(np.sqrt((ratios**2).mean())) if len(ratios) else 0.0
        if ratio > NOT_RIGID:
            text = f"target {target} is not rigid: its balls move against each other by {ratio:.2g} times their noise"
            problems.append((Verdict.NOT_RIGID, text))
    return problems


def _misfit_problems(joint: Joint, scale: float, gap: float, turn: float) -> list[tuple[Verdict, str]]:
    if scale < MISFIT_WARNING:
        return []
    turned = "" if joint.kind is JointKind.BALL else f", {np.degrees(turn):.2g} deg of rotation left over"
    text = (
        f"errors are {scale:.2g} times the poses' noise (centre {1e3 * gap:.2g} mm apart{turned}): targets on soft "
        f"tissue, a joint that is no {joint.kind.value} joint, or noise that is stated too small"
    )
    return [(Verdict.NOT_OF_KIND if scale >= MISFIT else Verdict.GOOD, text)]


def _turn(joint: Joint, rotations: FloatArray) -> float:
    """RMS angle between the axes of both targets; for a universal joint, its RMS deviation from a right angle."""
    if joint.kind is JointKind.BALL:
        return 0.0
    axes = rotations @ joint.child_axis
    along = axes @ joint.parent_axis
    if joint.kind is JointKind.UNIVERSAL:
        angles = np.arcsin(np.clip(along, -1.0, 1.0))
    else:
        angles = np.arctan2(np.linalg.norm(np.cross(axes, joint.parent_axis), axis=-1), along)
    return float(np.sqrt((angles**2).mean()))


def _nearest_on_line(joint: Joint) -> Joint:
    """Move a ball joint's centre along its undetermined line to the point nearest to both origins (Gaschler eq.
    5.10).
    """
    if joint.kind is not JointKind.BALL:
        return joint
    where = [0, 1, 2, 6, 7, 8]
    line = np.linalg.eigh(joint.covariance[np.ix_(where, where)])[1][:, -1]
    centres = np.concatenate([joint.parent_centre, joint.child_centre])
    centres = centres - line * (line @ centres)
    return replace(joint, parent_centre=centres[:3], child_centre=centres[3:])

"""Estimation of a person's body shape from depth images in several poses.

Jatesiktat (2018), III: a rough shape from the segment lengths of another skeleton (eq. 18), then shape and pose
together. The paper uses one image; one in four of its starts ends in a wrong shape, and the shoulder width is 28 mm
off. Here all images are fitted jointly: they share the shape, each has its own pose, and the Schur complement
eliminates the poses' blocks of the arrowhead-shaped normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.mesh.body_model import Body, BodyModel, Pose
from body_tracking.mesh.energy import Observation
from body_tracking.mesh.skinning import lever_arms
from body_tracking.mesh.solver import Fit, MeshFitter
from body_tracking.mesh.uncertainty import joint_shape_gradients, point_shape_gradients, pose_rows

SCALES: Final = (0.1, 0.1, 0.06, 0.06, 0.03, 0.03, 0.03, 0.03)
"""Metres: robust scale of each joint step."""
STATURES: Final = (0.0, -1.2, 1.2)
"""Initial values of the first shape component, the stature; poses that are given were fitted with the mean one."""


class PersonalisationError(BodyTrackingError):
    """Raised if the images do not show one person well enough to estimate a shape."""


APART: Final = 0.25
"""Radians, root mean square over the joints of arms and trunk: smallest difference between distinct poses."""
_MOVING: Final = ("shoulder", "elbow", "spine1", "spine2", "spine3")


class DistinctPoses:
    """Collects observations of one person in different poses.

    Args:
        model: shape space.
        count: number of observations needed.

    Attributes:
        observations: kept so far.
        poses: fitted pose of each observation.
    """

    def __init__(self, model: BodyModel, count: int) -> None:
        self._count = count
        self._joints = [k for k, name in enumerate(model.joint_names) if name.rpartition("_")[2] in _MOVING]
        self.observations: list[Observation] = []
        self.poses: list[Pose] = []

    @property
    def complete(self) -> bool:
        """Whether there are enough observations."""
        return len(self.poses) >= self._count

    def offer(self, observation: Observation, pose: Pose) -> None:
        """Keep an observation if its pose differs from all poses kept."""
        own = pose.rotations[self._joints]
        for other in self.poses:
            angles = np.linalg.norm(so3.rotation_vectors(other.rotations[self._joints].mT @ own), axis=1)
            if float(np.sqrt(np.mean(angles**2))) < APART:
                return
        if not self.complete:
            self.observations.append(observation)
            self.poses.append(pose)


@dataclass(frozen=True, slots=True, eq=False)
class Person:
    """A personalised body.

    Attributes:
        body: of the person.
        covariance: (S, S) of its shape components.
        fits: of the images.
    """

    body: Body
    covariance: FloatArray
    fits: tuple[Fit, ...]


def personalise(
    model: BodyModel,
    observations: Sequence[Observation],
    starts: Sequence[Pose] | None = None,
) -> Person:
    """Estimate the shape of the person in all images (Jatesiktat 2018, figure 2 and section III-B, on several images).

    Args:
        model: shape space.
        observations: of 4 to 8 images in different poses; with fewer the prior dominates the shape.
        starts: initial pose of each; None to search for them.

    Raises:
        PersonalisationError: no image, or the fit is lost in more than half of them.
    """
    if not observations:
        raise PersonalisationError("no image to personalise from")
    best: tuple[float, Body, tuple[Fit, ...], FloatArray] | None = None
    for stature in STATURES:
        shape = np.zeros(model.vertex_shapes.shape[2])
        shape[0] = stature
        fitter = MeshFitter(model.body(shape))
        poses = starts if starts is not None else [fitter.search(seen).pose for seen in observations]
        found = _refined(fitter, observations, poses)
        if best is None or found[0] < best[0]:
            best = found
        if starts is not None and not any(fit.lost for fit in found[2]):
            break
    assert best is not None
    _, body, fits, information = best
    lost = sum(fit.lost for fit in fits)
    if 2 * lost > len(fits):
        raise PersonalisationError(f"lost in {lost} of {len(fits)} images; is the person seen from head to hip?")
    covariance: FloatArray = np.asarray(np.linalg.inv(information), dtype=np.float64)
    return Person(body, covariance, fits)


def _refined(
    fitter: MeshFitter, observations: Sequence[Observation], poses: Sequence[Pose]
) -> tuple[float, Body, tuple[Fit, ...], FloatArray]:
    """Energy, body, fits and the shape's information after the joint steps."""
    shape = fitter.body.shape
    for scale in SCALES:
        systems = [_system(fitter, seen, pose, scale) for seen, pose in zip(observations, poses, strict=True)]
        information = np.eye(len(shape))  # prior: components are in standard deviations
        gradient = shape.copy()
        for each in systems:
            information += each.shape - each.mixed.T @ each.solved
            gradient += each.shape_gradient - each.mixed.T @ each.solved_gradient
        step = np.linalg.solve(information, -gradient)
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-9))
        poses = [fitter.moved(s.fit.pose, _bounded(-s.solved_gradient - s.solved @ step)) for s in systems]
        shape = shape + step
        fitter = MeshFitter(fitter.body.model.body(shape))
    fits = tuple(fitter.fit(seen, pose, scales=SCALES[-2:]) for seen, pose in zip(observations, poses, strict=True))
    total = sum(fit.energy for fit in fits) + 0.5 * float(shape @ shape)
    return total, fitter.body, fits, information


def _bounded(step: FloatArray) -> FloatArray:
    return step * min(1.0, 0.5 / max(float(np.abs(step[3:]).max()), 1e-9))


@dataclass(frozen=True, slots=True, eq=False)
class _FrameSystem:
    """Normal equations of one image: ``mixed`` is (pose, shape); ``solved`` is the inverse pose block times
    ``mixed``.
    """

    fit: Fit
    shape: FloatArray
    shape_gradient: FloatArray
    mixed: FloatArray
    solved: FloatArray
    solved_gradient: FloatArray


def _system(fitter: MeshFitter, observation: Observation, pose: Pose, scale: float) -> _FrameSystem:
    evaluation = fitter.evaluate(observation, pose, scale)
    fit, pulls, matches = evaluation.fit, evaluation.pulls, evaluation.fit.matches
    planes = ((matches.places - observation.points) * matches.normals).sum(axis=1)
    own = pulls.vertices[:, None]
    terms = [
        _rows(fitter, fit, matches.corners, matches.shares, matches.normals),
        _rows(fitter, fit, own, np.ones((len(own), 1)), pulls.directions),
    ]
    by_pose, by_shape = (np.concatenate(each) for each in zip(*terms, strict=True))
    weights = np.concatenate([fit.weights, evaluation.pull_weights])
    residuals = np.concatenate([planes, pulls.residuals])
    mixed = (by_pose.T * weights) @ by_shape
    information = fit.information.copy()
    diagonal = np.arange(len(information))
    information[diagonal, diagonal] = 1.01 * information[diagonal, diagonal] + 1e-6
    solved = np.linalg.solve(information, np.column_stack([mixed, evaluation.gradient]))
    return _FrameSystem(
        fit,
        (by_shape.T * weights) @ by_shape,
        by_shape.T @ (weights * residuals),
        mixed,
        solved[:, :-1],
        solved[:, -1],
    )


def _rows(
    fitter: MeshFitter, fit: Fit, corners: IntArray, shares: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Derivatives of points on the body along directions (n, 3), by the pose and by the shape."""
    body, model, posed = fitter.body, fitter.body.model, fit.posed
    arms = lever_arms(
        *(corners, shares, posed.rest, model.bones, model.weights, model.parents, body.joints),
        *(posed.turned, posed.placed),
    )
    moved = point_shape_gradients(
        *(corners, shares, model.vertex_shapes, model.joint_shapes, model.bones, model.weights),
        *(posed.turned, joint_shape_gradients(model, posed)),
    )
    return pose_rows(arms, directions, fit.frames), np.einsum("na,nas->ns", directions, moved)

"""Maximum likelihood of the joints of a tree from measured poses (Gaschler 2011, eq. 5.5 and 5.20).

The unknowns are the joints' parameters and the posture of each frame. They are adjusted together, so that the errors of
both targets of a joint count, each by its covariance. The frames are eliminated one by one (Schur complement), so that
time grows linearly with their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.markers.joint_model import SIZE, Joint, conventional, free_directions
from body_tracking.markers.joint_tree import (
    Posture,
    Tree,
    differentiate,
    errors,
    first_posture,
    moved,
    place,
    reseated,
)
from body_tracking.markers.pose_table import PoseTable

REACH: Final = 1.0
"""Metres: standard deviation of a joint's centre before any measurement; no target is mounted farther away."""
_LOOSE: Final = 1e-6
"""Prior information of a coordinate of a posture, so that a coordinate that no target shows stays solvable."""
_LEAST: Final = 1e-12
"""Prior information as a share of the frame's largest information, above which rounding errors stay."""
_ITERATIONS: Final = 100
_CONVERGED: Final = 1e-8
"""Relative decrease of the cost that ends the iteration."""
_SETTLING: Final = 12
_LOST: Final = 10.0
"""Factor on the usual squared error of a frame, above which its posture is discarded as not converged."""
_ROUNDING: Final = 1e-14
"""Share of the largest eigenvalue to which rounding errors raise a zero eigenvalue of an information matrix."""
_BLOCKS: Final = 12
"""Parts of a recording whose sums of errors are independent, where errors exceed the poses' noise."""


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """The result of the adjustment.

    Attributes:
        tree: with joints in their conventional form, each with its covariance.
        posture: of each frame.
        covariance: (12 j, 12 j) of all joints' parameters together, from the noise of the poses.
        sensitivity: (12 j, q) derivative of the joints' parameters by the shared parameters of the poses.
        errors: (n, m, 6) of the measured poses against the adjusted ones.
        scale: root of the reduced chi squared: the size of the errors in units of the poses' noise.
        iterations: number used.
    """

    tree: Tree
    posture: Posture
    covariance: FloatArray
    sensitivity: FloatArray
    errors: FloatArray
    scale: float
    iterations: int


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations with the frames eliminated: n frames of f coordinates, p parameters.

    Attributes:
        information: (p, p).
        gradients: (n, p) each frame's contribution to the gradient.
        frames: (n, f, f) Cholesky factors of the frames' own information.
        mixed: (n, f, p) and
        pulls: (n, f) mixed information and right sides, which give the frames' steps from that of the parameters.
    """

    information: FloatArray
    gradients: FloatArray
    frames: FloatArray
    mixed: FloatArray
    pulls: FloatArray


def maximise(tree: Tree, poses: PoseTable, misfit: float, shared: FloatArray | None = None) -> Likelihood:
    """Adjust the joints of a tree to measured poses.

    Gaschler (2011): eq. 5.5; figure 5.7; eq. 5.19-5.20.

    Args:
        tree: with joints near the solution.
        poses: of the tree's targets.
        misfit: threshold of :attr:`Likelihood.scale` above which the errors exceed the poses' noise: the covariance is
            then that of the actual errors, which are correlated over time.
        shared: (n, m, 6, q) derivative of the poses by q parameters with a constant error in all frames, i.e. those of
            the cameras' calibration.
    """
    posture = first_posture(tree, poses)
    if not poses.seen.all():
        posture = settled(tree, posture, poses)
        rows = _found(tree, poses, posture)
        turns = tuple(each[rows] for each in posture.turns)
        poses, posture = poses.rows(rows), Posture(posture.rotation[rows], posture.translation[rows], turns)
        shared = None if shared is None else shared[rows]
    cost, error = _cost(tree, posture, poses)
    damping, count = 0.0, 0
    for count in range(1, _ITERATIONS + 1):  # noqa: B007
        directions = _directions(tree)
        normal = _normal(tree, posture, poses, directions, error)
        prior, pull = _prior(tree, directions)
        gradient = normal.gradients.sum(axis=0) + pull
        diagonal = normal.information.diagonal()
        regular = normal.information + prior + np.diag(np.full(len(diagonal), _ROUNDING * diagonal.max()))
        decreased = False
        for _ in range(12):
            step = np.linalg.solve(regular + np.diag(damping * diagonal), gradient)
            frames = _solve(normal.frames, (normal.pulls - normal.mixed @ step)[..., None])[..., 0]
            trial = tree.with_joints(_changed(tree.joints, directions @ step))
            trial_posture = moved(tree, posture, frames)
            trial_cost, trial_error = _cost(trial, trial_posture, poses)
            decreased = trial_cost < cost
            if decreased or damping > 1e6:
                break
            damping = max(10.0 * damping, 1e-4)
        if not decreased:
            break
        gain = cost - trial_cost
        tree, posture, cost, error = trial, trial_posture, trial_cost, trial_error
        damping = 0.0 if damping < 1e-4 else 0.1 * damping
        if gain < _CONVERGED * max(cost, 1.0):
            break
    return _stated(tree, posture, poses, misfit, shared, count)


def settled(tree: Tree, posture: Posture, poses: PoseTable) -> Posture:
    """Posture of each frame, fitted to its measured poses alone (Levenberg-Marquardt)."""
    damping = np.full(len(poses), 1e-3)
    for _ in range(_SETTLING):
        rotations, translations = place(tree, posture)
        error = errors(poses, rotations, translations)
        derivative = differentiate(tree, posture, rotations, False)
        white = (poses.whitening @ derivative).reshape(len(poses), -1, tree.size)
        residual = (poses.whitening @ error[..., None]).reshape(len(poses), -1, 1)
        information = white.swapaxes(-1, -2) @ white
        diagonal = np.einsum("nii->ni", information)
        diagonal += damping[:, None] * diagonal + _LOOSE
        step = np.asarray(np.linalg.solve(information, white.swapaxes(-1, -2) @ residual), dtype=np.float64)[..., 0]
        trial = moved(tree, posture, step)
        squares = (residual**2).sum(axis=(1, 2))
        better = _frame_squares(poses, errors(poses, *place(tree, trial))) < squares
        posture = Posture(
            np.where(better[:, None, None], trial.rotation, posture.rotation),
            np.where(better[:, None], trial.translation, posture.translation),
            tuple(
                np.where(better[:, None, None], new, old) for new, old in zip(trial.turns, posture.turns, strict=True)
            ),
        )
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return posture


def _found(tree: Tree, poses: PoseTable, posture: Posture) -> BoolArray:
    """(n,) whether a frame's posture has converged; a hidden target between visible ones can prevent it."""
    squares = _frame_squares(poses, errors(poses, *place(tree, posture)))
    whole = poses.seen.all(axis=1)
    usual = np.median(squares[whole]) if whole.any() else np.median(squares)
    rows: BoolArray = whole | (squares < _LOST * max(float(usual), 6.0 * len(tree.targets)))
    return rows


def _stated(
    tree: Tree, posture: Posture, poses: PoseTable, misfit: float, shared: FloatArray | None, iterations: int
) -> Likelihood:
    """The joints in their conventional form, with their covariance and sensitivity."""
    made = [conventional(joint) for joint in tree.joints]
    tree, posture = reseated(tree, posture, [joint for joint, _ in made])
    rotations, translations = place(tree, posture)
    error = errors(poses, rotations, translations)
    directions = _directions(tree)
    normal = _normal(tree, posture, poses, directions, error)
    parameters = directions.shape[1]
    # a coordinate that no target of a frame shows is not a degree of freedom
    shown = np.linalg.eigvalsh(normal.frames @ normal.frames.swapaxes(-1, -2)) > 1e3 * _LOOSE
    freedom = 6 * int(poses.seen.sum()) - int(shown.sum()) - parameters
    scale = float(np.sqrt(_squares(poses, error) / max(freedom, 1)))
    free = _covariance(tree, posture, poses, directions, normal, scale if scale > misfit else 1.0)
    conventions = np.zeros_like(directions)
    column = 0
    for index, (_, derivative) in enumerate(made):
        end = column + derivative.shape[1]
        conventions[SIZE * index : SIZE * (index + 1), column:end] = derivative
        column = end
    covariance = conventions @ free @ conventions.T
    sensitivity = np.zeros((len(conventions), 0))
    if shared is not None:
        sensitivity = conventions @ _sensitivity(tree, posture, poses, directions, normal, shared)
    joints = [
        replace(joint, covariance=covariance[SIZE * index : SIZE * (index + 1), SIZE * index : SIZE * (index + 1)])
        for index, joint in enumerate(tree.joints)
    ]
    return Likelihood(tree.with_joints(joints), posture, covariance, sensitivity, error, scale, iterations)


def _covariance(
    tree: Tree, posture: Posture, poses: PoseTable, directions: FloatArray, normal: _Normal, scale: float
) -> FloatArray:
    """(p, p) covariance of the parameters.

    The information from the adjusted postures is too large, because the postures' own errors contribute to it: a joint
    that never turns about an axis seems to turn about it by the noise. To second order the surplus is half the second
    derivative of the information by the postures, times their covariance. Where the surplus is all the information, the
    parameter keeps its prior covariance (:data:`REACH`).
    """
    prior, _ = _prior(tree, directions)
    surplus = np.zeros_like(prior)
    factors = np.asarray(np.linalg.inv(normal.frames), dtype=np.float64).swapaxes(-1, -2)
    spread: FloatArray = np.minimum(np.abs(factors), 0.1) * np.sign(factors)
    for column in range(tree.size):
        for sign in (1.0, -1.0):
            other = moved(tree, posture, sign * spread[:, :, column])
            surplus += 0.5 * (_normal(tree, other, poses, directions, None).information - normal.information)
    surplus *= scale**2 * (1.0 + 3.0 * np.sqrt(2.0 / len(poses)))
    # in units in which the information is the identity
    values, vectors = np.linalg.eigh(normal.information + prior)
    root = (vectors / np.sqrt(np.maximum(values, _ROUNDING * values[-1]))).T
    values, vectors = np.linalg.eigh(root @ (normal.information - surplus) @ root.T)
    basis = root.T @ vectors
    before = np.einsum("ia,ij,ja->a", basis, prior, basis)
    variances = 1.0 / (np.maximum(values, 0.0) / scale**2 + before)
    whitened = np.diag(variances)
    if scale > 1.0:
        # correlated errors: Huber's sandwich over blocks of the recording, added to the scaled noise
        parts = np.array_split(normal.gradients, min(_BLOCKS, len(poses)))
        pulls = (np.stack([part.sum(axis=0) for part in parts]) @ basis) * np.minimum(variances / scale**2, 1.0)
        whitened = whitened + pulls.T @ pulls
        shrink = np.sqrt(np.minimum(1.0 / (before * whitened.diagonal()), 1.0))
        whitened = whitened * shrink * shrink[:, None]
    result: FloatArray = basis @ whitened @ basis.T
    return result


def _directions(tree: Tree) -> FloatArray:
    """(12 j, p) :func:`free_directions` of all joints."""
    blocks = [free_directions(joint) for joint in tree.joints]
    result = np.zeros((SIZE * len(blocks), sum(block.shape[1] for block in blocks)))
    column = 0
    for index, block in enumerate(blocks):
        end = column + block.shape[1]
        result[SIZE * index : SIZE * (index + 1), column:end] = block
        column = end
    return result


def _prior(tree: Tree, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Prior information (p, p) of the joints and its gradient (p,)."""
    weights = np.tile(np.repeat([REACH**-2, np.pi**-2, REACH**-2, np.pi**-2], 3), len(tree.joints))
    centres = np.concatenate(
        [np.concatenate([joint.parent_centre, np.zeros(3), joint.child_centre, np.zeros(3)]) for joint in tree.joints]
    )
    return (directions.T * weights) @ directions, -directions.T @ (weights * centres)


def _cost(tree: Tree, posture: Posture, poses: PoseTable) -> tuple[float, FloatArray]:
    """Sum of the squared errors including the prior, and the errors (n, m, 6)."""
    error = errors(poses, *place(tree, posture))
    centres = sum(
        float(joint.parent_centre @ joint.parent_centre + joint.child_centre @ joint.child_centre)
        for joint in tree.joints
    )
    return _squares(poses, error) + centres / REACH**2, error


def _squares(poses: PoseTable, error: FloatArray) -> float:
    return float(_frame_squares(poses, error).sum())


def _frame_squares(poses: PoseTable, error: FloatArray) -> FloatArray:
    """(n,) sum of the squared whitened errors (n, m, 6) of each frame."""
    white = (poses.whitening @ error[..., None])[..., 0]
    result: FloatArray = (white * white).sum(axis=(1, 2))
    return result


def _normal(
    tree: Tree, posture: Posture, poses: PoseTable, directions: FloatArray, error: FloatArray | None
) -> _Normal:
    """Normal equations; residuals are zero if ``error`` is None."""
    by_frame, by_joint = _derivatives(tree, posture, poses, directions, error)
    n, rows = by_frame.shape[:2]
    information = by_frame.swapaxes(-1, -2) @ by_frame
    largest = information[:, range(tree.size), range(tree.size)].max(axis=1, keepdims=True)
    information[:, range(tree.size), range(tree.size)] += _LOOSE + _LEAST * largest
    frames = np.asarray(np.linalg.cholesky(information), dtype=np.float64)
    mixed = by_frame.swapaxes(-1, -2) @ by_joint
    residual = np.zeros((n, rows, 1))
    if error is not None:
        residual = (poses.whitening @ error[..., None]).reshape(n, -1, 1)
    pulls = by_frame.swapaxes(-1, -2) @ residual
    solved = _solve(frames, np.concatenate([mixed, pulls], axis=-1))
    p = directions.shape[1]
    total = by_joint.reshape(-1, p).T @ by_joint.reshape(-1, p)
    reduced = total - mixed.reshape(-1, p).T @ solved[..., :p].reshape(-1, p)
    gradients = (by_joint.swapaxes(-1, -2) @ residual - mixed.swapaxes(-1, -2) @ solved[..., p:])[..., 0]
    return _Normal(0.5 * (reduced + reduced.T), gradients, frames, mixed, pulls[..., 0])


def _derivatives(
    tree: Tree, posture: Posture, poses: PoseTable, directions: FloatArray, error: FloatArray | None
) -> tuple[FloatArray, FloatArray]:
    """(n, 6 m, f) and (n, 6 m, p) derivatives of the whitened poses by each frame's posture and by the parameters."""
    derivative = differentiate(tree, posture, place(tree, posture)[0], True)
    if error is not None:
        # log(E exp(-w)) = log(E) - Jr^-1(log E) w
        derivative[:, :, 3:] = so3.right_jacobian_inverse(error[..., 3:]) @ derivative[:, :, 3:]
    white = (poses.whitening @ derivative).reshape(len(poses), -1, derivative.shape[-1])
    return white[..., : tree.size], white[..., tree.size :] @ directions


def _sensitivity(
    tree: Tree, posture: Posture, poses: PoseTable, directions: FloatArray, normal: _Normal, shared: FloatArray
) -> FloatArray:
    """(p, q) derivative of the adjusted parameters by the shared ones, from the right sides of the normal equations."""
    by_frame, by_joint = _derivatives(tree, posture, poses, directions, None)
    residual = (poses.whitening @ shared).reshape(len(poses), by_frame.shape[1], -1)
    solved = _solve(normal.frames, by_frame.swapaxes(-1, -2) @ residual)
    right = by_joint.swapaxes(-1, -2) @ residual - normal.mixed.swapaxes(-1, -2) @ solved
    prior, _ = _prior(tree, directions)
    return np.asarray(np.linalg.solve(normal.information + prior, right.sum(axis=0)), dtype=np.float64)


def _solve(factors: FloatArray, right: FloatArray) -> FloatArray:
    """Solutions of symmetric systems from their Cholesky factors."""
    result: FloatArray = np.linalg.solve(factors.swapaxes(-1, -2), np.linalg.solve(factors, right))
    return result


def _changed(joints: tuple[Joint, ...], step: FloatArray) -> list[Joint]:
    return [joint.changed(step[SIZE * index : SIZE * (index + 1)]) for index, joint in enumerate(joints)]

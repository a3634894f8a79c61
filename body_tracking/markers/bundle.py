"""Bundle adjustment: least squares fit of cameras and observed points to pixels (Gaschler eq. 4.9).

Shared parameters (cameras) are dense; the parameters of one instant (the pose of a board, the ends of a wand) are a
small block each. Levenberg-Marquardt eliminates the blocks by the Schur complement (Triggs et al. 2000, section
6.1), whose inverse is the covariance of the shared parameters. scipy's ``least_squares`` does not use such a structure.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final, TypeVar

import numpy as np
from scipy import sparse

from body_tracking.core import so3
from body_tracking.core.camera import CameraError
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers import projection
from body_tracking.markers.rig import LENS, POSE, Rig

_STEPS: Final = 100
_CONVERGED: Final = 1e-10
"""Relative change of the cost at which the iteration ends."""
_DAMPING: Final = 1e-4
_MAX_DAMPING: Final = 1e10
_RADIAL: Final = 2
"""The first coefficients of a camera's distortion are k1 and k2."""

State = TypeVar("State")


class BundleError(BodyTrackingError):
    """Raised for too few observations, or observations that do not determine the parameters."""


@dataclass(frozen=True, slots=True, eq=False)
class Linearised:
    """Residuals of a least squares problem with local blocks, and their derivatives.

    Attributes:
        residuals: (m,) each divided by its standard deviation.
        shared: (m, p) derivative of the residuals by the shared parameters.
        local: (m, k) by the parameters of the block of each residual.
        blocks: (m,) index of that block.
        count: number of blocks.
    """

    residuals: FloatArray
    shared: FloatArray
    local: FloatArray
    blocks: IntArray
    count: int


def minimise(
    state: State,
    linearise: Callable[[State], Linearised],
    moved: Callable[[State, FloatArray, FloatArray], State],
) -> tuple[State, FloatArray]:
    """Minimise the sum of squared residuals by Levenberg-Marquardt.

    Args:
        state: initial state.
        linearise: residuals and derivatives at a state; a step to a state with residuals that are not finite is
            rejected.
        moved: the state after a step of (p,) shared and (count, k) local parameters.

    Returns:
        The state, and the covariance (p, p) of the shared parameters for residuals of variance 1.

    Raises:
        BundleError: residuals are not finite at the start, or do not determine the parameters.
    """
    here = linearise(state)
    cost, damping = float(here.residuals @ here.residuals), _DAMPING
    if not np.isfinite(cost):
        raise BundleError("a point is behind its camera, or a pixel not finite, where the adjustment begins")
    for _ in range(_STEPS):
        equations = _normal_equations(here)
        change = 1.0
        while damping < _MAX_DAMPING:
            try:
                candidate = moved(state, *_step(equations, damping))
                there = linearise(candidate)
                new = float(there.residuals @ there.residuals)
            except CameraError:  # a step so large that a focal length is negative
                new = float("nan")
            if new <= cost:  # False for NaN
                change = (cost - new) / max(cost, 1e-300)
                state, here, cost, damping = candidate, there, new, max(0.1 * damping, 1e-12)
                break
            damping *= 10.0
        else:
            break
        if change < _CONVERGED:
            break
    reduced, _, _, _ = _reduced(_normal_equations(here), 0.0)
    scale = np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    try:
        # scaled to a unit diagonal: focal lengths and radians differ by orders of magnitude
        covariance = np.linalg.inv(reduced / np.outer(scale, scale)) / np.outer(scale, scale)
    except np.linalg.LinAlgError as error:
        raise BundleError("the observations do not determine all parameters") from error
    if not (np.diag(covariance) > 0.0).all():
        raise BundleError("the observations do not determine all parameters")
    return state, covariance


Equations = tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]


def _normal_equations(here: Linearised) -> Equations:
    """Shared (p, p) and (p,), mixed (v, p, k), block (v, k, k) and (v, k) parts."""
    m, k = here.local.shape
    p = here.shared.shape[1]
    gather = sparse.csr_matrix((np.ones(m), (here.blocks, np.arange(m))), shape=(here.count, m))
    mixed = gather @ (here.shared[:, :, None] * here.local[:, None, :]).reshape(m, p * k)
    blocks = gather @ (here.local[:, :, None] * here.local[:, None, :]).reshape(m, k * k)
    return (
        here.shared.T @ here.shared,
        here.shared.T @ here.residuals,
        mixed.reshape(-1, p, k),
        blocks.reshape(-1, k, k),
        gather @ (here.local * here.residuals[:, None]),
    )


def _reduced(equations: Equations, damping: float) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Schur complement (p, p), its right side (p,), and each block's inverse times its mixed part and right side."""
    shared, right, mixed, blocks, block_right = equations
    diagonal = np.einsum("vii->vi", blocks)
    eye = np.eye(blocks.shape[1])
    # a local parameter that no residual depends on keeps its value
    damped = blocks + np.where(diagonal > 0.0, damping * diagonal, 1.0)[:, :, None] * eye
    try:
        by_shared = np.asarray(np.linalg.solve(damped, mixed.transpose(0, 2, 1)), dtype=np.float64)  # (v, k, p)
        by_right = np.asarray(np.linalg.solve(damped, block_right[:, :, None])[:, :, 0], dtype=np.float64)
    except np.linalg.LinAlgError as error:
        raise BundleError("the pose of a board, or the place of a point, is not determined by its pixels") from error
    whole = shared + damping * np.diag(np.diag(shared))
    reduced = whole - np.tensordot(mixed, by_shared, axes=([0, 2], [0, 1]))
    reduced_right = right - np.tensordot(mixed, by_right, axes=([0, 2], [0, 1]))
    return reduced, reduced_right, by_shared, by_right


def _step(equations: Equations, damping: float) -> tuple[FloatArray, FloatArray]:
    reduced, right, by_shared, by_right = _reduced(equations, damping)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(reduced), 1e-300))
    try:
        step = -scale * np.linalg.solve(reduced * np.outer(scale, scale), scale * right)
    except np.linalg.LinAlgError as error:
        raise BundleError("the observations do not determine all parameters") from error
    return step, -by_right - by_shared @ step


@dataclass(frozen=True, slots=True, eq=False)
class Corners:
    """Corners of a board in images of several cameras.

    Attributes:
        cameras: (m,) index of the camera of each corner.
        views: (m,) index of the instant, i.e. of the board's pose.
        board: (m, 3) the corner in the board's frame, metres.
        pixels: (m, 2) observed position.
    """

    cameras: IntArray
    views: IntArray
    board: FloatArray
    pixels: FloatArray

    def __len__(self) -> int:
        return len(self.pixels)

    def where(self, chosen: BoolArray) -> Corners:
        """The chosen corners (m,); views keep their numbers."""
        return Corners(self.cameras[chosen], self.views[chosen], self.board[chosen], self.pixels[chosen])


class FitToPixels:
    """Base of fits with ``residuals`` (m, 2) in pixels."""

    __slots__ = ()
    residuals: FloatArray

    def rms(self, chosen: BoolArray | None = None) -> float:
        """Root mean square of the 2D residual's norm, pixels, as OpenCV defines it: sqrt(2) times the RMS of one
        axis.
        """
        residuals = self.residuals if chosen is None else self.residuals[chosen]
        return float(np.sqrt((residuals**2).sum(axis=-1).mean()))


@dataclass(frozen=True, slots=True, eq=False)
class Adjusted(FitToPixels):
    """A rig fitted to corners of boards.

    Attributes:
        rig: with the covariance of its parameters.
        rotations: (v, 3, 3) and
        translations: (v, 3) metres: poses of the boards in the rig's frame.
        residuals: (m, 2) observed minus predicted, pixels.
        noise: standard deviation of a corner's coordinate, from the residuals and degrees of freedom, pixels.
    """

    rig: Rig
    rotations: FloatArray
    translations: FloatArray
    residuals: FloatArray
    noise: float


_Boards = tuple[Rig, FloatArray, FloatArray]


def adjust(rig: Rig, rotations: FloatArray, translations: FloatArray, corners: Corners, free: BoolArray) -> Adjusted:
    """Fit cameras and boards to corners.

    Gaschler (2011): eq. 4.9; figure 4.2; eq. 4.10-4.12: least squares are the maximum likelihood where the noise of all
    corners is normal, independent and equal.

    Args:
        rig: initial cameras.
        rotations: (v, 3, 3) and
        translations: (v, 3) initial poses of the boards; boards without corners keep them.
        corners: observed corners.
        free: (p,) which parameters of the rig are fitted; the others keep their value and have no variance.

    Raises:
        BundleError: corners that are not finite, behind a camera, or too few to determine the parameters.
    """
    seen, views = np.unique(corners.views, return_inverse=True)
    chosen = np.flatnonzero(free)
    freedom = 2 * len(corners) - len(chosen) - POSE * len(seen)
    if freedom <= 0 or not np.isfinite(corners.pixels).all():
        raise BundleError(f"{len(corners)} corners on {len(seen)} boards, too few for {len(chosen)} parameters, or NaN")
    starts = projection.offsets(rig)
    members = [np.flatnonzero(corners.cameras == index) for index in range(len(rig.cameras))]

    def linearise(state: _Boards) -> Linearised:
        cameras, turns, shifts = state
        turned = (turns[views] @ corners.board[:, :, None])[:, :, 0]
        points = turned + shifts[views]
        residuals = np.empty((len(corners), 2))
        shared, by_point = np.zeros((len(corners), 2, rig.size)), np.empty((len(corners), 2, 3))
        for index, rows in enumerate(members):
            camera, rotation, translation = (
                cameras.cameras[index],
                cameras.rotations[index],
                cameras.translations[index],
            )
            made = projection.project(camera, rotation, translation, points[rows])
            residuals[rows] = made.pixels - corners.pixels[rows]
            shared[rows, :, starts[index] : starts[index + 1]] = made.by_parameters
            by_point[rows] = made.by_point
        local = np.concatenate([-(by_point @ so3.skew(turned)), by_point], axis=-1)
        return Linearised(
            residuals.ravel(),
            shared.reshape(-1, rig.size)[:, chosen],
            local.reshape(-1, POSE),
            np.repeat(views, 2),
            len(seen),
        )

    def moved(state: _Boards, step: FloatArray, local: FloatArray) -> _Boards:
        cameras, turns, shifts = state
        whole = np.zeros(rig.size)
        whole[chosen] = step
        return cameras.changed(whole), so3.quat_to_matrix(so3.exp(local[:, :3])) @ turns, shifts + local[:, 3:]

    (fitted, turns, shifts), covariance = minimise((rig, rotations[seen], translations[seen]), linearise, moved)
    residuals = -linearise((fitted, turns, shifts)).residuals
    variance = float(residuals @ residuals) / freedom
    whole = np.zeros((rig.size, rig.size))
    whole[np.ix_(chosen, chosen)] = variance * covariance
    all_turns, all_shifts = np.array(rotations), np.array(translations)
    all_turns[seen], all_shifts[seen] = turns, shifts
    return Adjusted(
        replace(fitted, covariance=whole), all_turns, all_shifts, residuals.reshape(-1, 2), float(np.sqrt(variance))
    )


def free_parameters(rig: Rig, *, lenses: bool) -> BoolArray:
    """(p,) which parameters of a rig an adjustment fits.

    Args:
        rig: the rig; the pose of its first camera defines the rig's frame and stays fixed.
        lenses: whether the cameras' matrices and the radial distortion k1, k2 (Gaschler 2011, eq. 4.7) are fitted.
    """
    free = np.zeros(rig.size, dtype=np.bool_)
    for index, start in enumerate(projection.offsets(rig)[:-1]):
        camera = rig.cameras[index]
        if lenses:
            free[start : start + LENS + _RADIAL] = True
        if index > 0:
            free[start + LENS + len(camera.distortion) : start + projection.size(camera)] = True
    return free

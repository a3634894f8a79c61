"""Poses of several targets over time, as arrays."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.compiled_linear import whitening_of
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray
from body_tracking.markers.observations import TargetPose

_ROUNDING: Final = 1e-6
_PROBLEMS: Final = (
    "numbers that are not finite",
    "a matrix that is no rotation",
    "a covariance that is not positive definite",
)


class PoseTableError(BodyTrackingError):
    """Raised for poses of different times or frames, or with invalid numbers."""


@dataclass(frozen=True, slots=True, eq=False)
class PoseTable:
    """Poses of m targets in n frames; an unseen pose is the identity with zero whitening.

    Attributes:
        targets: m names.
        rotations: (n, m, 3, 3) and
        translations: (n, m, 3) metres.
        covariance: (n, m, 6, 6) as :attr:`TargetPose.covariance`.
        whitening: (n, m, 6, 6) W such that ``W.T @ W`` is the inverse of the covariance.
        seen: (n, m) whether the pose exists.
        residuals: (n, m) metres, :attr:`TargetPose.residual`.
        balls: (n, m) number of visible balls of the target.
    """

    targets: tuple[str, ...]
    rotations: FloatArray
    translations: FloatArray
    covariance: FloatArray
    whitening: FloatArray
    seen: BoolArray
    residuals: FloatArray
    balls: FloatArray

    def __len__(self) -> int:
        return len(self.seen)

    @property
    def rigidity(self) -> FloatArray:
        """(n, m) RMS distance of a target's balls from the target fitted to them, in units of their noise.

        Given the orientation, the covariance of the position is that of the balls' centroid, 1/k of a ball's. The pose
        takes six of the balls' 3k degrees of freedom. NaN for an unseen target, or fewer than three balls.
        """
        place, turn, mixed = self.covariance[..., :3, :3], self.covariance[..., 3:, 3:], self.covariance[..., :3, 3:]
        centroid = place - mixed @ np.linalg.solve(turn, mixed.swapaxes(-1, -2))
        squared = np.trace(centroid, axis1=-2, axis2=-1) * (self.balls - 2.0)
        usable = self.seen & (self.balls >= 3) & (squared > 0.0)
        result: FloatArray = np.where(usable, self.residuals / np.sqrt(np.where(usable, squared, 1.0)), np.nan)
        return result

    def only(self, targets: Sequence[str]) -> PoseTable:
        """The frames in which all these targets are seen, restricted to these targets."""
        columns = [self.targets.index(target) for target in targets]
        rows: BoolArray = np.asarray(self.seen[:, columns].all(axis=1))
        return self._taken(tuple(targets), rows, columns)

    def rows(self, rows: BoolArray) -> PoseTable:
        """The frames selected by a mask (n,)."""
        return self._taken(self.targets, rows, list(range(len(self.targets))))

    def _taken(self, targets: tuple[str, ...], rows: BoolArray, columns: list[int]) -> PoseTable:
        return PoseTable(
            targets,
            self.rotations[rows][:, columns],
            self.translations[rows][:, columns],
            self.covariance[rows][:, columns],
            self.whitening[rows][:, columns],
            self.seen[rows][:, columns],
            self.residuals[rows][:, columns],
            self.balls[rows][:, columns],
        )


def pose_table(frames: Sequence[Sequence[TargetPose]], targets: Sequence[str]) -> PoseTable:
    """Table of the poses of these targets, frame by frame; poses of other targets are ignored.

    Raises:
        PoseTableError: no frames, a target twice in a frame, poses of one frame with different stamps or frame_ids,
            numbers that are not finite, a matrix that is not a rotation, a covariance that is not positive definite.
    """
    n, m = len(frames), len(targets)
    if n < 1:
        raise PoseTableError("poses: no frame")
    rotations, translations = np.zeros((n, m, 3, 3)), np.zeros((n, m, 3))
    covariance, whitening = np.zeros((n, m, 6, 6)), np.zeros((n, m, 6, 6))
    rotations[..., range(3), range(3)] = covariance[..., range(6), range(6)] = 1.0
    seen, residual, balls = np.zeros((n, m), dtype=bool), np.full((n, m), np.nan), np.zeros((n, m))
    column = {target: index for index, target in enumerate(targets)}
    for row, frame in enumerate(frames):
        for pose in frame:
            index = column.get(pose.name)
            if index is None:
                continue
            where = f"frame {row}, target {pose.name}"
            if seen[row, index]:
                raise PoseTableError(f"{where}: twice")
            first = frame[0]
            if pose.stamp_ns != first.stamp_ns or pose.frame_id != first.frame_id:
                raise PoseTableError(
                    f"{where}: stamp {pose.stamp_ns} in {pose.frame_id!r}, but {first.name} has {first.stamp_ns} in "
                    f"{first.frame_id!r}"
                )
            shapes = pose.rotation.shape, pose.translation.shape, pose.covariance.shape
            if shapes != ((3, 3), (3,), (6, 6)):
                raise PoseTableError(f"{where}: rotation, translation, covariance {shapes}")
            rotations[row, index], translations[row, index] = pose.rotation, pose.translation
            covariance[row, index] = pose.covariance
            seen[row, index], residual[row, index] = True, pose.residual
            balls[row, index] = np.count_nonzero(pose.points >= 0)
    bad = _whiten(rotations, translations, covariance, seen, whitening)
    if bad >= 0:
        row, index, problem = bad // 3 // m, bad // 3 % m, _PROBLEMS[bad % 3]
        raise PoseTableError(f"frame {row}, target {targets[index]}: {problem}")
    return PoseTable(
        tuple(targets),
        rotations,
        translations,
        covariance,
        whitening,
        seen,
        residual,
        balls,
    )


@compiled
def _whiten(
    rotations: FloatArray, translations: FloatArray, covariance: FloatArray, seen: BoolArray, whitening: FloatArray
) -> int:
    """Write the whitening of the seen poses into zeros; returns -1, or for the first invalid pose three times its index
    plus the index of the problem.
    """
    n, m = seen.shape
    for at in range(n * m):
        row, index = at // m, at % m
        if not seen[row, index]:
            continue
        turn, finite = rotations[row, index], True
        for i in range(3):
            finite &= math.isfinite(translations[row, index, i])
            for j in range(3):
                finite &= math.isfinite(turn[i, j])
        for i in range(6):
            for j in range(6):
                finite &= math.isfinite(covariance[row, index, i, j])
        if not finite:
            return 3 * at
        for i in range(3):
            for j in range(i + 1):
                product = turn[i, 0] * turn[j, 0] + turn[i, 1] * turn[j, 1] + turn[i, 2] * turn[j, 2]
                if not abs(product - (i == j)) < _ROUNDING:
                    return 3 * at + 1
        determinant = turn[0, 0] * (turn[1, 1] * turn[2, 2] - turn[1, 2] * turn[2, 1])
        determinant += turn[0, 1] * (turn[1, 2] * turn[2, 0] - turn[1, 0] * turn[2, 2])
        determinant += turn[0, 2] * (turn[1, 0] * turn[2, 1] - turn[1, 1] * turn[2, 0])
        if determinant < 0.0:
            return 3 * at + 1
        if not whitening_of(covariance[row, index], whitening[row, index]):
            return 3 * at + 2
    return -1

"""Calibration of the poses of many cameras by waving a wand: balls in a row at known distances.

The essential matrix of two cameras gives their relative pose up to scale, and the wand's length gives the scale
(Hartley and Zisserman 2004, section 9.6); a bundle adjustment over the cameras and the balls fits everything together.
The lenses are known from boards, with a covariance: the adjustment moves them within it, so that the poses' covariance
contains their errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, Final

import cv2
import numpy as np

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers import bundle, projection
from body_tracking.markers.bundle_points import AdjustedPoints, Lengths, Prior, Sightings, adjust_points
from body_tracking.markers.rig import Rig
from body_tracking.markers.spheres import sphere_centre_correction

MOST_BALLS: Final = 8
"""Largest number of balls in an image that is searched for a wand: the search takes all triples."""
MIN_SHARED: Final = 20
"""Least number of balls that two cameras see simultaneously; eight determine the essential matrix."""
_OUTLIER: Final = (5.0, 0.5)
"""A sighting is an outlier if its residual exceeds the first number times the median and the second number of
pixels."""
_ROUNDS: Final = 4
_FIRST_NOISE: Final = 0.1
"""First guess of the standard deviation of a ball's coordinate in an image, pixels."""
_NOISE_GUESSED: Final = (0.7, 1.4)
"""Ratio of estimated to expected noise within which the adjustment is not repeated with the estimate."""
_RANSAC: Final = (0.9999, 2.0)
"""RANSAC: confidence, and inlier distance from an epipolar line in pixels."""
_CV: Any = cv2


class WandError(BodyTrackingError):
    """Raised for an impossible wand, or cameras that share too few sightings of it."""


@dataclass(frozen=True, slots=True)
class Wand:
    """Balls in a row.

    Attributes:
        places: of the balls along the wand, metres, rising from 0; two balls or more.
        deviation: standard deviation of its length, metres; the scale of the rig inherits it.

    Raises:
        WandError: places that do not rise from 0, or a deviation that is not positive.
    """

    places: tuple[float, ...]
    deviation: float = 1e-4

    def __post_init__(self) -> None:
        if len(self.places) < 2 or self.places[0] != 0.0 or not (np.diff(self.places) > 0.0).all():
            places = ", ".join(f"{place:g}" for place in self.places)
            raise WandError(f"balls at {places} m along the wand; expected two or more that rise from 0")
        if not 0.0 < self.deviation < np.inf:
            raise WandError(f"deviation {self.deviation} m of the wand's length, expected a positive one")

    def lengths(self) -> Lengths:
        """The distances of all pairs of balls."""
        first, second = np.triu_indices(len(self.places), 1)
        places = np.asarray(self.places)
        return Lengths(np.stack([first, second], axis=-1), places[second] - places[first], self.deviation)

    def order(self, pixels: FloatArray) -> IntArray | None:
        """Assign three balls in an image to the wand's; None if they are not in a row.

        The ratio of the wand's two distances must exceed that of the depths along the wand.

        Args:
            pixels: (3, 2) in any order.

        Returns:
            (3,) indices: ``pixels[order]`` are the balls in the order of the wand.

        Raises:
            WandError: the wand does not have three balls at uneven distances, or other shapes.
        """
        if len(self.places) != 3 or pixels.shape != (3, 2):
            raise WandError(f"{len(self.places)} balls of the wand, pixels {pixels.shape}; expected 3 and (3, 2)")
        first, second = np.diff(self.places)
        if 0.8 < first / second < 1.25:
            raise WandError("balls of the wand at even distances have no order")
        apart = np.linalg.norm(pixels[:, None] - pixels[None], axis=-1)
        middle = int(apart.sum(axis=0).argmin())
        ends = [index for index in range(3) if index != middle]
        along, aside = pixels[ends] - pixels[middle]
        area = abs(along[0] * aside[1] - along[1] * aside[0])
        if area > 0.05 * np.linalg.norm(along) * np.linalg.norm(aside) or along @ aside >= 0.0:
            return None
        if (np.linalg.norm(along) < np.linalg.norm(aside)) != bool(first < second):
            ends.reverse()
        return np.array([ends[0], middle, ends[1]], dtype=np.intp)

    def find(self, pixels: FloatArray) -> IntArray | None:
        """Find the wand among the balls in an image.

        Args:
            pixels: (n, 2) in any order.

        Returns:
            (3,) indices of the balls in the order of the wand; None if no triple or more than one is in a row, or there
            are more than :data:`MOST_BALLS`.

        Raises:
            WandError: as :meth:`order`.
        """
        if not 3 <= len(pixels) <= MOST_BALLS:
            return None
        rows = []
        for chosen in combinations(range(len(pixels)), 3):
            order = self.order(pixels[list(chosen)])
            if order is not None:
                rows.append(np.array(chosen, dtype=np.intp)[order])
        return rows[0] if len(rows) == 1 else None


@dataclass(frozen=True, slots=True, eq=False)
class WandCalibration:
    """A rig calibrated by a wand.

    Attributes:
        rig: with its covariance, which includes that of the wand's length.
        adjusted: the bundle adjustment.
        used: (m,) which sightings it used.
    """

    rig: Rig
    adjusted: AdjustedPoints
    used: BoolArray


def calibrate_wand(
    cameras: Sequence[Camera],
    seen: Sightings,
    wand: Wand,
    covariance: FloatArray | None = None,
) -> WandCalibration:
    """Calibrate the relative poses of cameras.

    Args:
        cameras: two or more, with known lenses; the first one's frame is the rig's.
        seen: balls of the wand; points are numbered along it.
        wand: the wand.
        covariance: (p, p) of the cameras' parameters as in :class:`Rig`, of which those of the lenses are used; None
            for lenses without error. With lenses that are 1 px off and held fixed, the poses' errors are ten times the
            stated deviations.

    Raises:
        BundleError: the sightings do not determine the poses.
        WandError: numbers that are not finite, unknown cameras or balls, cameras that share too few sightings.
    """
    _check(cameras, seen, wand)
    flat, lengths = _flat(cameras, seen), wand.lengths()
    rotations, translations = _camera_poses(cameras, seen, flat, lengths)
    size = sum(projection.size(camera) for camera in cameras)
    known = np.zeros((size, size)) if covariance is None else covariance
    rig = Rig(tuple(cameras), rotations, translations, known)
    prior, poses = Prior.of(rig), bundle.free_parameters(rig, lenses=False)
    used: BoolArray = np.asarray(np.isfinite(flat).all(axis=-1))
    errors = _pixels(rig, seen, intersect(rig, seen.where(used), len(wand.places), flat[used])) - seen.pixels
    used &= _inliers(np.linalg.norm(errors, axis=-1), used)
    noise = _FIRST_NOISE
    for number in range(_ROUNDS):
        used = used & (_counts(seen, used) >= 2)
        points = intersect(rig, seen.where(used), len(wand.places), flat[used])
        used &= np.isfinite(_pixels(rig, seen, points)).all(axis=-1)
        used &= _counts(seen, used) >= 2
        # the first round holds the lenses: outliers would distort them
        free = poses if number == 0 else poses | prior.known
        adjusted = adjust_points(rig, points, seen.where(used), lengths, free, noise, prior)
        guessed = _NOISE_GUESSED[0] < adjusted.noise / noise < _NOISE_GUESSED[1]
        rig, noise = adjusted.rig, adjusted.noise
        good = used.copy()
        good[used] = _inliers(np.linalg.norm(adjusted.residuals, axis=-1))
        done = number > 0 or not prior.known.any()
        if number == _ROUNDS - 1 or (done and guessed and good.sum() == used.sum()):
            break
        used = good
    # the error of the wand's length is constant in all images and scales the rig
    scaled = np.zeros(rig.size)
    for index, end in enumerate(projection.offsets(rig)[1:]):
        scaled[end - 3 : end] = rig.translations[index] * wand.deviation / wand.places[-1]
    rig = replace(rig, covariance=rig.covariance + np.outer(scaled, scaled))
    return WandCalibration(rig, adjusted, used)


def centred(found: WandCalibration, seen: Sightings, diameter: float) -> Sightings:
    """The sightings, moved from the centroids of the balls' images to the projections of the balls' centres.

    Args:
        found: a first calibration by these sightings, for the depths of the balls; unused sightings stay.
        seen: the detections.
        diameter: of the balls, metres.
    """
    rig, pixels = found.rig, np.array(seen.pixels)
    for index, camera in enumerate(rig.cameras):
        rows = np.flatnonzero(found.used & (seen.cameras == index))
        points = found.adjusted.points[seen.views[rows], seen.points[rows]]
        depths = points @ rig.rotations[index][2] + rig.translations[index][2]
        pixels[rows] += sphere_centre_correction(camera, pixels[rows], depths, 0.5 * diameter)
    return replace(seen, pixels=pixels)


def _inliers(errors: FloatArray, used: BoolArray | bool = True) -> BoolArray:
    """Which errors (n,) in pixels are inliers; the median is over the errors in use."""
    chosen = errors[np.isfinite(errors) & used]
    limit = max(_OUTLIER[0] * float(np.median(chosen)), _OUTLIER[1]) if len(chosen) else 0.0
    inliers: BoolArray = errors <= limit
    return inliers


def intersect(rig: Rig, seen: Sightings, points: int, flat: FloatArray | None = None) -> FloatArray:
    """Points nearest to their rays, to initialise an adjustment.

    Args:
        rig: the cameras.
        seen: (m) sightings.
        points: number of points of the object.
        flat: (m, 2) undistorted image coordinates, if known already. Pixels without any give no ray.

    Returns:
        (v, points, 3) metres; zeros for a point with fewer than two rays.
    """
    flat = _flat(rig.cameras, seen) if flat is None else flat
    directed = np.asarray(np.isfinite(flat).all(axis=-1))
    seen, flat = seen.where(directed), flat[directed]
    rays = np.concatenate([flat, np.ones_like(flat[:, :1])], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    turns = rig.rotations[seen.cameras].transpose(0, 2, 1)
    rays = (turns @ rays[:, :, None])[:, :, 0]
    centres = -(turns @ rig.translations[seen.cameras][:, :, None])
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    views = int(seen.views.max(initial=-1)) + 1
    information, right = np.zeros((views, points, 3, 3)), np.zeros((views, points, 3))
    np.add.at(information, (seen.views, seen.points), across)
    np.add.at(right, (seen.views, seen.points), (across @ centres)[:, :, 0])
    known = np.linalg.eigvalsh(information)[..., 0] > 1e-6
    result = np.zeros((views, points, 3))
    result[known] = np.linalg.solve(information[known], right[known][:, :, None])[:, :, 0]
    return result


def _check(cameras: Sequence[Camera], seen: Sightings, wand: Wand) -> None:
    if len(cameras) < 2 or not len(seen.pixels):
        raise WandError(f"{len(cameras)} cameras, {len(seen.pixels)} sightings; a wand needs two cameras that see it")
    if not np.isfinite(seen.pixels).all() or min(seen.cameras.min(), seen.points.min(), seen.views.min()) < 0:
        raise WandError("a pixel is not finite, or an index negative")
    if seen.cameras.max() >= len(cameras) or seen.points.max() >= len(wand.places):
        raise WandError(
            f"camera {seen.cameras.max()} of {len(cameras)}, ball {seen.points.max()} of {len(wand.places)}"
        )


def _counts(seen: Sightings, used: BoolArray) -> IntArray:
    """(m,) number of used sightings of each sighting's ball at its instant."""
    key = seen.views * (int(seen.points.max()) + 1) + seen.points
    counts: IntArray = np.bincount(key[used], minlength=int(key.max()) + 1)[key]
    return counts


def _flat(cameras: Sequence[Camera], seen: Sightings) -> FloatArray:
    flat = np.empty_like(seen.pixels)
    for index, camera in enumerate(cameras):
        rows = seen.cameras == index
        flat[rows] = camera.undistort(seen.pixels[rows])
    return flat


def _pixels(rig: Rig, seen: Sightings, points: FloatArray) -> FloatArray:
    """(m, 2) predicted pixel of each sighting's ball; NaN behind the camera, and for views beyond ``points``."""
    inside = seen.views < len(points)
    places = np.where(inside[:, None], points[np.where(inside, seen.views, 0), seen.points], np.nan)
    pixels: FloatArray = rig.project(places)[seen.cameras, np.arange(len(places))]
    return pixels


def _camera_poses(
    cameras: Sequence[Camera], seen: Sightings, flat: FloatArray, lengths: Lengths
) -> tuple[FloatArray, FloatArray]:
    """Poses (c, 3, 3), (c, 3): a tree from the first camera along pairs that share most sightings."""
    keys = (seen.views * (int(seen.points.max()) + 1) + seen.points).tolist()
    rows: list[dict[int, int]] = [{} for _ in cameras]
    for row, (camera, key) in enumerate(zip(seen.cameras.tolist(), keys, strict=True)):
        if np.isfinite(flat[row]).all():
            rows[camera][key] = row
    rotations, translations = np.tile(np.eye(3), (len(cameras), 1, 1)), np.zeros((len(cameras), 3))
    known, rest = [0], set(range(1, len(cameras)))
    while rest:
        shared, a, b = max((len(rows[a].keys() & rows[b].keys()), a, b) for a in known for b in rest)
        if shared < MIN_SHARED:
            names = ", ".join(cameras[index].frame_id for index in sorted(rest))
            raise WandError(f"cameras {names} share at most {shared} balls with the others, expected {MIN_SHARED}")
        both = sorted(rows[a].keys() & rows[b].keys())
        first, second = np.array([rows[a][key] for key in both]), np.array([rows[b][key] for key in both])
        turn, shift = _relative_pose((cameras[a], cameras[b]), seen, flat, (first, second), lengths)
        rotations[b], translations[b] = turn @ rotations[a], turn @ translations[a] + shift
        known.append(b)
        rest.remove(b)
    return rotations, translations


def _relative_pose(
    cameras: tuple[Camera, Camera],
    seen: Sightings,
    flat: FloatArray,
    rows: tuple[IntArray, IntArray],
    lengths: Lengths,
) -> tuple[FloatArray, FloatArray]:
    """Pose of the second camera in the first: the essential matrix, scaled by the wand's lengths."""
    names = f"cameras {cameras[0].frame_id} and {cameras[1].frame_id}"
    first, second = (np.ascontiguousarray(flat[each]) for each in rows)
    width = _RANSAC[1] / float(np.mean([camera.matrix[[0, 1], [0, 1]] for camera in cameras]))
    try:
        essential, good = _CV.findEssentialMat(first, second, np.eye(3), _CV.RANSAC, _RANSAC[0], width)
        if essential is None or essential.shape != (3, 3):
            raise WandError(f"{names}: their sightings of the wand give no essential matrix")
        count, turn, shift, _ = _CV.recoverPose(essential, first, second, np.eye(3), mask=good)
    except cv2.error as error:
        raise WandError(f"{names}: OpenCV finds no pose ({error.err})") from error
    if count < MIN_SHARED:
        raise WandError(f"{names}: {count} of {len(first)} balls before both, expected {MIN_SHARED}")
    turn, shift = np.asarray(turn, dtype=np.float64), np.asarray(shift, dtype=np.float64).ravel()
    size = sum(projection.size(camera) for camera in cameras)
    pair = Rig(cameras, np.stack([np.eye(3), turn]), np.stack([np.zeros(3), shift]), np.zeros((size, size)))
    both = np.concatenate(rows)
    side = np.repeat(np.array([0, 1], dtype=np.intp), len(first))
    shared = Sightings(side, seen.views[both], seen.points[both], seen.pixels[both])
    points = intersect(pair, shared, int(lengths.pairs.max()) + 1, flat[both])
    start, end = points[:, lengths.pairs[:, 0]], points[:, lengths.pairs[:, 1]]
    seen_pairs = start.any(axis=-1) & end.any(axis=-1)
    made = np.linalg.norm(end - start, axis=-1)[seen_pairs]
    if not len(made):
        raise WandError(f"{names}: never two balls of the wand at once, which would give the scale")
    scale = float(np.median(np.broadcast_to(lengths.metres, seen_pairs.shape)[seen_pairs] / made))
    return turn, scale * shift

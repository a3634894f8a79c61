"""Bundle adjustment of cameras and free points with known distances between some of them.

Such points are the two ends of a wand, or the corners of a printed board that is bent: its squares keep their edge
lengths, but the board is no plane. This model fits a flexible board down to the noise of its corners; a plane does not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.markers import projection
from body_tracking.markers.bundle import BundleError, FitToPixels, Linearised, minimise
from body_tracking.markers.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Points of an object in images of several cameras.

    Attributes:
        cameras: (m,) index of the camera.
        views: (m,) index of the instant.
        points: (m,) index of the point of the object.
        pixels: (m, 2) observed position.
    """

    cameras: IntArray
    views: IntArray
    points: IntArray
    pixels: FloatArray

    def where(self, chosen: BoolArray) -> Sightings:
        """The chosen sightings (m,); views keep their numbers."""
        return Sightings(self.cameras[chosen], self.views[chosen], self.points[chosen], self.pixels[chosen])


@dataclass(frozen=True, slots=True, eq=False)
class Lengths:
    """Known distances between points of an object.

    Attributes:
        pairs: (e, 2) indices of the points.
        metres: (e,) their distances.
        deviation: standard deviation of the distance of a pair at an instant, metres.
    """

    pairs: IntArray
    metres: FloatArray
    deviation: float


@dataclass(frozen=True, slots=True, eq=False)
class AdjustedPoints(FitToPixels):
    """A rig fitted to points.

    Attributes:
        rig: with the covariance of its parameters.
        points: (v, n, 3) in the rig's frame, metres.
        residuals: (m, 2) observed minus predicted, pixels.
        length_errors: (v, e) fitted minus known distance, metres; NaN where a point of the pair is not seen.
        noise: standard deviation of a coordinate of an image, from the residuals and degrees of freedom, pixels.
    """

    rig: Rig
    points: FloatArray
    residuals: FloatArray
    length_errors: FloatArray
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Prior of the cameras' lenses.

    Attributes:
        lenses: (p,) parameters of the rig; those of poses are not used.
        known: (p,) whether a parameter has a prior.
        whitening: (k, k) W of these k parameters: W^T W is the inverse of their covariance.
    """

    lenses: FloatArray
    known: BoolArray
    whitening: FloatArray

    @classmethod
    def of(cls, rig: Rig) -> Prior:
        """Prior from the lenses of a rig and their covariance; its poses are not used."""
        known = projection.lenses_of(rig) & (np.diag(rig.covariance) > 0.0)
        deviations = np.sqrt(np.diag(rig.covariance)[known])
        # scaled to a unit diagonal: focal lengths and coefficients differ by orders of magnitude
        correlations = rig.covariance[np.ix_(known, known)] / np.outer(deviations, deviations)
        values, vectors = np.linalg.eigh(correlations)
        whitening = (vectors / np.sqrt(np.maximum(values, _LEAST_VARIANCE))).T / deviations
        return cls(projection.parameters(rig), known, whitening)


_Points = tuple[Rig, FloatArray]
_LEAST_VARIANCE: Final = 1e-9
"""Lower bound of the eigenvalues of the correlation matrix; rounding in a file can make them zero or negative."""


def adjust_points(
    rig: Rig,
    points: FloatArray,
    seen: Sightings,
    lengths: Lengths,
    free: BoolArray,
    noise: float,
    prior: Prior | None = None,
) -> AdjustedPoints:
    """Fit cameras and points to the observed pixels.

    Args:
        rig: initial cameras.
        points: (v, n, 3) metres, initial positions; points that are not seen are not used.
        seen: each point in two cameras or more.
        lengths: of the object; they give the scale.
        free: (p,) which parameters of the rig are fitted; the others keep their value and have no variance.
        noise: expected standard deviation of a pixel coordinate, pixels; weights pixels against lengths.
        prior: prior of the cameras' lenses.

    Raises:
        BundleError: pixels that are not finite, behind a camera, or too few to determine the parameters.
    """
    count, object_points = points.shape[:2]
    chosen = np.flatnonzero(free)
    there = np.zeros((count, object_points), dtype=np.bool_)
    there[seen.views, seen.points] = True
    known = there[:, lengths.pairs].all(axis=-1)  # (v, e)
    at, pair = np.nonzero(known)
    weights = np.zeros((0, rig.size))
    if prior is not None:
        weights = np.zeros((len(prior.whitening), rig.size))
        weights[:, prior.known] = prior.whitening
    freedom = 2 * len(seen.pixels) + len(at) + len(weights) - 3 * int(there.sum()) - len(chosen)
    if freedom <= 0 or not len(at) or not np.isfinite(seen.pixels).all():
        raise BundleError(
            f"{len(seen.pixels)} sightings of {int(there.sum())} points and {len(at)} known lengths, "
            f"too few for {len(chosen)} parameters, or NaN"
        )
    starts = projection.offsets(rig)
    members = [np.flatnonzero(seen.cameras == index) for index in range(len(rig.cameras))]
    columns = 3 * seen.points[:, None] + np.arange(3)
    first, second = lengths.pairs[pair].T
    first_columns, second_columns = 3 * first[:, None] + np.arange(3), 3 * second[:, None] + np.arange(3)
    blocks = np.concatenate([np.repeat(seen.views, 2), at, np.zeros(len(weights), dtype=np.intp)])

    def linearise(state: _Points) -> Linearised:
        cameras, places = state
        residuals = np.empty((len(seen.pixels), 2))
        shared = np.zeros((len(seen.pixels), 2, rig.size))
        local = np.zeros((len(seen.pixels), 2, 3 * object_points))
        for index, rows in enumerate(members):
            made = projection.project(
                cameras.cameras[index],
                cameras.rotations[index],
                cameras.translations[index],
                places[seen.views[rows], seen.points[rows]],
            )
            residuals[rows] = made.pixels - seen.pixels[rows]
            shared[rows, :, starts[index] : starts[index + 1]] = made.by_parameters
            local[rows[:, None, None], np.arange(2)[None, :, None], columns[rows][:, None, :]] = made.by_point
        apart = places[at, second] - places[at, first]
        distance = np.linalg.norm(apart, axis=-1)
        direction = apart / distance[:, None]
        by_points = np.zeros((len(at), 3 * object_points))
        by_points[np.arange(len(at))[:, None], first_columns] = -direction
        by_points[np.arange(len(at))[:, None], second_columns] = direction
        before = np.zeros(len(weights)) if prior is None else weights @ (projection.parameters(cameras) - prior.lenses)
        return Linearised(
            np.concatenate([residuals.ravel() / noise, (distance - lengths.metres[pair]) / lengths.deviation, before]),
            np.concatenate(
                [
                    shared.reshape(-1, rig.size)[:, chosen] / noise,
                    np.zeros((len(at), len(chosen))),
                    weights[:, chosen],
                ]
            ),
            np.concatenate(
                [
                    local.reshape(-1, 3 * object_points) / noise,
                    by_points / lengths.deviation,
                    np.zeros((len(weights), 3 * object_points)),
                ]
            ),
            blocks,
            count,
        )

    def moved(state: _Points, step: FloatArray, local: FloatArray) -> _Points:
        whole = np.zeros(rig.size)
        whole[chosen] = step
        return state[0].changed(whole), state[1] + local.reshape(count, object_points, 3)

    (fitted, places), covariance = minimise((rig, points), linearise, moved)
    all_residuals = linearise((fitted, places)).residuals
    pixels = -noise * all_residuals[: 2 * len(seen.pixels)].reshape(-1, 2)
    variance = float(all_residuals @ all_residuals) / freedom
    whole = np.zeros((rig.size, rig.size))
    whole[np.ix_(chosen, chosen)] = variance * covariance
    errors = np.full((count, len(lengths.pairs)), np.nan)
    errors[at, pair] = lengths.deviation * all_residuals[2 * len(seen.pixels) :][: len(at)]
    return AdjustedPoints(replace(fitted, covariance=whole), places, pixels, errors, float(noise * np.sqrt(variance)))

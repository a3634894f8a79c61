"""Joints from the landmarks that two or more calibrated colour cameras see at one time.

Each landmark is the point nearest to its lines of sight, weighted by the error of a pixel at its distance. People are
matched between cameras by the distances between the lines of sight of their landmarks.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import Final, NamedTuple

import numpy as np

from body_tracking.camera.lifting import ACROSS, BODY_SIDE, HIDDEN, SEEN, Lifted, joints_of
from body_tracking.camera.pose_model import Landmark, Landmarks
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers.rig import Rig

_SAME_PERSON: Final = 0.15
"""Metres: greatest distance between the lines of sight of a person's trunk, root mean square."""
_TRUNK: Final = [Landmark.SHOULDER_LEFT, Landmark.SHOULDER_RIGHT, Landmark.HIP_LEFT, Landmark.HIP_RIGHT]
_ROUNDS: Final = 3
"""Solutions of the normal equations, each weighted by the distances of the last one."""
ALIKE: Final = 0.018
"""Metres per axis by which the network displaces a landmark in the same way in the images of all cameras."""
_TRUNK_LENGTH: Final = (0.3, 0.7)
"""Metres from the shoulders to the hips, of children and of tall adults: where the lines of sight of two different
people meet, the resulting person is too small or too large."""
_USUAL_LENGTH: Final = 0.5
_MOST_APART: Final = 0.06
"""Metres: distance between the lines of sight of a person's trunk from which the rig is in doubt. In rendered images it
is 0.02, with one of two cameras turned up or down by one degree 0.045, by two 0.09."""
_NEWEST, _LEAST = 60, 30
"""Sets of images in the median of that distance, at most and at least."""
_FARTHEST: Final = 4.0
"""Standard deviations by which a line of sight may pass the point of the others, with three or more cameras."""


class View(NamedTuple):
    """One person in one camera: its index in the rig, and the landmarks in its image."""

    camera: int
    landmarks: Landmarks


class Lines(NamedTuple):
    """The lines of sight of one person in one camera.

    Attributes:
        origin: (3,) metres, the camera's centre in the rig's frame.
        directions: (33, 3) unit vectors; NaN where a pixel has none, or the landmark is not in the image.
        angles: (33,) radians, standard deviation of each.
    """

    origin: FloatArray
    directions: FloatArray
    angles: FloatArray


def lines_of(rig: Rig, view: View) -> Lines:
    """The lines of sight of a person in a camera of a rig."""
    camera: Camera = rig.cameras[view.camera]
    rotation, found = rig.rotations[view.camera], view.landmarks
    inside = (found.present > SEEN) & camera.contains(found.pixels)
    rays = np.where(inside[:, None], camera.rays(found.pixels), np.nan)
    pixel = ACROSS * found.region.side / BODY_SIDE
    angles = pixel / float(camera.matrix[0, 0]) * np.where(found.visible > SEEN, 1.0, HIDDEN)
    return Lines(-rotation.T @ rig.translations[view.camera], rays @ rotation, angles)


def match(rig: Rig, people: Sequence[Mapping[int, Landmarks]]) -> list[list[View]]:
    """The people of all cameras, each with the views of one person; those whom one camera sees alone are left out.

    Args:
        rig: the cameras.
        people: of each camera, by their numbers there.
    """
    views = [View(index, found) for index, each in enumerate(people) for found in each.values()]
    lines = [lines_of(rig, view) for view in views]
    apart = {
        (a, b): _unlike(lines[a], lines[b])
        for a, b in combinations(range(len(views)), 2)
        if views[a].camera != views[b].camera
    }
    group = list(range(len(views)))
    for (a, b), distance in sorted(apart.items(), key=lambda item: item[1]):
        if not np.isfinite(distance) or group[a] == group[b]:
            continue
        members = [k for k in range(len(views)) if group[k] in (group[a], group[b])]
        if len({views[k].camera for k in members}) == len(members):
            for k in members:
                group[k] = group[a]
    found = [[views[k] for k in range(len(views)) if group[k] == number] for number in dict.fromkeys(group)]
    return [each for each in found if len(each) > 1]


def triangulate(rig: Rig, views: Sequence[View]) -> Lifted:
    """The joints of a person whom two or more cameras see, in the rig's frame.

    The covariance includes the landmarks' errors, not those of the rig's calibration. The errors of landmarks were
    chosen on simulated people who are not in the benchmark (``lifting.ACROSS``).
    """
    lines = [lines_of(rig, view) for view in views]
    count = len(Landmark)
    points, covariances = np.full((count, 3), np.nan), np.full((count, 3, 3), np.nan)
    sure = np.zeros(count, dtype=np.bool_)
    for landmark in range(count):
        used = [k for k, each in enumerate(lines) if np.isfinite(each.directions[landmark]).all()]
        while len(used) > 1:
            point, covariance, off = _nearest([lines[k] for k in used], landmark)
            if len(used) > 2 and off.max() > _FARTHEST:
                del used[int(off.argmax())]
                continue
            # behind a camera the lines do not meet
            ahead = all((point - lines[k].origin) @ lines[k].directions[landmark] > 0.0 for k in used)
            if ahead:
                points[landmark] = point
                covariances[landmark] = covariance * max(1.0, float((off**2).mean())) + ALIKE**2 * np.eye(3)
                sure[landmark] = sum(views[k].landmarks.visible[landmark] > SEEN for k in used) > 1
            break
    return joints_of(points, covariances, sure)


class SightLines:
    """Watches whether the lines of sight of a lone person meet, which they do not if a camera was moved.

    Two cameras side by side do not show which of them was turned to the side: then the lines meet elsewhere.
    """

    def __init__(self) -> None:
        self._apart: deque[float] = deque(maxlen=_NEWEST)

    def add(self, rig: Rig, people: Sequence[Mapping[int, Landmarks]]) -> None:
        """Take the people of all cameras in images of one time, if each camera sees one person."""
        if all(len(each) == 1 for each in people):
            lines = [lines_of(rig, View(k, found)) for k, each in enumerate(people) for found in each.values()]
            apart = max(_apart(one, other) for one, other in combinations(lines, 2))
            if np.isfinite(apart):
                self._apart.append(apart)

    def problem(self) -> str:
        """What is wrong with the cameras; empty if nothing is, or too little was seen."""
        if len(self._apart) < _LEAST or (middle := float(np.median(self._apart))) < _MOST_APART:
            return ""
        return (
            f"the cameras' lines of sight of one person pass each other by {1e3 * middle:.0f} mm: was a camera moved "
            "since the calibration, or are their images of different times?"
        )


def _nearest(lines: Sequence[Lines], landmark: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The point nearest to lines of sight, its covariance, and the distance of each line in standard deviations."""
    origins = np.array([each.origin for each in lines])
    directions = np.array([each.directions[landmark] for each in lines])
    angles = np.array([each.angles[landmark] for each in lines])
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    distances = np.ones(len(lines))
    for _ in range(_ROUNDS):
        weights = across / ((angles * distances) ** 2)[:, None, None]
        normal = weights.sum(axis=0)
        # lines that are nearly parallel leave the distance open
        covariance = np.linalg.inv(normal + 1e-6 * np.trace(normal) / 3.0 * np.eye(3))
        point = covariance @ np.einsum("nij,nj->i", weights, origins)
        distances = np.maximum(np.linalg.norm(point - origins, axis=1), 0.1)
    off = np.linalg.norm(np.einsum("nij,nj->ni", across, point - origins), axis=1) / (angles * distances)
    return point, covariance, off


def _unlike(one: Lines, other: Lines) -> float:
    """Dissimilarity of two views in metres; infinity if they cannot be of one person.

    It combines the distance between the lines of sight of the trunk and the difference of the triangulated trunk from
    the usual length: the lines of sight of two people of one height meet, but not at the distances of the people.
    """
    apart = _apart(one, other)
    if not apart < _SAME_PERSON:
        return float("inf")
    trunk = np.array([_nearest((one, other), landmark)[0] for landmark in _TRUNK])
    length = float(np.linalg.norm(trunk[:2].mean(axis=0) - trunk[2:].mean(axis=0)))
    low, high = _TRUNK_LENGTH
    return float(np.hypot(apart, 0.5 * (length - _USUAL_LENGTH))) if low < length < high else float("inf")


def _apart(one: Lines, other: Lines) -> float:
    """Metres between the lines of sight of two views' trunks, root mean square; infinity if a landmark is missing."""
    cross = np.cross(one.directions[_TRUNK], other.directions[_TRUNK])
    length = np.linalg.norm(cross, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        distances = np.abs(cross @ (other.origin - one.origin)) / length
    return float(np.sqrt(np.mean(distances**2))) if np.isfinite(distances).all() else float("inf")

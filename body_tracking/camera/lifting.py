"""Joints of a body in three dimensions, from landmarks in a colour image and the depth image at the same pixels.

A depth camera measures the skin or the clothes; the centre of a joint lies behind the surface along the line of sight.
Where an object hides a joint, the depth at its pixel is the object's. This contradicts the depth expected by the
statistical model of the landmarks, and the joint is inferred from the expected depth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.camera.pose_model import Landmark, Landmarks
from body_tracking.core.camera import Camera
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint, SingleArray, Skeleton, TrackingState
from body_tracking.mesh.depth import axial_noise

BODY_SIDE: Final = 2.2
"""Metres: side of the region around an upright person; the landmarks' errors are proportional to it."""
ACROSS: Final = 0.04
"""Metres: standard deviation of a landmark across the line of sight, per axis, in a region of :data:`BODY_SIDE`. With
the landmarks' displacements (below) it is 43 mm, which reproduces the published share of landmarks within a fifth of
the torso's diagonal in photographs (PCK@0.2 of 95.8 %: Google, MediaPipe Pose, "Pose estimation quality"). In rendered
images it is 16 mm."""
HIDDEN: Final = 3.0
"""Factor on :data:`ACROSS` for a landmark that the network guesses."""
_ALONG: Final = 0.02
"""Metres: standard deviation of the depth of a joint's centre behind the surface: people and clothes differ."""
_GUESSED_ALONG: Final = 0.25
"""Metres: the same where the depth is the expected one."""
_DISAGREED: Final = 0.5
"""Share of the difference between measured and expected depth that is a standard deviation, too: they differ where the
limb is behind the trunk, as of a person seen from the side."""
_TURNED: Final = (0.08, 0.16)
"""Metres: difference in depth of the two shoulders or hips, by the statistical model, from which on the trunk begins to
hide the farther one, and at which it hides it. The depth measured there is that of chest or belly."""
_BETWEEN: Final = 0.045
"""Metres: standard deviation of this difference, for simulated people seen from all sides."""
_WINDOW: Final = 0.06
"""Metres to each side of a landmark in which its surface is searched: 1.5 standard deviations of the landmark."""
_EXPECTED: Final = 0.25
"""Metres: greatest difference of a joint's surface from its expected depth."""
_LEAST_PIXELS: Final = 4
SEEN: Final = 0.5
"""Least probability that a landmark is visible, or in the image."""
_FLAT_POINTS: Final = 200
_FLAT: Final = 0.005
"""Metres: a body whose surface deviates from a plane by less than this plus the camera's noise, RMS, is a picture; the
flattest simulated people, who stand straight before the camera, deviate by 10 mm."""

# For each joint: the landmarks of which it is the mean; the distance of its centre behind the surface, metres, half the
# depth of the segment there in clothed adults; the displacement of the landmark from the joint, metres per axis.
_MADE_OF: Final[dict[Joint, tuple[tuple[Landmark, ...], float, float]]] = {
    Joint.HEAD: ((Landmark.EAR_LEFT, Landmark.EAR_RIGHT), 0.09, 0.035),
    **{
        Joint[f"{joint}_{side}"]: (tuple(Landmark[f"{each}_{side}"] for each in names), behind, displaced)
        for side in ("LEFT", "RIGHT")
        for joint, names, behind, displaced in (
            ("SHOULDER", ("SHOULDER",), 0.065, 0.02),
            ("ELBOW", ("ELBOW",), 0.05, 0.01),
            ("WRIST", ("WRIST",), 0.035, 0.01),
            ("HAND", ("WRIST", "INDEX_FINGER", "LITTLE_FINGER"), 0.02, 0.025),
            ("HIP", ("HIP",), 0.12, 0.025),
            ("KNEE", ("KNEE",), 0.07, 0.01),
            ("ANKLE", ("ANKLE",), 0.05, 0.02),
            ("FOOT", ("TOES",), 0.045, 0.025),
        )
    },
}
_JOINTS: IntArray = np.array(list(_MADE_OF), dtype=np.intp)
_WEIGHTS: FloatArray = np.zeros((len(_MADE_OF), len(Landmark)))
for _row, (_names, _, _) in enumerate(_MADE_OF.values()):
    _WEIGHTS[_row, list(_names)] = 1.0 / len(_names)
_BEHIND: FloatArray = np.array([behind for _, behind, _ in _MADE_OF.values()])
_DISPLACED: FloatArray = np.array([displaced for _, _, displaced in _MADE_OF.values()])

# Joints of the trunk without a landmark: weights of the middles of shoulders and hips, and displacement, metres per
# axis. A Kinect's SpineMid divides the line between the middles in this ratio in real people.
_TRUNK: Final[dict[Joint, tuple[float, float, float]]] = {
    Joint.SPINE_BASE: (0.0, 1.0, 0.02),
    Joint.SPINE_MID: (0.578, 0.422, 0.05),
    Joint.SPINE_SHOULDER: (1.0, 0.0, 0.01),
    Joint.NECK: (1.12, -0.12, 0.02),
}
_SHOULDERS = (Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT)
_HIPS = (Joint.HIP_LEFT, Joint.HIP_RIGHT)
_ARMS: BoolArray = np.array([joint.name.startswith(("ELBOW", "WRIST", "HAND")) for joint in _MADE_OF])
"""Joints that stay unknown where one camera guesses their depth. Such a guess errs by 0.23 m (elbow) to 0.39 m (hand),
and alike for seconds, so that filters would believe it against a camera that sees the arm; legs err by 0.17 m."""
_PAIRS = tuple(np.array([list(_MADE_OF).index(each) for each in pair]) for pair in (_SHOULDERS, _HIPS))
_TORSO: IntArray = np.array(
    [Landmark.SHOULDER_LEFT, Landmark.SHOULDER_RIGHT, Landmark.HIP_RIGHT, Landmark.HIP_LEFT], dtype=np.intp
)
_SPINE: Final = 0.08
"""Metres: width about the spine that always belongs to the trunk."""


@dataclass(frozen=True, slots=True, eq=False)
class Lifted:
    """A body in three dimensions.

    Attributes:
        positions: (25, 3) metres in the optical frame of the colour camera; NaN where unknown.
        states: (25,) of :class:`~body_tracking.core.skeleton.TrackingState`.
        covariances: (25, 3, 3) square metres; NaN where unknown.
    """

    positions: FloatArray
    states: NDArray[np.uint8]
    covariances: FloatArray

    def skeleton(self, stamp_ns: int, frame_id: str, body: int = 0) -> Skeleton:
        """The joints as a sensor's skeleton."""
        return Skeleton(stamp_ns, frame_id, self.positions, self.states, body, covariances=self.covariances)


def lift(found: Landmarks, depth: SingleArray, camera: Camera) -> Lifted | None:
    """The joints of one person.

    Args:
        found: landmarks in the image of ``camera``.
        depth: (height, width) metres at the same pixels, 0 where missing.
        camera: intrinsics of both.

    Returns:
        None where the depth image shows nothing at the trunk.
    """
    trunk = trunk_depth(found, depth)
    if trunk is None:
        return None
    focal = float(camera.matrix[0, 0])
    pixels, world = _WEIGHTS @ found.pixels, _WEIGHTS @ found.world
    visible = np.min(np.where(_WEIGHTS > 0.0, found.visible, 1.0), axis=1)
    present = np.min(np.where(_WEIGHTS > 0.0, found.present, 1.0), axis=1) > SEEN
    present &= camera.contains(pixels)
    expected = trunk + world[:, 2] - found.world[_TORSO, 2].mean()
    wanted = present & (expected > _WINDOW)
    surface, spread = _surfaces(
        depth, pixels, expected, _EXPECTED, _WINDOW * focal / np.where(wanted, expected, 1.0), wanted
    )
    # where the network guesses, the measured surface may be in front of the joint
    seen = np.isfinite(surface) & (visible > SEEN)
    rays = np.concatenate([camera.undistort(pixels), np.ones((len(pixels), 1))], axis=1)
    depths, hidden = _behind_the_trunk(np.where(seen, surface, expected), world[:, 2], seen)
    positions = rays * (depths + _BEHIND)[:, None]
    scale = found.region.side * trunk / focal / BODY_SIDE
    across = ACROSS * scale * np.where(seen, 1.0, HIDDEN)
    doubt = np.where(seen, _DISAGREED * np.abs(depths - expected), 0.0)
    along = np.where(seen, np.sqrt(_ALONG**2 + spread**2 + doubt**2 + (hidden * _BETWEEN) ** 2), _GUESSED_ALONG)
    unit = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    outer = unit[:, :, None] * unit[:, None, :]
    covariances = (across**2)[:, None, None] * (np.eye(3) - outer) + (along**2)[:, None, None] * outer
    covariances += (_DISPLACED**2)[:, None, None] * np.eye(3)
    known = present & np.isfinite(positions).all(axis=1) & (seen | ~_ARMS)
    return _whole(positions, covariances, seen, known)


def _behind_the_trunk(depths: FloatArray, relative: FloatArray, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Replace the depths of a shoulder and a hip that the trunk hides by the other one's plus the expected difference.

    Somebody who stands at 45 degrees shows one shoulder, and the chest 80 mm in front of the other one.

    Args:
        depths: (n,) metres, of the surface at each joint.
        relative: (n,) metres, depth of each joint relative to the body, by the statistical model of the landmarks.
        seen: (n,) joints whose depth is measured.

    Returns:
        The depths, and (n,) the share of each that is replaced, 0 to 1.
    """
    depths, hidden = depths.copy(), np.zeros(len(depths))
    for pair in _PAIRS:
        near, far = pair[np.argsort(relative[pair])]
        gap = float(relative[far] - relative[near])
        if not seen[near]:
            continue
        hidden[far] = np.clip((gap - _TURNED[0]) / (_TURNED[1] - _TURNED[0]), 0.0, 1.0)
        depths[far] += hidden[far] * max(0.0, depths[near] + gap - depths[far])
    return depths, hidden


def joints_of(points: FloatArray, covariances: FloatArray, sure: BoolArray) -> Lifted:
    """The joints of a person whose landmarks are known in space.

    Args:
        points: (33, 3) metres; NaN where unknown.
        covariances: (33, 3, 3) square metres.
        sure: (33,) landmarks that are seen, not guessed.
    """
    used = _WEIGHTS > 0.0
    known = np.array([bool(np.isfinite(points[row]).all()) for row in used])
    places = _WEIGHTS @ np.where(np.isfinite(points), points, 0.0)
    # the errors of a joint's landmarks are correlated: averaging does not reduce them
    spread = np.einsum("jl,lab->jab", _WEIGHTS, np.where(np.isfinite(covariances), covariances, 0.0))
    spread += (_DISPLACED**2)[:, None, None] * np.eye(3)
    seen = np.array([bool(sure[row].all()) for row in used])
    return _whole(places, spread, seen, known)


def trunk_depth(found: Landmarks, depth: SingleArray) -> float | None:
    """The median depth of a person's trunk, metres; None where nothing is measured there."""
    measured = depth[_trunk_mask(found, depth.shape)]
    measured = measured[measured > 0.0]
    return float(np.median(measured)) if len(measured) >= _LEAST_PIXELS else None


def is_flat(found: Landmarks, depth: SingleArray, camera: Camera) -> bool:
    """Whether the person is a picture: the surface of trunk and joints lies in a plane."""
    mask = _trunk_mask(found, depth.shape)
    inside = camera.contains(found.pixels) & (found.visible > SEEN)
    columns, rows = np.round(found.pixels[inside]).astype(np.intp).T
    mask[rows, columns] = True
    rows, columns = np.nonzero(mask & (depth > 0.0))
    chosen = np.linspace(0, len(rows) - 1, min(len(rows), _FLAT_POINTS)).astype(np.intp)
    rows, columns = rows[chosen], columns[chosen]
    z = depth[rows, columns].astype(np.float64)
    if len(z) < _FLAT_POINTS // 2:
        return False
    flat = (np.column_stack([columns, rows]) - camera.matrix[:2, 2]) / camera.matrix[[0, 1], [0, 1]]
    points = np.column_stack([flat * z[:, None], z])
    off = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)[-1] / np.sqrt(len(z))
    return bool(off < _FLAT + float(axial_noise(z.mean())))


def _trunk_mask(found: Landmarks, shape: tuple[int, ...]) -> BoolArray:
    """(height, width) pixels of the trunk: between shoulders and hips, and about the spine for a view from the side.

    No pixel if a corner is unknown.
    """
    corners = found.pixels[_TORSO]
    mask = np.zeros(shape, np.uint8)
    if not np.isfinite(corners).all():
        return mask.astype(np.bool_)
    middle = corners.mean(axis=0)
    top, bottom = corners[:2].mean(axis=0), corners[2:].mean(axis=0)
    inner = np.round(middle + 0.8 * (corners - middle)).astype(np.int32)
    cv2.fillConvexPoly(mask, cv2.convexHull(inner), 1)
    ends = [tuple(np.round(middle + 0.7 * (end - middle)).astype(int).tolist()) for end in (top, bottom)]
    cv2.line(mask, ends[0], ends[1], 1, max(1, round(_SPINE * found.region.side / BODY_SIDE)))
    return mask.astype(np.bool_)


@compiled
def _surfaces(
    depth: SingleArray, pixels: FloatArray, expected: FloatArray, near: float, radii: FloatArray, wanted: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Depth of the surface about each pixel (n,) and its scatter (n,), RMS, metres; NaN and 0 where none is ``near``
    the expected depth (n,), metres, within the radius (n,), pixels, or it is not wanted (n,).
    """
    surfaces, spreads = np.full(len(pixels), np.nan), np.zeros(len(pixels))
    height, width = depth.shape
    for k in range(len(pixels)):
        if not wanted[k]:
            continue
        column, row = int(np.round(pixels[k, 0])), int(np.round(pixels[k, 1]))
        reach = max(1, int(np.round(radii[k])))
        top, bottom = max(row - reach, 0), min(row + reach + 1, height)
        left, right = max(column - reach, 0), min(column + reach + 1, width)
        if bottom <= top or right <= left:
            continue
        there, count = np.empty((bottom - top) * (right - left)), 0
        for i in range(top, bottom):
            for j in range(left, right):
                if abs(depth[i, j] - expected[k]) < near:
                    there[count] = depth[i, j]
                    count += 1
        if count < _LEAST_PIXELS:
            continue
        surfaces[k] = np.median(there[:count])
        spreads[k] = np.sqrt(np.mean((there[:count] - surfaces[k]) ** 2))
    return surfaces, spreads


def prepare() -> None:
    """Compile the loop, or load it, before the first image."""
    ones = np.ones(1)
    for writeable in (True, False):
        depth = np.zeros((2, 2), np.float32)
        depth.flags.writeable = writeable
        _surfaces(depth, np.zeros((1, 2)), ones, _EXPECTED, ones, ones > 0.0)


def _whole(positions: FloatArray, covariances: FloatArray, seen: BoolArray, known: BoolArray) -> Lifted:
    """All 25 joints from those with landmarks."""
    points, spread = np.full((len(Joint), 3), np.nan), np.full((len(Joint), 3, 3), np.nan)
    states = np.full(len(Joint), TrackingState.NOT_TRACKED, np.uint8)
    made = _JOINTS[known]
    points[made], spread[made] = positions[known], covariances[known]
    states[made] = np.where(seen[known], TrackingState.TRACKED, TrackingState.INFERRED)
    for joint, (of_shoulders, of_hips, displaced) in _TRUNK.items():
        parts = [(of_shoulders / 2.0, each) for each in _SHOULDERS] + [(of_hips / 2.0, each) for each in _HIPS]
        used = [(weight, each) for weight, each in parts if weight]
        if any(states[each] == TrackingState.NOT_TRACKED for _, each in used):
            continue
        points[joint] = sum(weight * points[each] for weight, each in used)
        # the errors of the trunk's landmarks are correlated: averaging does not reduce them
        spread[joint] = np.mean([spread[each] for _, each in used], axis=0) + displaced**2 * np.eye(3)
        states[joint] = min(states[each] for _, each in used)
    return Lifted(points, states, spread)

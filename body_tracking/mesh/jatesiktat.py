"""The published method of Jatesiktat, Anopas and Ang (2018), as a baseline for comparison; no node uses it.

Its correspondences are variables of the fit, beside the pose; its energy has the terms of eq. 5-12 with the weights of
section IV-C. The IMU term uses only the direction of a forearm.

Interpretation of points that the paper leaves open: eq. 6 and 7 are in pixels, eq. 8 in radians, eq. 12 in metres. The
body model of 20 joints has 37 degrees of freedom, the paper's 40; the limits are those of ``kinematics.ranges``. A
success divides the damping by 10, a failure multiplies it by 10. Each candidate set has 250 points. Pixels are sampled
by six parts of the body, half of each near the outline. The body's shape is given.

Over 500 lines: the terms of one paper's method share look-ups in an image.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, Joint, SingleArray
from body_tracking.mesh.anatomy import SIDES, Anatomy
from body_tracking.mesh.body_model import Body, BodyModel, Pose, PosedBody
from body_tracking.mesh.depth import DepthCamera, normals_at
from body_tracking.mesh.mesh_walk import SurfacePoints, neighbours, random_points, rematched, walk
from body_tracking.mesh.skinning import vertex_normals
from body_tracking.mesh.solver import FACING_CAMERA
from body_tracking.mesh.uncertainty import kinect_landmarks


@dataclass(frozen=True, slots=True)
class Configuration:
    """Weights and sizes of Jatesiktat (2018), section IV-C.

    Attributes:
        samples: N_s, sampled pixels of the depth image.
        sigma_p: standard deviation of positions, metres.
        sigma_n: standard deviation of unit normals.
        background, joints, front, limit, imu: the lambdas of eq. 4.
        silhouette: H_max, points on the model's outline.
        iterations: of Levenberg-Marquardt per image.
        damping: initial gamma.
        window: images in the moving average.
    """

    samples: int = 250
    sigma_p: float = 0.003
    sigma_n: float = 0.25
    background: float = 10.0
    joints: float = 25.0
    front: float = 0.25
    limit: float = 10000.0
    imu: float = 15.0
    silhouette: int = 150
    iterations: int = 20
    damping: float = 1000.0
    window: int = 3


_THREE: Final = ("spine1", "spine2", "spine3", "neck", "head")
_TWO: Final = tuple(f"{side}_{joint}" for joint in ("collar", "shoulder", "elbow", "wrist") for side in SIDES)
_LEGS: Final = ("hip", "knee", "ankle", "foot")
_BACKGROUND_JOINTS: Final = ("pelvis", *_THREE, *_TWO, "left_hip", "right_hip")
"""The 16 joints of eq. 7; the paper does not list them."""
_DENSE: Final = ("shoulder", "elbow", "wrist", "neck", "head")
"""Segments with three times as many candidates (section II-J)."""
_SETS, _CANDIDATES = 10, 250
_VOXEL: Final = 0.02
"""Metres: voxel size of the volume of eq. 12."""
_STEP: Final = 1e-6
"""Step of the numerical differentiation of the Jacobian."""
_DESCENTS: Final = 5000
"""Largest number of steps of the gradient descent of eq. 19, which converges slowly in metres."""
_NEAR_OUTLINE: Final = 5.0
"""Pixels from the outline, below which a pixel is near it."""
_PARTS: Final = (
    (0.3, (("SPINE_BASE", "SPINE_SHOULDER"), ("SHOULDER_LEFT", "SHOULDER_RIGHT"), ("HIP_LEFT", "HIP_RIGHT"))),
    (0.14, (("NECK", "HEAD"),)),
    *((0.12, ((f"SHOULDER_{side}", f"ELBOW_{side}"),)) for side in ("LEFT", "RIGHT")),
    *((0.16, ((f"ELBOW_{side}", f"WRIST_{side}"), (f"WRIST_{side}", f"HAND_{side}"))) for side in ("LEFT", "RIGHT")),
    (
        0.0,
        tuple(
            (f"{a}_{side}", f"{b}_{side}")
            for side in ("LEFT", "RIGHT")
            for a, b in (("HIP", "KNEE"), ("KNEE", "ANKLE"))
        ),
    ),
)
"""Share of the samples, and the bones, of each part of the body."""


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """Data of one depth image for the energy terms.

    Attributes:
        points: (n, 3) metres.
        normals: (n, 3) unit.
        camera: the image's camera.
        nearest: (height, width, 2) column and row of the nearest pixel of the silhouette.
        origin: (3,) metres, of the volume of eq. 12.
        behind: (a, b, c, 3) indices of the nearest voxel behind the measured surface.
    """

    points: FloatArray
    normals: FloatArray
    camera: Camera
    nearest: SingleArray
    origin: FloatArray
    behind: IntArray


class Fitted(NamedTuple):
    """Result of Levenberg-Marquardt.

    Attributes:
        theta: (37,) pose parameters.
        energy: eq. 4.
        iterations: number used.
    """

    theta: FloatArray
    energy: float
    iterations: int


class _Selected(NamedTuple):
    """Points of the background and front terms, selected again in each iteration."""

    outline: SurfacePoints
    targets: FloatArray | None
    """(H + 16, 2) pixels, held while the Jacobian is computed; None to look them up."""
    behind: FloatArray | None
    """(H, 3) metres, held in the same way."""


class JatesiktatFitter:
    """Fits poses of one person's body (Jatesiktat 2018, eq. 4 and 13-16; section II).

    Args:
        body: of the person.
        configuration: weights and sizes.
        rng: for the candidates.
    """

    def __init__(
        self, body: Body, configuration: Configuration | None = None, rng: np.random.Generator | None = None
    ) -> None:
        self.body, self.configuration = body, configuration or Configuration()
        model = body.model
        self._anatomy = Anatomy(model.joint_names, model.parents, model.frames)
        names = model.joint_names
        legs = [number for number, name in enumerate(names) if name.rpartition("_")[2] in _LEGS]
        strongest = model.bones[np.arange(len(model.vertices)), model.weights.argmax(axis=1)]
        # the paper: "from the hips and above"
        upper = model.faces[~np.isin(strongest[model.faces], legs).any(axis=1)]
        self._faces = np.ascontiguousarray(upper)
        self._across = neighbours(self._faces)
        dense = [number for number, name in enumerate(names) if name.rpartition("_")[2] in _DENSE]
        density = np.where(np.isin(strongest[self._faces[:, 0]], dense), 3.0, 1.0)
        chance = np.random.default_rng(0) if rng is None else rng
        self._candidates = [
            random_points(body.vertices, self._faces, density, _CANDIDATES, chance) for _ in range(_SETS)
        ]
        self._all = SurfacePoints(
            np.concatenate([each.faces for each in self._candidates]),
            np.concatenate([each.shares for each in self._candidates]),
        )
        self._moved = np.array([model.index(name) for name in (*_THREE, *_TWO)])
        self._axes = [np.eye(3)] * len(_THREE) + [self._across_bone(model.index(name)) for name in _TWO]
        self._background = np.array([model.index(name) for name in _BACKGROUND_JOINTS])
        self._wrists = {side: (model.index(f"{side}_elbow"), model.index(f"{side}_wrist")) for side in SIDES}
        edges = np.stack([self._faces[:, [0, 1]], self._faces[:, [1, 2]], self._faces[:, [2, 0]]], axis=1)
        rows = np.repeat(np.arange(len(self._faces)), 3)
        edges = edges.reshape(-1, 2)
        once = edges[:, 0] < edges[:, 1]
        self._edges, self._edge_faces = edges[once], rows[once]
        self._edge_corners = np.tile([[0, 1], [1, 2], [2, 0]], (len(self._faces), 1))[once]

    def _across_bone(self, joint: int) -> FloatArray:
        """(3, 2) two axes perpendicular to a bone at rest, without its roll (Jatesiktat 2018, section II-B)."""
        model = self.body.model
        children = np.flatnonzero(model.parents == joint)
        along = self.body.joints[children[0]] - self.body.joints[joint] if len(children) else -model.frames[joint][:, 2]
        return np.asarray(np.linalg.svd(along[None])[2][1:].T)

    # --- pose parameters

    def pose(self, theta: FloatArray) -> Pose:
        """The pose with parameters (37,): position and rotation of the first joint, then rotations of the others."""
        rotations = np.tile(np.eye(3), (len(self.body.joints), 1, 1))
        vectors = [theta[3:6]]
        start = 6
        for axes in self._axes:
            end = start + axes.shape[1]
            vectors.append(axes @ theta[start:end])
            start = end
        turned = so3.quat_to_matrix(so3.exp(np.array(vectors)))
        rotations[0] = FACING_CAMERA @ turned[0]
        rotations[self._moved] = turned[1:]
        return Pose(rotations, theta[:3] - self.body.joints[0])

    def kinect_start(self, joints: FloatArray) -> FloatArray:
        """(37,) parameters of the pose that replicates a Kinect's skeleton (Jatesiktat 2018, section II-G).

        Args:
            joints: (25, 3) metres in the optical frame; NaN where a joint is not tracked.
        """
        body, model = self.body, self.body.model
        up = joints[Joint.SPINE_SHOULDER] - joints[Joint.SPINE_BASE]
        left = (
            joints[Joint.HIP_LEFT]
            - joints[Joint.HIP_RIGHT]
            + joints[Joint.SHOULDER_LEFT]
            - joints[Joint.SHOULDER_RIGHT]
        )
        up = np.array([0.0, -1.0, 0.0]) if not np.isfinite(up).all() else up / np.linalg.norm(up)
        left = np.array([1.0, 0.0, 0.0]) if not np.isfinite(left).all() else left
        left = left - (left @ up) * up
        left /= np.linalg.norm(left)
        turned: dict[int, FloatArray] = {}
        root = np.column_stack([left, up, np.cross(left, up)])
        place = np.nan_to_num(joints[Joint.SPINE_BASE])
        vectors = [so3.rotation_vectors(FACING_CAMERA.T @ root)]
        kinect = {"neck": (Joint.NECK, Joint.HEAD)}
        for side in SIDES:
            own = {name: Joint[f"{name}_{side.upper()}"] for name in ("SHOULDER", "ELBOW", "WRIST")}
            kinect[f"{side}_collar"] = (Joint.SPINE_SHOULDER, own["SHOULDER"])
            kinect[f"{side}_shoulder"] = (own["SHOULDER"], own["ELBOW"])
            kinect[f"{side}_elbow"] = (own["ELBOW"], own["WRIST"])
        turned[0] = root
        for joint in range(1, len(body.joints)):
            name, parent = model.joint_names[joint], turned[int(model.parents[joint])]
            vector = np.zeros(3)
            ends = kinect.get(name)
            if ends is not None and np.isfinite(joints[list(ends)]).all():
                child = int(np.flatnonzero(model.parents == joint)[0])
                vector = _least_turn(
                    body.joints[child] - body.joints[joint], parent.T @ (joints[ends[1]] - joints[ends[0]])
                )
            turned[joint] = parent @ so3.quat_to_matrix(so3.exp(vector))
            vectors.append(vector)
        numbers = [axes.T @ vectors[joint] for axes, joint in zip(self._axes, self._moved.tolist(), strict=True)]
        return np.concatenate([place, vectors[0], *numbers])

    # --- data of an image

    def frame(self, view: DepthCamera, depth: SingleArray, mask: BoolArray, joints: FloatArray) -> Frame:
        """Samples of an image (Jatesiktat 2018, sections II-A and II-H), and the look-up tables of eq. 6, 7 and 12.

        Args:
            view: the depth camera.
            depth: (height, width) metres, 0 where missing.
            mask: (height, width) the silhouette.
            joints: (25, 3) of a Kinect's skeleton, metres.

        Raises:
            DepthError: another size than the camera's.
        """
        view.check(depth)
        seen = mask & (depth > 0.0)
        rows, columns = self._sampled(view, depth, seen, mask, joints)
        normals = normals_at(depth, view.rays, rows, columns, 5, 0.05)
        known = np.isfinite(normals).all(axis=1)
        rows, columns = rows[known], columns[known]
        z = depth[rows, columns].astype(np.float64)
        points = np.column_stack([view.rays[rows, columns] * z[:, None], z])
        _, labels = cv2.distanceTransformWithLabels(
            np.asarray(~mask, np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
        )
        inside = np.argwhere(mask)
        of_label = np.zeros((labels.max() + 1, 2), np.float32)
        of_label[labels[mask]] = inside[:, ::-1]
        origin, behind = _volume(view, depth, seen)
        return Frame(points, normals[known], view.camera, of_label[labels], origin, behind)

    def _sampled(
        self, view: DepthCamera, depth: SingleArray, seen: BoolArray, mask: BoolArray, joints: FloatArray
    ) -> tuple[IntArray, IntArray]:
        """Rows and columns of the samples: by part of the body, half of each near the outline."""
        rows, columns = np.nonzero(seen)
        rows, columns = rows[::2], columns[::2]
        z = depth[rows, columns].astype(np.float64)
        points = np.column_stack([view.rays[rows, columns] * z[:, None], z])
        away = np.stack([_distance(points, joints, bones) for _, bones in _PARTS])
        part = np.nan_to_num(away, nan=np.inf).argmin(axis=0)
        outline = cv2.distanceTransform(np.asarray(mask, np.uint8), cv2.DIST_L2, 3)[rows, columns] < _NEAR_OUTLINE
        chosen = []
        for number, (share, _) in enumerate(_PARTS):
            for near in (True, False):
                own = np.flatnonzero((part == number) & (outline == near))
                count = min(round(0.5 * share * self.configuration.samples), len(own))
                chosen.append(own[np.linspace(0, len(own) - 1, count).astype(np.intp)] if count else own[:0])
        which = np.concatenate(chosen)
        return rows[which], columns[which]

    # --- energy

    def residuals(
        self,
        theta: FloatArray,
        matches: SurfacePoints,
        frame: Frame,
        selected: _Selected,
        directions: Mapping[str, FloatArray],
    ) -> FloatArray:
        """Residual vector (Jatesiktat 2018, eq. 13-14) of the terms eq. 5-12; its squared norm is the energy (eq. 4).

        Args:
            theta: (37,) pose.
            matches: of the samples.
            frame: the image.
            selected: points of the background and front terms.
            directions: by side, the forearm's direction (3,) from an IMU.
        """
        c, posed = self.configuration, self.body.posed(self.pose(theta))
        faces, vertices = self._faces, posed.vertices
        # data (5)
        count = max(len(frame.points), 1)
        places = matches.places(vertices, faces) - frame.points
        normals = matches.normals(vertex_normals(vertices, faces), faces) - frame.normals
        found = [places.ravel() / (c.sigma_p * np.sqrt(count)), normals.ravel() / (c.sigma_n * np.sqrt(count))]
        # background (6), joints in the background (7)
        outline = selected.outline.places(vertices, faces)
        joints = posed.placed[self._background]
        pixels = frame.camera.project(np.concatenate([outline, joints]))
        targets = nearest_inside(frame, pixels) if selected.targets is None else selected.targets
        away = np.nan_to_num(pixels - targets)
        split = len(outline)
        found += [
            (np.sqrt(c.background / max(split, 1)) * away[:split]).ravel(),
            (np.sqrt(c.joints / len(joints)) * away[split:]).ravel(),
        ]
        # in front of the surface (12)
        behind = nearest_behind(frame, outline) if selected.behind is None else selected.behind
        front = np.nan_to_num(outline - behind)
        number = max(int((front != 0.0).any(axis=1).sum()), 1)
        found.append((np.sqrt(c.front / number) * front).ravel())
        # limits (8)
        anatomy, rotations = self._anatomy, self.pose(theta).rotations
        angles = anatomy.angles(rotations).values[self._moved]
        excess = np.maximum(angles - anatomy.high[self._moved], 0.0) + np.minimum(
            angles - anatomy.low[self._moved], 0.0
        )
        found.append((np.sqrt(c.limit / (len(theta) - 6)) * excess).ravel())
        # IMUs (9-11)
        for side, direction in directions.items():
            found.append(np.sqrt(c.imu) * (self._forearm(posed, side) - direction))
        return np.concatenate(found)

    def _forearm(self, posed: PosedBody, side: str) -> FloatArray:
        """(3,) pointing direction of a forearm (Jatesiktat 2018, eq. 10-11)."""
        elbow, wrist = self._wrists[side]
        along = posed.placed[wrist] - posed.placed[elbow]
        return np.asarray(along / np.linalg.norm(along))

    def _selected(self, posed: PosedBody) -> SurfacePoints:
        """Points with a normal perpendicular to the optical axis (Jatesiktat 2018, eq. 6): on edges between a vertex
        that faces the camera and one that does not, at most ``silhouette``.
        """
        facing = vertex_normals(posed.vertices, self._faces)[:, 2]
        first, second = facing[self._edges].T
        crossing = np.flatnonzero((first < 0.0) != (second < 0.0))
        most = self.configuration.silhouette
        if len(crossing) > most:
            crossing = crossing[np.linspace(0, len(crossing) - 1, most).astype(np.intp)]
        share = first[crossing] / (first[crossing] - second[crossing])
        weights = np.zeros((len(crossing), 3))
        at = np.arange(len(crossing))
        weights[at, self._edge_corners[crossing, 0]] = 1.0 - share
        weights[at, self._edge_corners[crossing, 1]] = share
        return SurfacePoints(self._edge_faces[crossing], weights[:, :2])

    # --- fit

    def fit(
        self, frame: Frame, starts: Sequence[FloatArray], directions: Mapping[str, FloatArray] | None = None
    ) -> Fitted:
        """Fit from all starts; returns the pose with the lowest energy (Jatesiktat 2018, section II-G).

        Args:
            frame: the image.
            starts: (37,) each: the last image's pose, and that of the Kinect's skeleton.
            directions: by side, the forearm's direction (3,) from an IMU.
        """
        return min((self._descend(frame, start, directions or {}) for start in starts), key=lambda each: each.energy)

    def _descend(self, frame: Frame, theta: FloatArray, directions: Mapping[str, FloatArray]) -> Fitted:
        """Levenberg-Marquardt over pose and correspondences (Jatesiktat 2018, eq. 15-16; section II-F)."""
        c = self.configuration
        damping, number = c.damping, 0
        nobody = SurfacePoints(np.zeros(len(frame.points), np.intp), np.full((len(frame.points), 2), 1.0 / 3.0))
        matches = self._rematched(theta, nobody, self._all, frame)
        energy = np.inf
        for number in range(1, c.iterations + 1):
            posed = self.body.posed(self.pose(theta))
            selected = _Selected(self._selected(posed), None, None)
            residuals = self.residuals(theta, matches, frame, selected, directions)
            energy = float(residuals @ residuals)
            by_pose, by_match = self._jacobian(theta, matches, frame, selected, directions, posed)
            improved = False
            while not improved and damping < 1e12:
                turn, shift = _step(by_pose, by_match, residuals, damping)
                moved = SurfacePoints(
                    *walk(self._faces, self._across, posed.vertices, matches.faces, matches.shares, shift)
                )
                trial = self.residuals(theta + turn, moved, frame, selected, directions)
                improved = float(trial @ trial) < energy
                damping *= 0.1 if improved else 10.0
            if not improved:
                break
            theta = theta + turn
            energy = float(trial @ trial)
            matches = self._rematched(theta, moved, self._candidates[number % _SETS], frame)
        return Fitted(theta, energy, number)

    def _rematched(
        self, theta: FloatArray, matches: SurfacePoints, candidates: SurfacePoints, frame: Frame
    ) -> SurfacePoints:
        """Correspondences searched again (Jatesiktat 2018, eq. 17; section II-J)."""
        vertices = self.body.posed(self.pose(theta)).vertices
        normals, c = vertex_normals(vertices, self._faces), self.configuration
        own = frame.points, frame.normals, matches.faces, matches.shares, candidates.faces, candidates.shares
        return SurfacePoints(
            *rematched(self._faces, self._across, vertices, normals, *own, 1.0 / c.sigma_p, 1.0 / c.sigma_n)
        )

    def _jacobian(
        self,
        theta: FloatArray,
        matches: SurfacePoints,
        frame: Frame,
        selected: _Selected,
        directions: Mapping[str, FloatArray],
        posed: PosedBody,
    ) -> tuple[FloatArray, FloatArray]:
        """Jacobians (K, 37) by the pose, numerical, and (n, 6, 2) of the data term by u and v, analytic."""
        outline = selected.outline.places(posed.vertices, self._faces)
        pixels = frame.camera.project(np.concatenate([outline, posed.placed[self._background]]))
        targets, behind = nearest_inside(frame, pixels), nearest_behind(frame, outline)
        # points inside have neither a residual nor a derivative
        targets = np.where((targets == pixels).all(axis=1, keepdims=True), np.nan, targets)
        behind = np.where((behind == outline).all(axis=1, keepdims=True), np.nan, behind)
        held = _Selected(selected.outline, targets, behind)
        ends = [
            [self.residuals(theta + sign * step, matches, frame, held, directions) for sign in (1.0, -1.0)]
            for step in _STEP * np.eye(len(theta))
        ]
        by_pose = np.array([(plus - minus) / (2.0 * _STEP) for plus, minus in ends]).T
        c, scale = self.configuration, np.sqrt(max(len(frame.points), 1))
        corners = self._faces[matches.faces]
        sides = posed.vertices[corners]
        places = np.stack([sides[:, 0] - sides[:, 2], sides[:, 1] - sides[:, 2]], axis=2) / (c.sigma_p * scale)
        own = vertex_normals(posed.vertices, self._faces)[corners]
        blended = np.einsum("nc,nca->na", matches.weights(), own)
        size = np.maximum(np.linalg.norm(blended, axis=1), 1e-9)
        unit = blended / size[:, None]
        raw = np.stack([own[:, 0] - own[:, 2], own[:, 1] - own[:, 2]], axis=2) / size[:, None, None]
        normals = (raw - unit[:, :, None] * np.einsum("na,nak->nk", unit, raw)[:, None]) / (c.sigma_n * scale)
        return by_pose, np.concatenate([places, normals], axis=1)


def _step(
    by_pose: FloatArray, by_match: FloatArray, residuals: FloatArray, damping: float
) -> tuple[FloatArray, FloatArray]:
    """Steps of the pose (P,) and of u and v (n, 2) (Jatesiktat 2018, eq. 16); eliminates the correspondences first."""
    n = len(by_match)
    # each point has rows for its position, then for its normal
    places, normals = by_pose[: 3 * n].reshape(n, 3, -1), by_pose[3 * n : 6 * n].reshape(n, 3, -1)
    rows = np.concatenate([places, normals], axis=1)
    own = np.concatenate([residuals[: 3 * n].reshape(n, 3), residuals[3 * n : 6 * n].reshape(n, 3)], axis=1)
    own_block = np.linalg.inv(by_match.mT @ by_match + damping * np.eye(2))
    mixed = rows.mT @ by_match
    pull = np.einsum("nak,na->nk", by_match, own)
    gain = mixed @ own_block
    system = by_pose.T @ by_pose + damping * np.eye(by_pose.shape[1]) - np.einsum("npk,nqk->pq", gain, mixed)
    turn = np.linalg.solve(system, -by_pose.T @ residuals + np.einsum("npk,nk->p", gain, pull))
    shift = -np.einsum("nkl,nl->nk", own_block, pull + np.einsum("npk,p->nk", mixed, turn))
    return turn, shift


def rough_shape(model: BodyModel, joints: FloatArray) -> FloatArray:
    """(S,) shape components with segment lengths near those of a Kinect's skeleton (Jatesiktat 2018, section III-A).

    Gradient descent from the mean shape (eq. 19) on the squared differences of lengths (eq. 18), in metres.

    Args:
        model: shape space.
        joints: (25, 3) metres, all tracked.
    """
    marks = kinect_landmarks(model.body())
    wanted, shape, rate = _lengths(joints, np.zeros((*joints.shape, 0)))[0], np.zeros(model.vertex_shapes.shape[2]), 1.0

    def at(beta: FloatArray) -> tuple[float, FloatArray]:
        lengths, gradients = _lengths(marks.places + marks.shapes @ beta, marks.shapes)
        off = lengths - wanted
        return float(off @ off), 2.0 * off @ gradients

    error, gradient = at(shape)
    for _ in range(_DESCENTS):
        trial = shape - rate * gradient
        less, next_gradient = at(trial)
        if less < error:
            shape, error, gradient = trial, less, next_gradient
        else:
            rate *= 0.5
            if rate < 0.01:
                break
    return shape


def _lengths(joints: FloatArray, shapes: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Lengths (7,) of eq. 18, metres, and derivatives (7, S); shapes (25, 3, S) are the joints' derivatives."""

    def between(*ends: tuple[str, str]) -> tuple[float, FloatArray]:
        """Distance of two points, each the mean of a left and a right joint; averaged over several pairs."""
        found, slopes = [], []
        for one, other in ends:
            first, second = ([joint for joint in Joint if joint.name in _both(name)] for name in (one, other))
            way = joints[first].mean(axis=0) - joints[second].mean(axis=0)
            size = float(np.linalg.norm(way))
            found.append(size)
            slopes.append(way / size @ (shapes[first].mean(axis=0) - shapes[second].mean(axis=0)))
        return float(np.mean(found)), np.asarray(np.mean(slopes, axis=0))

    def sides(one: str, other: str) -> tuple[float, FloatArray]:
        return between(*((f"{one}_{side}", f"{other}_{side}") for side in ("LEFT", "RIGHT")))

    def total(*parts: tuple[float, FloatArray]) -> tuple[float, FloatArray]:
        return sum(part[0] for part in parts), np.asarray(sum(part[1] for part in parts))

    upper_arm, forearm, hand = sides("SHOULDER", "ELBOW"), sides("ELBOW", "WRIST"), sides("WRIST", "HAND")
    rows = [
        upper_arm,
        forearm,
        total(sides("HIP", "KNEE"), sides("KNEE", "ANKLE")),
        between(("HIP", "SHOULDER")),
        between(("SHOULDER_LEFT", "SHOULDER_RIGHT")),
        between(("ANKLE", "HEAD")),
        total(upper_arm, forearm, hand),
    ]
    return np.array([row[0] for row in rows]), np.array([row[1] for row in rows])


def _both(name: str) -> tuple[str, ...]:
    return name, f"{name}_LEFT", f"{name}_RIGHT"


def moving_average(thetas: FloatArray, window: int = 3) -> FloatArray:
    """(n, P) centred means of consecutive poses (Jatesiktat 2018, section IV-C), with a delay of half a window.

    The window is shorter at the ends.
    """
    half = window // 2
    rows = [thetas[max(k - half, 0) : k + half + 1].mean(axis=0) for k in range(len(thetas))]
    return np.array(rows).reshape(thetas.shape)


def nearest_inside(frame: Frame, pixels: FloatArray) -> FloatArray:
    """(n, 2) nearest pixel of the silhouette: D_2D of Jatesiktat (2018), eq. 6; points inside it stay."""
    height, width = frame.nearest.shape[:2]
    at = np.nan_to_num(np.round(pixels)).astype(np.intp)
    columns, rows = at[:, 0].clip(0, width - 1), at[:, 1].clip(0, height - 1)
    found = frame.nearest[rows, columns].astype(np.float64)
    inside = (found == np.column_stack([columns, rows])).all(axis=1) & (at == np.column_stack([columns, rows])).all(
        axis=1
    )
    return np.where(inside[:, None], pixels, found)


def nearest_behind(frame: Frame, points: FloatArray) -> FloatArray:
    """(n, 3) nearest voxel behind the measured surface: D_3D of Jatesiktat (2018), eq. 12.

    Points behind the surface, outside the volume or outside the silhouette stay.
    """
    at = np.floor((points - frame.origin) / _VOXEL)
    inside = np.all(at >= 0, axis=1) & np.all(at < frame.behind.shape[:3], axis=1)
    at = np.where(inside.reshape(-1, 1), at, 0).astype(np.intp)
    target = frame.behind[at[:, 0], at[:, 1], at[:, 2]]
    moved = inside & (target != at).any(axis=1)
    pixels = frame.camera.project(points)
    moved &= np.all(nearest_inside(frame, pixels) == pixels, axis=1)
    return np.where(moved.reshape(-1, 1), frame.origin + _VOXEL * (target + 0.5), points)


def _volume(view: DepthCamera, depth: SingleArray, seen: BoolArray) -> tuple[FloatArray, IntArray]:
    """Volume around the person: its origin, and for each voxel the nearest voxel behind the surface."""
    z = depth[seen].astype(np.float64)
    points = np.column_stack([view.rays[seen] * z[:, None], z])
    low, high = points.min(axis=0) - 0.2, points.max(axis=0) + 0.4
    counts = np.ceil((high - low) / _VOXEL).astype(np.intp)
    centres = low + _VOXEL * (np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1) + 0.5)
    pixels = np.round(view.camera.project(centres.reshape(-1, 3)))
    height, width = depth.shape
    known = np.isfinite(pixels).all(axis=1)
    known &= (pixels >= 0).all(axis=1) & (pixels[:, 0] < width) & (pixels[:, 1] < height)
    columns, rows = np.where(known[:, None], pixels, 0).astype(np.intp).T
    behind = known & seen[rows, columns] & (centres.reshape(-1, 3)[:, 2] >= depth[rows, columns])
    free = ~behind.reshape(tuple(counts))
    nearest = distance_transform_edt(free, return_distances=False, return_indices=True)
    return low, np.moveaxis(nearest, 0, -1)


def _least_turn(one: FloatArray, other: FloatArray) -> FloatArray:
    """(3,) the shortest rotation vector from one direction to another."""
    axis = np.cross(one, other)
    size = float(np.linalg.norm(axis))
    return np.asarray(np.arctan2(size, float(one @ other)) / max(size, 1e-12) * axis)


def _distance(points: FloatArray, joints: FloatArray, bones: Sequence[tuple[str, str]]) -> FloatArray:
    """(n,) distance from the nearest bone, metres; NaN if no bone is tracked."""
    found = np.full(len(points), np.nan)
    for first, second in bones:
        a, along = joints[Joint[first]], joints[Joint[second]] - joints[Joint[first]]
        share = np.clip((points - a) @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
        found = np.fmin(found, np.linalg.norm(points - a - share[:, None] * along, axis=1))
    return found

"""Levenberg-Marquardt fit of a pose to one depth image.

Differences from Jatesiktat (2018), II-E and II-F: correspondences are searched again in every step instead of being
variables, residuals are robust (Geman and McClure 1985) with a decreasing scale, and the energy is a negative
log-likelihood, so that its curvature is the inverse covariance of the pose.

Over 500 lines: the fit, its terms and its starts share the body and its anatomy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray
from body_tracking.mesh import energy
from body_tracking.mesh.anatomy import SIDES, Anatomy
from body_tracking.mesh.body_model import Body, Pose, PosedBody
from body_tracking.mesh.energy import Matches, Observation, Pulls
from body_tracking.mesh.skinning import lever_arms, vertex_normals

SCALES: Final = (0.05, 0.05)
"""Metres: robust scale of each step from a predicted pose."""
WIDE: Final = (0.2, 0.2, 0.2, 0.06, 0.06, 0.03, 0.03)
"""Metres: robust scale of each step from a rough start."""
MATCHED: Final = 0.06
"""Metres: largest distance of a measured point from the body that explains it: clothes, shape and some noise."""
AGAIN: Final = 0.03
"""Factor on the information of ordinary postures for a hidden limb with a prediction, which includes that information
from all previous images: counted in full 30 times a second, it lifted a hidden elbow by 100 mm in half a second. A
visible limb away from its prediction needs it in full: it brings the limb back from behind the trunk."""
_HAND: Final = 0.1
"""Metres from a wrist to the middle of the hand, plus the error of an elbow's surface."""
_LOOSE: Final = 8
"""Least number of unexplained points that may be a hand."""
_REACHED: Final = 0.05
"""Metres: standard deviation of a hand's position at such points."""
_REACHING: Final = (0.2, 0.1, 0.06)
"""Metres: robust scale of each step of a fit towards such points."""
_COLLARS: Final = 0.2
"""Factor on the information of ordinary postures for collar bones with a prediction: in full, ordinary postures removed
three quarters of a shrug."""
_HIDDEN: Final = 0.35
"""Share of a limb's vertices behind something else, above which the limb is hidden: of an arm, forearm and hand."""
FACING_CAMERA: Final[FloatArray] = np.diag([1.0, -1.0, -1.0])
"""Orientation of the first joint of a person who stands upright and faces the camera."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Standard deviations of the energy terms.

    Attributes:
        surface: distance between the body and measured points, including clothes and shape, metres.
        patches: number of independent patches among the measured points; clothes and shape err by whole patches.
        silhouette: distance of the body outside the silhouette, metres.
        front: distance of the body in front of the measured surface, metres. A small value pushes an arm that is
            measured elsewhere into the trunk, where it stays.
        limit: excess beyond a soft limit, radians.
        damping: initial damping, as a share of the information's diagonal.
        unexplained: largest sum, in a fit that is not lost, of the share of unexplained points and the share of visible
            vertices outside the silhouette or in front of the surface. A body that is too large has many such vertices
            and explains all points; separate bounds lost such people and kept more false fits.
    """

    surface: float = 0.012
    patches: float = 40.0
    silhouette: float = 0.04
    front: float = 0.08
    limit: float = 0.05
    damping: float = 1e-3
    unexplained: float = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Prediction:
    """A pose expected before the image is processed.

    Attributes:
        pose: expected pose.
        shift: standard deviation of the first joint's position along each axis, metres.
        turns: (J, 3) standard deviations about the axes of the segments' frames, radians.
        hidden: (J,) joints of limbs hidden by something other than the person; None for no joint.
    """

    pose: Pose
    shift: float
    turns: FloatArray
    hidden: BoolArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A segment's orientation from an inertial sensor.

    Attributes:
        joint: the segment's joint.
        rotation: (3, 3) its anatomical frame, as columns in the camera's axes.
        stddev: (3,) radians about the axes of that frame; infinite where an axis is unknown.
    """

    joint: int
    rotation: FloatArray
    stddev: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class JointPoints:
    """Joint positions from another sensor, e.g. a Kinect's skeleton.

    Attributes:
        joints: (n,) indices in the body model.
        points: (n, 3) metres in the camera's frame.
        stddev: per axis, metres.
    """

    joints: IntArray
    points: FloatArray
    stddev: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose and its goodness of fit.

    Attributes:
        pose: best pose.
        posed: the body in this pose.
        frames: (J, 3, 3) anatomical frames of its segments, columns in the camera's axes.
        energy: half the sum of the squared, robust residuals.
        information: (3 + 3 J, 3 + 3 J) inverse covariance of the pose's change, see :mod:`body_tracking.mesh.energy`.
        pulled: part of the information by vertices outside of the silhouette or in front of the measured surface.
        matches: correspondences of the measured points.
        weights: (n,) of the measured points in the information, 1/m^2.
        matched: share of measured points explained by the body.
        violations: number of vertices outside the silhouette or in front of the surface, over that of vertices facing
            the camera.
        rms: root mean square distance of the explained points from the planes of their matches, metres.
        lost: whether the fit is rejected.
    """

    pose: Pose
    posed: PosedBody
    frames: FloatArray
    energy: float
    information: FloatArray
    pulled: FloatArray
    matches: Matches
    weights: FloatArray
    matched: float
    violations: float
    rms: float
    lost: bool


def facing(course: FloatArray) -> FloatArray:
    """(3, 3) rotation of the first joint of an upright person who faces a direction.

    Args:
        course: (3,) in the camera's frame, whose y axis is down.
    """
    turn = np.arctan2(-course[0], -course[2])
    return so3.quat_to_matrix(so3.exp(np.array([0.0, turn, 0.0]))) @ FACING_CAMERA


def is_along(pose: Pose, course: FloatArray) -> bool:
    """Whether a body faces within 60 degrees of a direction (3,) in the horizontal plane."""
    forward = pose.rotations[0, ::2, 2]
    return bool(forward @ course[::2] > 0.5 * np.linalg.norm(forward) * np.linalg.norm(course[::2]))


class MeshFitter:
    """Fits poses of one person's body.

    Args:
        body: of the person.
        settings: standard deviations of the terms.

    Attributes:
        body: of the person.
        anatomy: joint angles of the body model.
        ancestors: (J, J) whether a rotation of the second joint's segment moves the first joint's.
    """

    def __init__(self, body: Body, settings: Settings | None = None) -> None:
        self.body = body
        self.settings = settings or Settings()
        model = body.model
        self.anatomy = Anatomy(model.joint_names, model.parents, model.frames)
        self._starts, self._around = energy.faces_around(model.faces, len(model.vertices))
        joints = len(model.parents)
        self.ancestors: BoolArray = np.eye(joints, dtype=np.bool_)
        for joint in range(1, joints):
            self.ancestors[joint] |= self.ancestors[model.parents[joint]]
        self._collars: BoolArray = np.array([name.endswith("_collar") for name in model.joint_names])
        strongest = model.bones[np.arange(len(model.vertices)), model.weights.argmax(axis=1)]
        below = self.ancestors[strongest].astype(np.float64)
        self._below = below / np.maximum(below.sum(axis=0), 1.0)
        self._arms = [
            model.index(f"{side}_{joint}") for side in SIDES for joint in ("collar", "shoulder", "elbow", "wrist")
        ]

    def neutral(self, place: FloatArray, elevation: float = 0.0, flexion: float = 0.0) -> Pose:
        """Pose of a person who stands upright and faces the camera.

        Args:
            place: (3,) position of the first joint in the camera's frame, metres.
            elevation: of both arms sideways, radians; 0 for hanging arms.
            flexion: of both elbows, radians.
        """
        anatomy = self.anatomy
        turned = np.tile(np.eye(3), (len(self.body.joints), 1, 1))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            for joint, vector in (("shoulder", [sign * elevation, 0.0, 0.0]), ("elbow", [0.0, -flexion, 0.0])):
                turned[self.body.model.index(f"{side}_{joint}")] = so3.quat_to_matrix(so3.exp(np.array(vector)))
        rotations = anatomy.rotations(turned)
        rotations[0] = FACING_CAMERA
        return Pose(rotations, place - self.body.joints[0])

    def with_hanging_arms(self, pose: Pose) -> Pose:
        """The pose with the arms as in ordinary standing."""
        rotations = pose.rotations.copy()
        rotations[self._arms] = self.neutral(np.zeros(3), 0.1, 0.3).rotations[self._arms]
        return Pose(rotations, pose.translation)

    def unmatched(self, observation: Observation, fit: Fit) -> dict[str, FloatArray]:
        """By side, unexplained points (n, 3) within an arm's reach, metres.

        A side with too few points for a hand is omitted.
        """
        offsets = fit.matches.places - observation.points
        loose = observation.points[(offsets * offsets).sum(axis=1) > MATCHED**2]
        found = {}
        for side in SIDES:
            shoulder, elbow, wrist = self._arm(side)
            reach = np.linalg.norm(np.diff(self.body.joints[[shoulder, elbow, wrist]], axis=0), axis=1).sum() + _HAND
            near = loose[np.linalg.norm(loose - fit.posed.placed[shoulder], axis=1) < reach]
            if len(near) >= _LOOSE:
                found[side] = near
        return found

    def towards_unmatched(self, observation: Observation, fit: Fit) -> list[Pose]:
        """Poses with one hand at unexplained points; none if there are too few."""
        found = []
        for side, near in self.unmatched(observation, fit).items():
            shoulder, _, wrist = self._arm(side)
            away = np.linalg.norm(near - fit.posed.placed[shoulder], axis=1)
            hand = near[away >= np.percentile(away, 80.0)].mean(axis=0)
            targets = JointPoints(np.array([wrist]), hand[None], _REACHED)
            start = self.reaching(fit.pose, side, hand)
            found.append(self.fit(observation, start, joints=targets, scales=_REACHING).pose)
        return found

    def reaching(self, pose: Pose, side: str, place: FloatArray) -> Pose:
        """The pose with a wrist at a position (3,) in the camera's frame, or as near as the arm reaches.

        The distance determines the elbow's flexion; the shoulder makes the smallest rotation.
        """
        body, (shoulder, elbow, wrist) = self.body, self._arm(side)
        upper, fore = np.linalg.norm(np.diff(body.joints[[shoulder, elbow, wrist]], axis=0), axis=1)
        centre = body.posed(pose).placed[shoulder]
        distance = float(np.clip(np.linalg.norm(place - centre), abs(upper - fore) + 0.02, upper + fore - 0.005))
        # law of cosines; 0 is a straight elbow
        flexion = np.pi - np.arccos((upper**2 + fore**2 - distance**2) / (2.0 * upper * fore))
        turned = np.tile(np.eye(3), (len(body.joints), 1, 1))
        turned[elbow] = so3.quat_to_matrix(so3.exp(np.array([0.0, -flexion, 0.0])))
        rotations = pose.rotations.copy()
        rotations[elbow] = self.anatomy.rotations(turned)[elbow]
        bent = body.posed(Pose(rotations, pose.translation))
        one, other = bent.placed[wrist] - centre, place - centre
        axis = np.cross(one, other)
        size = float(np.linalg.norm(axis))
        least = so3.quat_to_matrix(so3.exp(np.arctan2(size, one @ other) / max(size, 1e-9) * axis))
        parent = bent.turned[body.model.parents[shoulder]]
        rotations[shoulder] = parent.T @ least @ bent.turned[shoulder]
        return Pose(rotations, pose.translation)

    def _arm(self, side: str) -> tuple[int, int, int]:
        shoulder, elbow, wrist = (self.body.model.index(f"{side}_{joint}") for joint in ("shoulder", "elbow", "wrist"))
        return shoulder, elbow, wrist

    def hidden(self, observation: Observation, vertices: FloatArray) -> BoolArray:
        """(J,) joints of limbs mostly hidden behind something other than the person.

        Args:
            observation: of the person.
            vertices: (N, 3) predicted, metres.
        """
        behind = energy.behind_others(
            vertices, observation.camera.project(vertices), observation.depth, observation.mask, energy.MARGIN
        )
        return np.asarray(behind @ self._below > _HIDDEN)

    def search(
        self, observation: Observation, orientations: Sequence[Orientation] = (), course: FloatArray | None = None
    ) -> Fit:
        """The best fit from several starts, for a person who stands somewhere in view.

        Args:
            observation: of the person.
            orientations: of inertial sensors.
            course: (3,) walking direction, any length; None for a person who faces the camera.
        """
        head = observation.points[:, 1].min()
        middle = np.median(observation.points, axis=0)
        top = self.body.vertices[:, 1].max() - self.body.joints[0, 1]
        place = np.array([middle[0], head + top, middle[2] + 0.1])
        fits = []
        for elevation, flexion in ((0.2, 0.2), (0.8, 0.3), (1.5, 0.1), (0.3, 1.4)):
            start = self.neutral(place, elevation, flexion)
            if course is not None:
                start.rotations[0] = facing(course)
            fits.append(self.fit(observation, start, orientations=orientations, scales=WIDE))
        best = min(fits, key=lambda fit: (fit.lost, fit.energy))
        return self.fit(observation, best.pose, orientations=orientations) if best.lost else best

    def fit(
        self,
        observation: Observation,
        start: Pose,
        prediction: Prediction | None = None,
        orientations: Sequence[Orientation] = (),
        joints: JointPoints | None = None,
        scales: Sequence[float] = SCALES,
    ) -> Fit:
        """Fit a pose.

        Args:
            observation: of the person.
            start: initial pose.
            prediction: expected pose; without one, only ordinary postures constrain hidden joints.
            orientations: of inertial sensors.
            joints: joint positions from another sensor's skeleton.
            scales: robust scale of each step, metres.
        """
        terms = (prediction, orientations, joints)
        pose, damping = start, self.settings.damping
        current = self.evaluate(observation, pose, scales[0], *terms)
        for number, scale in enumerate(scales):
            if number and scale != scales[number - 1]:
                current = self.evaluate(observation, current.fit.pose, scale, *terms)
            step = current.step(damping)
            trial = self.evaluate(observation, self.moved(current.fit.pose, step), scale, *terms)
            if trial.fit.energy < current.fit.energy:
                current, damping = trial, 0.3 * damping
            else:
                damping *= 30.0
        return current.fit

    def moved(self, pose: Pose, step: FloatArray) -> Pose:
        """The pose after a step (3 + 3 J,): shift of the first joint, rotations about the axes of the segments."""
        turns = np.einsum("jab,jb->ja", self.body.model.frames, step[3:].reshape(-1, 3))
        return Pose(pose.rotations @ so3.quat_to_matrix(so3.exp(turns)), pose.translation + step[:3])

    def evaluate(
        self,
        observation: Observation,
        pose: Pose,
        scale: float,
        prediction: Prediction | None = None,
        orientations: Sequence[Orientation] = (),
        joints: JointPoints | None = None,
    ) -> Evaluation:
        """The energy (Jatesiktat 2018, eq. 4 and 5) at a pose, with its derivatives.

        Arguments as in :meth:`fit`, with one robust scale, metres.
        """
        settings, body, model = self.settings, self.body, self.body.model
        posed = body.posed(pose)
        frames = posed.turned @ model.frames
        size = 3 + 3 * len(frames)
        system = _System(frames, np.zeros((size, size)), np.zeros(size))
        normals = vertex_normals(posed.vertices, model.faces)
        matches = energy.match(
            *(observation.points, observation.normals, posed.vertices, normals, model.faces),
            *(self._starts, self._around, max(0.05, 0.5 * scale)),
        )
        # data (5)
        share = settings.patches / max(len(observation.points), 1) / settings.surface**2
        offsets = matches.places - observation.points
        distances = np.sqrt((offsets * offsets).sum(axis=1))
        agrees = np.where(observation.normals.any(axis=1), np.clip(matches.agreements, 0.0, 1.0), 0.5)
        robust, cost = _robust(distances, scale)
        weights = share * agrees * robust
        arms = lever_arms(
            *(matches.corners, matches.shares, posed.rest, model.bones, model.weights, model.parents),
            *(body.joints, posed.turned, posed.placed),
        )
        planes = (offsets * matches.normals).sum(axis=1)
        system.add(arms, matches.normals, planes, weights)
        # a point whose match faces another way costs as much as a distant one
        total = share * float((agrees * cost + (1.0 - agrees) * scale**2).sum())
        # background (6) and in front of the measured surface (12)
        fx, fy = float(observation.camera.matrix[0, 0]), float(observation.camera.matrix[1, 1])
        pulls = energy.find_pulls(
            posed.vertices,
            observation.camera.project(posed.vertices),
            observation.depth,
            observation.mask,
            observation.outside,
            observation.slope,
            fx,
            fy,
            energy.MARGIN,
        )
        facing = max(int(((normals * posed.vertices).sum(axis=1) < 0.0).sum()), 1)
        robust, cost = _robust(pulls.residuals, 2.0 * scale)
        each = settings.patches / facing / np.where(pulls.kinds == 0, settings.silhouette, settings.front) ** 2
        pull_weights = each * robust
        pulled = system.information.copy()
        if len(pulls.vertices):
            own = pulls.vertices[:, None]
            arms = lever_arms(
                *(own, np.ones((len(own), 1)), posed.rest, model.bones, model.weights, model.parents),
                *(body.joints, posed.turned, posed.placed),
            )
            system.add(arms, pulls.directions, pulls.residuals, pull_weights)
            total += float((each * cost).sum())
        pulled = system.information - pulled
        total += self._add_angles(system, pose, None if prediction is None else prediction.hidden)
        if prediction is not None:
            total += self._add_prediction(system, pose, prediction)
        for orientation in orientations:
            total += self._add_orientation(system, orientation)
        if joints is not None:
            total += self._add_joints(system, posed, joints)
        near = (distances < MATCHED) & (agrees > 0.3)
        matched = float(near.mean()) if len(near) else 0.0
        violations = len(pulls.vertices) / facing
        information = system.information
        information += np.tril(information, -1).T
        pulled += np.tril(pulled, -1).T
        fit = Fit(
            *(pose, posed, frames, 0.5 * total, information, pulled, matches, weights, matched, violations),
            rms=float(np.sqrt((planes[near] ** 2).mean())) if near.any() else float("inf"),
            lost=1.0 - matched + violations > settings.unexplained,
        )
        return Evaluation(fit, system.gradient, pulls, pull_weights)

    def _add_angles(self, system: _System, pose: Pose, hidden: BoolArray | None) -> float:
        """Limits (Jatesiktat 2018, eq. 8) and ordinary postures, weighted less for ``hidden`` joints (J,)."""
        anatomy = self.anatomy
        angles = anatomy.angles(pose.rotations)
        excess = np.maximum(angles.values - anatomy.high, 0.0) + np.minimum(angles.values - anatomy.low, 0.0)
        limit = np.where(excess != 0.0, self.settings.limit**-2.0, 0.0)
        posture = anatomy.stddev**-2.0
        if hidden is not None:
            posture = np.where(
                hidden[:, None], AGAIN * posture, np.where(self._collars[:, None], _COLLARS * posture, posture)
            )
        off = angles.values - anatomy.mean
        pull = np.where(excess != 0.0, limit * excess, 0.0) + posture * off
        system.add_turns(angles.gradients, limit + posture, pull)
        return float((limit * excess * excess + posture * off * off).sum())

    def _add_prediction(self, system: _System, pose: Pose, prediction: Prediction) -> float:
        """The predicted pose as a prior."""
        between = so3.rotation_vectors(prediction.pose.rotations.mT @ pose.rotations)
        between = np.einsum("jba,jb->ja", self.body.model.frames, between)
        weights = prediction.turns**-2.0
        system.add_turns(so3.right_jacobian_inverse(between), weights, weights * between)
        shift = pose.translation - prediction.pose.translation
        weight = prediction.shift**-2.0
        system.information[[0, 1, 2], [0, 1, 2]] += weight
        system.gradient[:3] += weight * shift
        return float((weights * between * between).sum() + weight * (shift @ shift))

    def _add_orientation(self, system: _System, orientation: Orientation) -> float:
        """Inertial sensors (Jatesiktat 2018, eq. 9-11), with whole orientations."""
        frame = system.frames[orientation.joint]
        off = so3.rotation_vectors(orientation.rotation.T @ frame)
        rows = np.zeros((3, len(system.gradient)))
        for joint in np.flatnonzero(self.ancestors[orientation.joint]):
            rows[:, 3 + 3 * joint : 6 + 3 * joint] = frame.T @ system.frames[joint]
        rows = so3.right_jacobian_inverse(off) @ rows
        return system.add_rows(rows, off, orientation.stddev**-2.0)

    def _add_joints(self, system: _System, posed: PosedBody, joints: JointPoints) -> float:
        """Joint positions from another sensor's skeleton."""
        arms = posed.placed[joints.joints][:, None] - posed.placed[None]
        arms = np.where(self.ancestors[joints.joints][..., None], arms, 0.0)
        offsets = posed.placed[joints.joints] - joints.points
        weights = np.full(len(arms), joints.stddev**-2.0)
        for axis in range(3):
            direction = np.zeros_like(offsets)
            direction[:, axis] = 1.0
            # contiguous: the type compiled ahead
            system.add(arms, direction, offsets[:, axis].copy(), weights)
        return float((weights[:, None] * offsets * offsets).sum())


@dataclass(slots=True, eq=False)
class _System:
    """Accumulated normal equations; only the information's lower triangle is used."""

    frames: FloatArray
    information: FloatArray
    gradient: FloatArray

    def add(self, arms: FloatArray, directions: FloatArray, residuals: FloatArray, weights: FloatArray) -> None:
        energy.accumulate(arms, self.frames, directions, residuals, weights, self.information, self.gradient)

    def add_rows(self, rows: FloatArray, residuals: FloatArray, weights: FloatArray) -> float:
        self.information += np.tril((rows.T * weights) @ rows)
        self.gradient += rows.T @ (weights * residuals)
        return float((weights * residuals * residuals).sum())

    def add_turns(self, gradients: FloatArray, weights: FloatArray, pull: FloatArray) -> None:
        """Add residuals (J, 3) of each joint's own rotation, with their gradients (J, 3, 3)."""
        blocks = np.tril(np.einsum("jba,jb,jbc->jac", gradients, weights, gradients))
        at = 3 + np.arange(3 * len(blocks)).reshape(-1, 3)
        self.information[at[:, :, None], at[:, None, :]] += blocks
        self.gradient[3:] += np.einsum("jba,jb->ja", gradients, pull).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """The fit of a pose before a step.

    Attributes:
        fit: of the pose.
        gradient: (3 + 3 J,) of the energy by the pose's change.
        pulls: vertices outside the silhouette or in front of the measured surface.
        pull_weights: (m,) of ``pulls`` in the information, 1/m^2.
    """

    fit: Fit
    gradient: FloatArray
    pulls: Pulls
    pull_weights: FloatArray

    def step(self, damping: float) -> FloatArray:
        """Levenberg-Marquardt step (Jatesiktat 2018, eq. 15-16; section II-F), scaled by the diagonal (Marquardt 1963).

        The largest rotation is limited to half a radian.
        """
        information = self.fit.information.copy()
        diagonal = np.arange(len(information))
        information[diagonal, diagonal] *= 1.0 + damping
        information[diagonal, diagonal] += 1e-6  # without any match, the first joint's position is undetermined
        step = np.linalg.solve(information, -self.gradient)
        largest = float(np.abs(step[3:]).max())
        result: FloatArray = np.asarray(step * min(1.0, 0.5 / max(largest, 1e-9)), dtype=np.float64)
        return result


def _robust(distances: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Weights and costs (square metres) of distances (metres) by the function of Geman and McClure (1985)."""
    share = 1.0 / (1.0 + np.square(distances / scale))
    return share * share, np.square(distances) * share

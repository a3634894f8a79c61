"""Fit of a pose to one depth image by Levenberg-Marquardt.

Jatesiktat (2018), II-E and II-F, with these differences: correspondences are searched again in every step instead of
being variables of their own, residuals are robust (Geman and McClure 1985) with a scale that falls from step to step,
and the energy is a negative log-likelihood, so that its curvature is the inverse covariance of the pose.

Over 500 lines: a fit, the terms that it adds up, and where it starts share the body and its anatomy.
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
from body_tracking.mesh.energy import Matches, Observation
from body_tracking.mesh.skinning import lever_arms, vertex_normals

SCALES: Final = (0.05, 0.05)
"""Metres: robust scale of each step where the person was where they were expected."""
WIDE: Final = (0.2, 0.2, 0.2, 0.06, 0.06, 0.03, 0.03)
"""Metres: the same from a rough start."""
MATCHED: Final = 0.06
"""Metres within which a measured point belongs to the body: clothes, shape and a few times the noise."""
AGAIN: Final = 0.03
"""Share of the information of ordinary postures that counts for a hidden limb beside a prediction, which has that of
all images before in it: counted in full again 30 times a second, they lifted a hidden elbow by 100 mm in half a second.
A limb that is seen elsewhere than expected needs them in full: they bring it back from behind the trunk."""
_HAND: Final = 0.1
"""Metres from a wrist to the middle of the hand, and what an elbow's surface may be off by."""
_LOOSE: Final = 8
"""Least points that may be a hand."""
_REACHED: Final = 0.05
"""Metres: standard deviation of a hand's place at such points."""
_REACHING: Final = (0.2, 0.1, 0.06)
"""Metres: robust scales of the steps towards them."""
_COLLARS: Final = 0.2
"""The same share for collar bones beside any prediction: in full, ordinary postures took three quarters of a shrug
away."""
_HIDDEN: Final = 0.35
"""Share of a limb's vertices behind something else from which on the limb is hidden: of an arm, forearm and hand."""
FACING_CAMERA: Final[FloatArray] = np.diag([1.0, -1.0, -1.0])
"""Orientation of a model whose person stands upright and looks into the camera."""


@dataclass(frozen=True, slots=True)
class Settings:
    """Deviations of the terms, one standard deviation each.

    Attributes:
        surface: metres between the body and what is measured of it, clothes and shape included.
        patches: independent numbers among the measured points; clothes and shape err by whole patches.
        silhouette: metres that the body may lie outside of the silhouette.
        front: metres that the body may lie in front of what was measured. A small one pushes an arm that is measured
            elsewhere into the trunk, where it stays.
        limit: radians beyond a soft limit.
        damping: share of the information's diagonal that is added at first.
        unexplained: greatest sum, in a fit that is not lost, of the share of points that do not belong to the body and
            that of seen vertices outside of the silhouette. A body that is too large for the person has many of the
            latter and explains all points; bounds for each share lost such people, and kept more false fits.
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
    """A pose that is expected before the image is seen.

    Attributes:
        pose: the expected one.
        shift: metres, standard deviation of the first joint's place along each axis.
        turns: (J, 3) radians, standard deviations about the axes of the segments' frames.
        hidden: (J,) joints of limbs that something else than the person hides; none without.
    """

    pose: Pose
    shift: float
    turns: FloatArray
    hidden: BoolArray | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Orientation:
    """A segment's orientation by an inertial sensor.

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
    """Points of joints by another sensor, as of a Kinect's skeleton.

    Attributes:
        joints: (n,) of the body model.
        points: (n, 3) metres in the camera's frame.
        stddev: metres.
    """

    joints: IntArray
    points: FloatArray
    stddev: float


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A pose and how well it fits.

    Attributes:
        pose: the best one.
        posed: the body in it.
        frames: (J, 3, 3) anatomical frames of its segments, columns in the camera's axes.
        energy: half the sum of the squared, robust residuals.
        information: (3 + 3 J, 3 + 3 J) inverse covariance of the pose's change, see :mod:`body_tracking.mesh.energy`.
        matches: of the measured points.
        weights: (n,) of the measured points in the information, inverse square metres.
        matched: share of the measured points that belong to the body.
        violations: share of the vertices that face the camera that are outside of the silhouette or in front of it.
        rms: metres, root mean square distance of the matched points from the planes of their matches.
        lost: whether this is no fit of the person.
    """

    pose: Pose
    posed: PosedBody
    frames: FloatArray
    energy: float
    information: FloatArray
    matches: Matches
    weights: FloatArray
    matched: float
    violations: float
    rms: float
    lost: bool


def facing(course: FloatArray) -> FloatArray:
    """(3, 3) rotation of the first joint of a person who stands upright and faces in a direction.

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
        settings: deviations of the terms.

    Attributes:
        body: of the person.
        anatomy: angles of the body model.
        ancestors: (J, J) whether a turn of the second joint's segment moves the first joint's.
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
        """A person who stands upright and looks into the camera.

        Args:
            place: (3,) metres, of the first joint in the camera's frame.
            elevation: radians, of both arms sideways; hanging without.
            flexion: radians, of both elbows.
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
        """A pose with the arms as in ordinary standing."""
        rotations = pose.rotations.copy()
        rotations[self._arms] = self.neutral(np.zeros(3), 0.1, 0.3).rotations[self._arms]
        return Pose(rotations, pose.translation)

    def unmatched(self, observation: Observation, fit: Fit) -> dict[str, FloatArray]:
        """By side, the points (n, 3) within an arm's reach that do not belong to the body in a fit, metres.

        A side with too few for a hand is left out.
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
        """Poses with one hand at points that do not belong to the body in a fit; none where there are too few."""
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
        """A pose with a wrist at a place (3,) in the camera's frame, or as near as the arm reaches.

        The elbow bends as far as the distance asks for; the shoulder takes the least turn.
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
        """(J,) joints a good part of whose limb lies behind something else than the person.

        Args:
            observation: of the person.
            vertices: (N, 3) where the body is expected.
        """
        behind = energy.behind_others(
            vertices, observation.camera.project(vertices), observation.depth, observation.mask, energy.MARGIN
        )
        return np.asarray(behind @ self._below > _HIDDEN)

    def search(
        self, observation: Observation, orientations: Sequence[Orientation] = (), course: FloatArray | None = None
    ) -> Fit:
        """The best fit from several starts of a person who stands somewhere in view.

        Args:
            observation: of the person.
            orientations: of inertial sensors.
            course: (3,) direction in which the person walks, any length; without one the person faces the camera.
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
            start: pose of the first step.
            prediction: expected pose; without one, ordinary postures alone hold what is not seen.
            orientations: of inertial sensors.
            joints: points of another sensor's skeleton.
            scales: metres, robust scale of each step.
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
        """A pose changed by (3 + 3 J,) numbers: shift of the first joint, turns about the axes of the segments."""
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
        """The energy (Jatesiktat 2018, eq. 4 and 5) at a pose with its derivatives.

        Arguments are those of :meth:`fit`, with one robust scale, metres.
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
        # a point whose surface faces another way costs as much as one that is far away
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
        if len(pulls.vertices):
            robust, cost = _robust(pulls.residuals, 2.0 * scale)
            each = settings.patches / facing / np.where(pulls.kinds == 0, settings.silhouette, settings.front) ** 2
            own = pulls.vertices[:, None]
            arms = lever_arms(
                *(own, np.ones((len(own), 1)), posed.rest, model.bones, model.weights, model.parents),
                *(body.joints, posed.turned, posed.placed),
            )
            system.add(arms, pulls.directions, pulls.residuals, each * robust)
            total += float((each * cost).sum())
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
        fit = Fit(
            *(pose, posed, frames, 0.5 * total, information, matches, weights, matched, violations),
            rms=float(np.sqrt((planes[near] ** 2).mean())) if near.any() else float("inf"),
            lost=1.0 - matched + violations > settings.unexplained,
        )
        return Evaluation(fit, system.gradient)

    def _add_angles(self, system: _System, pose: Pose, hidden: BoolArray | None) -> float:
        """Limits (Jatesiktat 2018, eq. 8) and ordinary postures, which count less for ``hidden`` joints (J,)."""
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
        """What is expected before the image."""
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
        """Inertial sensors (Jatesiktat 2018, eq. 9-11), with the whole orientation."""
        frame = system.frames[orientation.joint]
        off = so3.rotation_vectors(orientation.rotation.T @ frame)
        rows = np.zeros((3, len(system.gradient)))
        for joint in np.flatnonzero(self.ancestors[orientation.joint]):
            rows[:, 3 + 3 * joint : 6 + 3 * joint] = frame.T @ system.frames[joint]
        rows = so3.right_jacobian_inverse(off) @ rows
        return system.add_rows(rows, off, orientation.stddev**-2.0)

    def _add_joints(self, system: _System, posed: PosedBody, joints: JointPoints) -> float:
        """Points of another sensor's skeleton."""
        arms = posed.placed[joints.joints][:, None] - posed.placed[None]
        arms = np.where(self.ancestors[joints.joints][..., None], arms, 0.0)
        offsets = posed.placed[joints.joints] - joints.points
        weights = np.full(len(arms), joints.stddev**-2.0)
        for axis in range(3):
            direction = np.zeros_like(offsets)
            direction[:, axis] = 1.0
            system.add(arms, direction, offsets[:, axis], weights)
        return float((weights[:, None] * offsets * offsets).sum())


@dataclass(slots=True, eq=False)
class _System:
    """Normal equations that are being added up; the information's lower triangle counts."""

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
        """Residuals (J, 3) of each joint's own turn, by its gradients (J, 3, 3)."""
        blocks = np.tril(np.einsum("jba,jb,jbc->jac", gradients, weights, gradients))
        at = 3 + np.arange(3 * len(blocks)).reshape(-1, 3)
        self.information[at[:, :, None], at[:, None, :]] += blocks
        self.gradient[3:] += np.einsum("jba,jb->ja", gradients, pull).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """A pose's fit, not yet improved.

    Attributes:
        fit: of the pose.
        gradient: (3 + 3 J,) of its energy by the pose's change.
    """

    fit: Fit
    gradient: FloatArray

    def step(self, damping: float) -> FloatArray:
        """Levenberg-Marquardt step (Jatesiktat 2018, eq. 15-16; section II-F), scaled by the diagonal (Marquardt 1963).

        Turns are limited to half a radian.
        """
        information = self.fit.information.copy()
        diagonal = np.arange(len(information))
        information[diagonal, diagonal] *= 1.0 + damping
        information[diagonal, diagonal] += 1e-6  # nothing seen leaves the first joint's place open
        step = np.linalg.solve(information, -self.gradient)
        largest = float(np.abs(step[3:]).max())
        result: FloatArray = np.asarray(step * min(1.0, 0.5 / max(largest, 1e-9)), dtype=np.float64)
        return result


def _robust(distances: FloatArray, scale: float) -> tuple[FloatArray, FloatArray]:
    """Weights and costs of distances by the function of Geman and McClure (1985), metres."""
    share = 1.0 / (1.0 + np.square(distances / scale))
    return share * share, np.square(distances) * share

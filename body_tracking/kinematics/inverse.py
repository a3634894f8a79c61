"""Inverse kinematics of ``upper_body``: from the points of one frame to a configuration.

A closed form gives a start from the directions between the points; damped least squares (Levenberg 1944, Marquardt
1963) then fit the points by their noise, with the ranges of motion as priors. The filter starts from this fit, and
restarts from it after a loss.

Least squares converge to the nearest minimum, and an arm has others. Half a turn of the forearm, or of the upper arm
with the elbow bent the other way, and flexion and deviation of the wrist reversed leave every point but the thumb,
which is reflected to the other side of the hand; both half turns together leave all points
(``Ranges.nearest_branch``). The ranges of motion separate these minima, because a bent hand cannot turn about itself
within them. So a full turn of the arm is searched (:meth:`InverseKinematics.turned_about`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from body_tracking.core import so3
from body_tracking.core.body_model import ModelError
from body_tracking.core.skeleton import BoolArray, FloatArray, Joint
from body_tracking.kinematics.compiled_body import CompiledUpperBody
from body_tracking.kinematics.compiled_posture import costs, descended, normal_equations, prior_table
from body_tracking.kinematics.posture import PosturePrior
from body_tracking.kinematics.ranges import Ranges

_J = Joint
_TINY = 1e-9
_STRAIGHT = 0.15
"""Sine of the elbow's flexion below which the forearm does not determine the upper arm's axial rotation."""
_TURNED = np.radians(60.0)
"""Radians: axial rotation of a hand beyond which two fits are different minima, which are half a turn apart."""
_NEARLY_STRAIGHT = 0.5
"""Sine of the elbow's flexion up to which rotations of the upper arm are searched, too: beyond, an eighth of a turn
moves the wrist of a forearm of 0.25 m by 0.09 m, more than any sensor's noise."""
_TURNS = np.radians(np.arange(0.0, 360.0, 45.0))
_PRONATIONS = 13
"""Steps of 15 degrees move a thumb's point by 7 mm, less than the distance between minima."""


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """The pose that fits one frame.

    Attributes:
        q: (nq,) configuration.
        covariance: (nv, nv) of the tangent at ``q``, by the noise of the points and the ranges of motion.
        residuals: (m, 3) metres, measured minus fitted; NaN where a point was not measured.
        cost: half the sum of the squared, normalised (and bounded) residuals and priors.
    """

    q: FloatArray
    covariance: FloatArray
    residuals: FloatArray
    cost: float


class InverseKinematics:
    """Fits ``upper_body`` to points: the inverse kinematics, which Schlagenhauf (2017, eq. 3.4) leaves to a filter."""

    def __init__(self, model: CompiledUpperBody) -> None:
        self.model = model
        self.ranges = Ranges(model)
        self.prior = PosturePrior(model, self.ranges)
        self._tables = model.tree, prior_table(model, self.ranges, self.prior)
        self._point = {Joint(joint): number for number, joint in enumerate(model.joints)}
        scalars = [model.coordinate_names[v] for v in model.scalar_v]
        self._scalar = {name: int(model.scalar_q[number]) for number, name in enumerate(scalars)}
        self._hands = [model.segment_names.index(f"hand_{side}") for side in ("left", "right")]
        self._low_high = np.full((2, model.nq), np.nan)
        rows = model.scalar_v - 6
        self._low_high[:, model.scalar_q] = self.ranges.low[rows], self.ranges.high[rows]

    def start(self, positions: FloatArray) -> FloatArray:
        """A configuration in closed form, from the directions between the points; no lengths are needed.

        Coordinates that missing points leave undetermined are neutral; a trunk of which only the shoulders are seen is
        upright.

        Args:
            positions: (19, 3) metres, in world; NaN where a point is not measured.

        Returns:
            (35,) configuration.

        Raises:
            ModelError: neither SpineBase, SpineMid and SpineShoulder nor the shoulders determine a trunk.
        """
        point = {joint: positions[number] for joint, number in self._point.items()}
        base, mid, top = (point[joint] for joint in (_J.SPINE_BASE, _J.SPINE_MID, _J.SPINE_SHOULDER))
        hips = point[_J.HIP_LEFT] - point[_J.HIP_RIGHT]
        shoulders = point[_J.SHOULDER_LEFT] - point[_J.SHOULDER_RIGHT]
        top = _first(top, 0.5 * (point[_J.SHOULDER_LEFT] + point[_J.SHOULDER_RIGHT]))
        lower, upper = mid - base, top - mid
        lower, upper = _first(lower, top - base, upper), _first(upper, top - base, lower)
        if not np.isfinite(lower).all() and np.isfinite(shoulders).all():
            lower = upper = np.array([0.0, 0.0, 1.0])  # behind a table: upright until more is seen
        if not np.isfinite(lower).all():
            raise ModelError(
                "inverse kinematics: neither two of SpineBase, SpineMid and SpineShoulder nor both shoulders are seen"
            )
        hips, shoulders = _first(hips, shoulders, _perpendicular(lower)), _first(shoulders, hips, _perpendicular(upper))

        q = self.model.neutral()
        pelvis = _frame(lower, hips)
        lower_trunk = _frame(lower, _unit(hips) + _unit(shoulders))
        upper_trunk = _frame(upper, shoulders)
        origin = _first(base, mid - 0.25 * _unit(lower), top - 0.5 * _unit(lower))
        q[:3] = origin
        q[self.model.quaternion_of("pelvis")] = so3.matrix_to_quat(pelvis)
        self._set_trunk(q, "lumbar", pelvis.T @ lower_trunk)
        self._set_trunk(q, "thoracic", lower_trunk.T @ upper_trunk)
        head = upper_trunk.T @ _unit(point[_J.HEAD] - _first(point[_J.NECK], top))
        if np.isfinite(head).all():
            q[self._scalar["neck_flexion"]] = np.arctan2(head[0], head[2])
            q[self._scalar["neck_lateral"]] = -np.arcsin(np.clip(head[1], -1.0, 1.0))
        for side, sign in (("left", 1.0), ("right", -1.0)):
            self._start_arm(q, point, upper_trunk, top, side, sign)
        # an implausible direction must not lead to a start outside the ranges of motion
        scalar = self.model.scalar_q
        rows = self.model.scalar_v - 6
        q[scalar] = np.clip(q[scalar], self.ranges.low[rows], self.ranges.high[rows])
        return q

    def solve(
        self,
        positions: FloatArray,
        stddev: FloatArray,
        lengths: FloatArray,
        q: FloatArray | None = None,
        *,
        max_iterations: int = 15,
        tolerance: float = 1e-4,
        alternatives: bool | None = None,
    ) -> Fit:
        """Damped least squares on the points, with the ranges of motion as priors.

        Args:
            positions: (19, 3) metres, in world; NaN where a point is not measured.
            stddev: (19,) metres, of each point, the same in all directions.
            lengths: (21,) metres.
            q: (35,) start; that of the closed form if None.
            max_iterations: greatest number of steps.
            tolerance: of the last step's tangent, radians and metres.
            alternatives: whether to try axially rotated arms, too, and take the best; None: only without a start.

        Raises:
            ModelError: no trunk is seen, and no start was given.
        """
        target, weights = _weighted(positions, stddev)
        alternatives = q is None if alternatives is None else alternatives
        if q is None:
            q = self.start(np.where(weights[:, None] > 0.0, positions, np.nan))
        found = descended(q, target, weights, lengths, max_iterations, tolerance, *self._tables)
        if alternatives:
            for other in self.turned_about(found[0], positions, stddev, lengths):
                another = descended(other, target, weights, lengths, max_iterations, tolerance, *self._tables)
                found = another if another[2] < found[2] else found
        q, normal, cost = found
        branch = self.ranges.nearest_branch(q)
        if branch is not None:
            q = branch[0]
            normal = normal_equations(q, target, weights, lengths, *self._tables)[0]
        fitted = self.model.forward(q, lengths).positions
        residuals = np.where(weights[:, None] > 0.0, positions - fitted, np.nan)
        covariance = np.linalg.inv(normal).astype(np.float64)
        return Fit(q, covariance, residuals, cost)

    def cost(self, q: FloatArray, positions: FloatArray, stddev: FloatArray, lengths: FloatArray) -> FloatArray:
        """(n,) :attr:`Fit.cost` at configurations (n, 35); other arguments as of :meth:`solve`."""
        return costs(q, *_weighted(positions, stddev), lengths, *self._tables)

    def turned_about(
        self, q: FloatArray, positions: FloatArray, stddev: FloatArray, lengths: FloatArray
    ) -> list[FloatArray]:
        """Starts for other poses of each arm: the best configuration with the hand rotated about its own axis.

        The forearm is rotated through its whole range, and the wrist is bent to keep the direction of the hand. Where
        the elbow is nearly straight, the upper arm is rotated about its own axis as well, and the elbow bent to keep
        the direction of the forearm.

        Args:
            q: (35,) a pose.
            positions: as of :meth:`solve`.
            stddev: as of :meth:`solve`.
            lengths: as of :meth:`solve`.

        Returns:
            (35,) a configuration for each arm whose elbow and hand are seen: a start, not a fit.
        """
        seen = np.isfinite(positions).all(axis=1) & np.isfinite(stddev)
        found = []
        for side in ("left", "right"):
            chain = [self._point[Joint[f"{name}_{side.upper()}"]] for name in ("ELBOW", "WRIST", "HAND", "THUMB")]
            if not seen[chain].all():
                continue
            turned = self._all_round(q, side)
            turned = turned[self.is_turned(q, turned)]
            if len(turned):
                found.append(turned[self.cost(turned, positions, stddev, lengths).argmin()])
        return found

    def is_turned(self, q: FloatArray, other: FloatArray) -> BoolArray:
        """(...,) whether a hand of configurations (..., 35) is rotated about its own axis against ``q`` (35,)."""
        lengths = self.model.default_lengths()
        here, there = (
            self.model.forward(each, lengths).rotations.take(self._hands, axis=-3)[..., 0] for each in (q, other)
        )
        result: BoolArray = ((here * there).sum(axis=-1) < np.cos(_TURNED)).any(axis=-1)
        return result

    def _all_round(self, q: FloatArray, side: str) -> FloatArray:
        """(n, 35) a configuration with one arm rotated about its axis by many angles, the hand's direction kept."""
        sign = 1.0 if side == "left" else -1.0
        elbow, pronation, flexion, deviation = (
            self._scalar[f"{name}_{side}"]
            for name in ("elbow_flexion", "forearm_pronation", "wrist_flexion", "wrist_deviation")
        )
        forearm, hand = (self.model.segment_names.index(f"{name}_{side}") for name in ("forearm", "hand"))
        upper_arm = self.model.quaternion_of(f"upper_arm_{side}")
        low, high = self._low_high
        turns = _TURNS if np.sin(q[elbow]) < _NEARLY_STRAIGHT else _TURNS[:1]
        turned = np.tile(q, (len(turns) * _PRONATIONS, 1))
        turn = turns.repeat(_PRONATIONS)
        turned[:, upper_arm] = so3.quat_multiply(q[upper_arm], so3.exp(turn[:, None] * [0.0, 0.0, 1.0]))
        turned[:, elbow] = np.arctan2(np.sin(q[elbow]) * np.cos(turn), np.cos(q[elbow]))
        turned[:, pronation] = np.tile(np.linspace(low[pronation], high[pronation], _PRONATIONS), len(turns))
        lengths = self.model.default_lengths()
        along = -self.model.forward(q, lengths).rotations[hand, :, 2]
        x, y, z = (self.model.forward(turned, lengths).rotations[:, forearm].swapaxes(1, 2) @ along).T
        turned[:, deviation] = np.arcsin(np.clip(x, -1.0, 1.0))
        turned[:, flexion] = np.arctan2(-sign * y, -z)
        bent = [elbow, flexion, deviation]
        turned[:, bent] = np.clip(turned[:, bent], low[bent], high[bent])
        return turned

    def _set_trunk(self, q: FloatArray, part: str, rotation: FloatArray) -> None:
        """Set flexion, lateral and axial angle from an intrinsic y-x-z rotation (3, 3)."""
        q[self._scalar[f"{part}_flexion"]] = np.arctan2(rotation[0, 2], rotation[2, 2])
        q[self._scalar[f"{part}_lateral"]] = -np.arcsin(np.clip(rotation[1, 2], -1.0, 1.0))
        q[self._scalar[f"{part}_axial"]] = np.arctan2(rotation[1, 0], rotation[1, 1])

    def _start_arm(
        self,
        q: FloatArray,
        point: dict[Joint, FloatArray],
        upper_trunk: FloatArray,
        top: FloatArray,
        side: str,
        sign: float,
    ) -> None:
        """Set the angles from the clavicle to the wrist, as far as points are seen."""
        shoulder, elbow, wrist, hand, tip, thumb = (
            point[Joint[f"{name}_{side.upper()}"]]
            for name in ("SHOULDER", "ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")
        )
        outward = upper_trunk.T @ _unit(shoulder - top)
        if np.isfinite(outward).all():
            q[self._scalar[f"clavicle_elevation_{side}"]] = np.arcsin(np.clip(outward[2], -1.0, 1.0))
            q[self._scalar[f"clavicle_protraction_{side}"]] = np.arctan2(outward[0], sign * outward[1])
        clavicle = self._rotation(q, f"clavicle_{side}")
        upper = elbow - shoulder
        if not np.isfinite(upper).all():
            return
        z = -_unit(upper)
        forearm = _unit(wrist - elbow)
        x = forearm + z * float(-forearm @ z)
        # a straight arm has the axial rotation of the shortest rotation from the centre of the reach
        if not np.sqrt(x @ x) > _STRAIGHT:
            reach = np.array([np.sqrt(0.5), sign * np.sqrt(0.5), 0.0])
            hanging = np.array([0.0, 0.0, -1.0])
            centre = _shortest(hanging, reach)
            x = clavicle @ _shortest(reach, clavicle.T @ -z) @ centre[:, 0]
        arm = np.stack([_unit(x - z * float(x @ z)), np.zeros(3), z], axis=1)
        arm[:, 1] = np.cross(arm[:, 2], arm[:, 0])
        q[self.model.quaternion_of(f"upper_arm_{side}")] = so3.matrix_to_quat(clavicle.T @ arm)
        if not np.isfinite(forearm).all():
            return
        q[self._scalar[f"elbow_flexion_{side}"]] = np.arctan2(float(forearm @ arm[:, 0]), float(-forearm @ arm[:, 2]))
        lower = self._rotation(q, f"forearm_{side}")
        out = thumb - _first(hand, wrist)
        out = lower.T @ (out - forearm * float(out @ forearm))
        if np.isfinite(out).all():
            q[self._scalar[f"forearm_pronation_{side}"]] = np.arctan2(-sign * out[1], out[0])
            lower = self._rotation(q, f"forearm_{side}")
        along = lower.T @ _unit(_first(tip, hand) - wrist)
        if np.isfinite(along).all():
            q[self._scalar[f"wrist_deviation_{side}"]] = np.arcsin(np.clip(along[0], -1.0, 1.0))
            q[self._scalar[f"wrist_flexion_{side}"]] = np.arctan2(-sign * along[1], -along[2])

    def _rotation(self, q: FloatArray, segment: str) -> FloatArray:
        posture = self.model.forward(q, self.model.default_lengths())
        rotation: FloatArray = posture.rotations[self.model.segment_names.index(segment)]
        return rotation


def _weighted(positions: FloatArray, stddev: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(19, 3) points, zeros where not measured, and (19,) their weights."""
    measured = np.isfinite(positions).all(axis=1) & np.isfinite(stddev)
    weights = np.where(measured, 1.0 / np.where(measured, stddev, 1.0), 0.0)
    return np.where(measured[:, None], positions, 0.0), weights


def _unit(v: FloatArray) -> FloatArray:
    """The direction of a vector; NaN where it has none."""
    size = np.sqrt(v @ v)
    direction: FloatArray = v / size if size > _TINY else np.full(3, np.nan)
    return direction


def _first(*candidates: FloatArray) -> FloatArray:
    """The first that is known; the last if none is."""
    known: BoolArray = np.array([bool(np.isfinite(v).all()) for v in candidates])
    return candidates[int(known.argmax()) if known.any() else -1]


def _perpendicular(v: FloatArray) -> FloatArray:
    """Some direction across ``v``: horizontal for one that stands."""
    across = np.cross(v, [1.0, 0.0, 0.0])
    if across @ across < 1e-4 * (v @ v):
        across = np.cross(v, [0.0, -1.0, 0.0])
    return across


def _frame(z: FloatArray, y: FloatArray) -> FloatArray:
    """(3, 3) the frame whose z axis is ``z`` and whose y axis is as near to ``y`` as can be."""
    z = _unit(z)
    y = _unit(y - z * float(y @ z))
    if not np.isfinite(y).all():
        y = _unit(_perpendicular(z))
    return np.stack([np.cross(y, z), y, z], axis=1)


def _shortest(a: FloatArray, b: FloatArray) -> FloatArray:
    """(3, 3) the shortest rotation that turns direction ``a`` to ``b``."""
    axis = np.cross(a, b)
    sine, cosine = float(np.sqrt(axis @ axis)), float(a @ b)
    if sine < _TINY:
        axis = _perpendicular(a)
    return so3.quat_to_matrix(so3.exp(_unit(axis) * np.arctan2(sine, cosine)))

"""Joint angles of ``upper_body`` in several conventions, from the rotations of its segments.

====== ================================================================================================================
model  the model's own angles (goniometry: zero upright with arms hanging and thumbs forward; positive in the direction
       of the name), the shoulder as flexion, abduction and inward rotation in this order (singular at 90 deg of
       abduction, such as in the T-pose); and the upper trunk against the pelvis: flexion, lateral, axial
isb    Wu et al., J. Biomech. 38 (2005) 981, with its signs, left arms mirrored as it prescribes. Thorax against pelvis
       Z X Y (the order of 2.4.1 and of Wu 2002 for the spine; the paper's global frame supposes that the person faces
       its x axis): extension, lateral to the right, axial to the left. Clavicle against thorax Y X: protraction,
       depression. Humerus against thorax Y X Y: plane of elevation (0 abduction, 90 forward flexion), elevation
       (negative), internal rotation; singular hanging and straight up. Forearm against humerus Z X Y: flexion,
       pronation (0 with the palm forward, 90 with the thumb forward). Hand against forearm Z X: flexion, deviation to
       the ulna. The model has no carrying angle, no axial rotation of the clavicle and no twist within the wrist.
rep155 joints of the REP's kinematic model (package ``human_description``), those of the upper body: ``waist`` leans
       forward; ``r_head``, ``y_head``, ``p_head``; per side ``y_shoulder``, ``p_shoulder``, ``r_shoulder`` (about z, x,
       z: singular hanging and straight up) and ``elbow``. Its trunk has no lateral and no axial bend: head and arms
       are given against the torso of that model, so that they point in the person's directions.
dh26   the 26 angles of Schlagenhauf (2017), tables 3.1 and 3.2; see ``kinematics.dh26``
====== ================================================================================================================

Uncertainty is propagated by the analytic Jacobian. Near a singular pose it grows as 1 / sin, up to that of a uniform
angle, and the angles are held continuous (``kinematics.euler``). It also grows up to that limit before angles that have
left their usual ranges, after a path through a singular pose, jump back into them. An unobserved angle has the standard
deviation of its prior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np

from body_tracking.core import so3
from body_tracking.core.errors import BodyTrackingError, one_of
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.euler import EulerAngles, EulerSequences
from body_tracking.kinematics.positional import ANGLE_NAMES
from body_tracking.kinematics.ranges import RANGES
from body_tracking.kinematics.upper_body import SHOULDER_AXES, UpperBody
from body_tracking.pipeline.graph import POSITIONAL

CONVENTIONS: Final = ("model", "isb", "rep155", "dh26")
ALL_CONVENTIONS: Final = (*CONVENTIONS, POSITIONAL)
"""With that of :mod:`body_tracking.kinematics.positional`, which needs no model."""

UNIFORM_STDDEV = np.pi / np.sqrt(3.0)
"""Radians: the standard deviation of a uniformly distributed angle, near a singular pose."""
_ROUNDING = 1e-9
_X, _Y, _Z = np.eye(3)


class ConventionError(BodyTrackingError):
    """Raised for an unknown convention, or for previous angles of another one."""


@dataclass(frozen=True, slots=True)
class Chain:
    """One rotation as three angles.

    Attributes:
        names: of the three angles; None for an omitted one (always zero in the model, or not in the convention).
        parent, child: segments, or names of :class:`Frame`.
        angles: the sequence.
        redundant: names of angles that are always zero, because the convention has more angles than the rotation.
    """

    names: tuple[str | None, str | None, str | None]
    parent: str
    child: str
    angles: EulerAngles
    redundant: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame of the convention that no segment of the model has: a parent, turned by the first angles of a chain.

    Attributes:
        name: of the frame.
        chain: index of the chain among those of the convention without frames.
        count: how many of its angles, 1 or 2.
    """

    name: str
    chain: int
    count: int


class Convention:
    """The angles of one convention for one model.

    Attributes:
        names: n, in the order of the output.
        chains: all of them, those that use frames last.
        rows: (n,) row of each among all computed quantities: coordinates, then three angles of each chain.
        stages: chains that are computed together: their sequences, parents and children among the segments, and rows.
    """

    def __init__(
        self,
        model: UpperBody,
        names: Sequence[str],
        chains: Sequence[Chain],
        frames: Sequence[Frame] = (),
        later: Sequence[Chain] = (),
    ) -> None:
        """Build the index arrays.

        Args:
            model: the body model.
            names: in the order of the output; those that are in no chain are coordinates of the model.
            chains: between segments.
            frames: made of those chains.
            later: chains that use the frames.
        """
        self.names = tuple(names)
        self.chains = (*chains, *later)
        self._model = model
        self._frames = [
            (segment, frame.chain, frame.count)
            for frame in frames
            for segment in [model.segment_names.index(chains[frame.chain].parent)]
        ]
        segments = [*model.segment_names, *(frame.name for frame in frames)]
        # rows of all computed quantities: coordinates, chains, later chains, one row of zeros
        coordinates = model.coordinate_names[6:]
        rows = {name: number for number, name in enumerate(coordinates)}
        self._scalar: IntArray = model.scalar_q
        self._scalar_row: IntArray = (model.scalar_v - 6).astype(np.intp)
        count = len(coordinates)
        zero = count + 3 * len(self.chains)
        for number, chain in enumerate(self.chains):
            rows |= {name: count + 3 * number + k for k, name in enumerate(chain.names) if name is not None}
            rows |= dict.fromkeys(chain.redundant, zero)
        self.rows: IntArray = np.array([rows[name] for name in names], dtype=np.intp)
        self._redundant = self.rows == zero
        self.stages = []
        start = count
        for stage in (chains, later):
            if stage:
                parents, children = (
                    np.array([segments.index(getattr(chain, end)) for chain in stage], dtype=np.intp)
                    for end in ("parent", "child")
                )
                stop = start + 3 * len(stage)
                self.stages.append((EulerSequences([c.angles for c in stage]), parents, children, slice(start, stop)))
                start = stop
        self._size = zero + 1
        self._identity = np.zeros((self._size, count))
        self._identity[:count] = np.eye(count)

    def __call__(self, estimate: ModelEstimate, previous: JointAngles | None) -> JointAngles:
        """See :func:`angles_of`."""
        model = self._model
        nv = model.nv
        joint, rate = slice(6, nv), slice(nv + 6, 2 * nv)
        linear = model.linearise(estimate.q, estimate.lengths)
        rotations, turning = linear.posture.rotations, linear.rotation_jacobian[:, :, 6:]
        covariance, unknown = _finite(estimate.covariance[joint, joint])
        velocity_covariance, unknown_rate = _finite(estimate.covariance[rate, rate])

        before = None
        if previous is not None:
            if previous.names != self.names:
                raise ConventionError(f"previous angles: names {previous.names[:3]}..., expected {self.names[:3]}...")
            if np.isfinite(previous.position).all():
                before = np.zeros(self._size)
                before[self.rows] = previous.position
        values = np.zeros(self._size)
        values[self._scalar_row] = estimate.q[self._scalar]
        gradients, rates = self._identity.copy(), self._identity.copy()
        doubt, second_order = np.zeros(self._size), np.zeros(self._size)
        for stage, (sequences, parents, children, rows) in enumerate(self.stages):
            if stage == 1 and self._frames:
                rotations, turning = self._extend(rotations, turning, values, gradients)
            back = rotations[parents].swapaxes(-1, -2)
            turned = back @ (turning[children] - turning[parents])
            uncertain = ((turned @ covariance) * turned).sum(axis=-1)
            if unknown is not None:
                uncertain[(np.abs(turned[:, :, unknown]) > _ROUNDING).any(axis=-1)] = np.pi**2
            split = sequences.split(
                back @ rotations[children], uncertain, None if before is None else before[rows].reshape(-1, 3)
            )
            values[rows] = split.angles.reshape(-1)
            doubt[rows] = np.repeat(split.doubt, 3)
            second_order[rows] = np.outer(split.second_order, (1.0, 0.0, 1.0)).reshape(-1)
            gradients[rows] = (split.gradients @ turned).reshape(-1, nv - 6)
            rates[rows] = (split.rates @ turned).reshape(-1, nv - 6)

        gradient, rate_gradient = gradients[self.rows], rates[self.rows]
        further = (doubt * UNIFORM_STDDEV) ** 2 + second_order
        stddev = np.sqrt(_stddev(gradient, covariance, unknown) ** 2 + further[self.rows])
        lost_angle = self._redundant | np.isinf(stddev)
        velocity_stddev = _stddev(gradient, velocity_covariance, unknown_rate)
        return JointAngles(
            stamp_ns=estimate.stamp_ns,
            names=self.names,
            position=values[self.rows],
            velocity=_times(rate_gradient, estimate.velocity[joint]),
            position_stddev=np.where(lost_angle, np.inf, np.minimum(stddev, UNIFORM_STDDEV)),
            # an unobserved angle has an unobserved rate
            velocity_stddev=np.where(lost_angle, np.inf, velocity_stddev),
        )

    def _extend(
        self, rotations: FloatArray, turning: FloatArray, values: FloatArray, gradients: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Rotations (n, 3, 3) and their derivatives (n, 3, 26), with those of the frames appended."""
        sequences, _, _, rows = self.stages[0]
        more_rotations, more_turning = [], []
        for parent, chain, count in self._frames:
            basis = sequences.basis[chain]
            rotation, angular = rotations[parent], turning[parent]
            for k in range(count):
                row = rows.start + 3 * chain + k
                axis = basis[:, k]
                angular = angular + np.outer(rotation @ axis, gradients[row])
                rotation = rotation @ so3.quat_to_matrix(so3.exp(values[row] * axis))
            more_rotations.append(rotation)
            more_turning.append(angular)
        return np.concatenate([rotations, more_rotations]), np.concatenate([turning, more_turning])


def _finite(covariance: FloatArray) -> tuple[FloatArray, IntArray | None]:
    """The covariance with 0 for coordinates of infinite variance, and their indices; None if there are none."""
    variances = covariance.diagonal()
    if np.isfinite(variances.sum()):
        return covariance, None
    unknown: IntArray = np.flatnonzero(~np.isfinite(variances)).astype(np.intp)
    covariance = covariance.copy()
    covariance[unknown], covariance[:, unknown] = 0.0, 0.0
    return covariance, unknown


def _stddev(gradient: FloatArray, covariance: FloatArray, unknown: IntArray | None) -> FloatArray:
    """(n,) standard deviations; infinite where an unknown coordinate contributes."""
    variance = ((gradient @ covariance) * gradient).sum(axis=-1)
    stddev: FloatArray = np.sqrt(np.maximum(variance, 0.0))
    if unknown is not None:
        stddev[(np.abs(gradient[:, unknown]) > _ROUNDING).any(axis=1)] = np.inf
    return stddev


def _times(gradient: FloatArray, velocity: FloatArray) -> FloatArray:
    """(n,) rates; NaN where an unknown velocity contributes."""
    rates: FloatArray = gradient @ velocity
    if np.isnan(rates).any():
        unknown = np.isnan(velocity)
        rates = gradient @ np.where(unknown, 0.0, velocity)
        rates[(np.abs(gradient[:, unknown]) > _ROUNDING).any(axis=1)] = np.nan
    return rates


_SIDES: Final = ("left", "right")
_TRUNK_USUAL = ((-60.0, 110.0), (-60.0, 60.0), (-55.0, 55.0))
SHOULDER_USUAL = ((-60.0, 180.0), (-60.0, 180.0), (-100.0, 100.0))
"""Degrees: (least, greatest) flexion, abduction and inward rotation; AAOS, as in ``kinematics.ranges``, outwards."""
_SHOULDER_TOGETHER: Final = 240.0
"""Degrees: usual upper bound of flexion plus abduction. Hanging arms are at (0, 0) or, with half a turn more of
rotation, at (180, 180). The range of the rotation, poorly observed in a straight arm, cannot decide between them. With
200 degrees raised arms jumped between the triples in 8 instead of 2 of 188 large steps (``test_ekf.py``, poses that
jump)."""
_ELBOW_USUAL = (RANGES["elbow_flexion"], (-90.0, 90.0), RANGES["forearm_pronation"])


def model_names(model: UpperBody) -> tuple[str, ...]:
    """The model's 26 joint angles in the order of its tangent, the shoulders' by their clinical names."""
    split = {"x": "flexion", "y": "abduction", "z": "rotation"}
    words = [name.split("_") for name in model.coordinate_names[6:]]
    return tuple("_".join([w[0], split[w[1]], w[2]] if w[0] == "shoulder" else w) for w in words)


def _model(model: UpperBody) -> Convention:
    chains = [
        Chain(
            ("trunk_flexion", "trunk_lateral", "trunk_axial"),
            "pelvis",
            "upper_trunk",
            EulerAngles((_Y, _X, _Z), _TRUNK_USUAL),
        )
    ]
    chains += [
        Chain(
            (f"shoulder_flexion_{side}", f"shoulder_abduction_{side}", f"shoulder_rotation_{side}"),
            f"clavicle_{side}",
            f"upper_arm_{side}",
            # its singular pose is the T-pose, after which the angles must be those of an arm in front of the body
            EulerAngles(SHOULDER_AXES[side], SHOULDER_USUAL, margin=30.0, together=_SHOULDER_TOGETHER),
        )
        for side in _SIDES
    ]
    return Convention(model, [*model_names(model), "trunk_flexion", "trunk_lateral", "trunk_axial"], chains)


def _isb(model: UpperBody) -> Convention:
    # ISB: X forward, Y up, Z to the right; the left side is mirrored at the sagittal plane, which reverses rotations
    # about X and Y
    up, right = _Z, -_Y
    chains = [
        Chain(
            ("thorax_extension", "thorax_lateral_right", "thorax_axial_left"),
            "pelvis",
            "upper_trunk",
            EulerAngles((right, _X, up), ((-110.0, 60.0), *_TRUNK_USUAL[1:])),
        ),
        Chain(
            ("neck_extension", "neck_lateral_right", None),
            "upper_trunk",
            "head",
            EulerAngles((right, _X, up), ((-60.0, 60.0), (-60.0, 60.0), (-60.0, 60.0))),
        ),
    ]
    for side, sign in zip(_SIDES, (-1.0, 1.0), strict=True):
        x, y, z = sign * _X, sign * up, right
        # palm forward instead of thumb forward
        supinated = so3.quat_to_matrix(so3.exp(0.5 * np.pi * y))
        volar, radial = supinated @ x, supinated @ z
        chains += [
            Chain(
                (f"clavicle_protraction_{side}", f"clavicle_depression_{side}", None),
                "upper_trunk",
                f"clavicle_{side}",
                EulerAngles((y, x, z), ((-30.0, 30.0), (-45.0, 30.0), (-90.0, 90.0))),
            ),
            Chain(
                (
                    f"shoulder_plane_of_elevation_{side}",
                    f"shoulder_elevation_{side}",
                    f"shoulder_internal_rotation_{side}",
                ),
                "upper_trunk",
                f"upper_arm_{side}",
                EulerAngles((y, x, y), ((-120.0, 150.0), (-180.0, 0.0), (-150.0, 150.0))),
            ),
            Chain(
                (f"elbow_flexion_{side}", None, f"elbow_pronation_{side}"),
                f"upper_arm_{side}",
                f"forearm_{side}",
                EulerAngles((z, x, y), (_ELBOW_USUAL[0], (-90.0, 90.0), (0.0, 180.0)), supinated),
            ),
            Chain(
                (f"wrist_flexion_{side}", f"wrist_ulnar_deviation_{side}", None),
                f"forearm_{side}",
                f"hand_{side}",
                EulerAngles((radial, volar, y), ((-90.0, 90.0), (-90.0, 90.0), (-90.0, 90.0))),
            ),
        ]
    return Convention(model, [name for chain in chains for name in chain.names if name is not None], chains)


def _rep155(model: UpperBody) -> Convention:
    chains = [Chain(("waist", None, None), "pelvis", "upper_trunk", EulerAngles((_Y, _X, _Z), _TRUNK_USUAL))]
    later = [
        Chain(
            ("r_head", "y_head", "p_head"),
            "torso",
            "head",
            EulerAngles((_X, _Z, -_Y), ((-60.0, 60.0), (-80.0, 80.0), (-90.0, 90.0))),
        )
    ]
    names = ["waist", "r_head", "y_head", "p_head"]
    for side, sign in zip(_SIDES, (1.0, -1.0), strict=True):
        letter = side[0]
        shoulder = (f"{letter}_y_shoulder", f"{letter}_p_shoulder", f"{letter}_r_shoulder")
        later.append(
            Chain(
                shoulder,
                "torso",
                f"upper_arm_{side}",
                EulerAngles((-sign * _Z, sign * _X, sign * _Z), ((-150.0, 120.0), (0.0, 180.0), (-150.0, 150.0))),
            )
        )
        chains.append(
            Chain(
                (f"{letter}_elbow", None, None),
                f"upper_arm_{side}",
                f"forearm_{side}",
                EulerAngles((-_Y, _X, _Z), _ELBOW_USUAL),
            )
        )
        names += [*shoulder, f"{letter}_elbow"]
    return Convention(model, names, chains, [Frame("torso", 0, 1)], later)


@cache
def convention(name: str, model: UpperBody) -> Convention:
    """The convention of a name, for a model.

    Raises:
        ConventionError: unknown name.
    """
    from body_tracking.kinematics.dh26 import dh26  # imports this module

    builders = dict(zip(CONVENTIONS, (_model, _isb, _rep155, dh26), strict=True))
    if name not in builders:
        raise ConventionError(f"angle convention {name!r}, {one_of(name, CONVENTIONS)}")
    return builders[name](model)


def angle_names(name: str) -> tuple[str, ...]:
    """The angles of one of :data:`ALL_CONVENTIONS`, in order.

    Raises:
        ConventionError: unknown convention.
    """
    return ANGLE_NAMES if name == POSITIONAL else convention(name, UpperBody()).names


def angles_of(estimate: ModelEstimate, model: UpperBody, name: str, previous: JointAngles | None = None) -> JointAngles:
    """Joint angles in a convention, with rates and standard deviations.

    Args:
        estimate: of the model at one instant.
        model: the model.
        name: one of :data:`CONVENTIONS`.
        previous: the angles of the instant before, in the same convention: the new ones continue them in full turns
            and at singular poses. None at the start.

    Raises:
        ConventionError: no such convention, or previous angles of another one.
    """
    return convention(name, model)(estimate, previous)

"""The interface of body models, which filters and conversions are written against.

Terms as in Pinocchio: a configuration ``q`` of size ``nq`` holds a quaternion (x, y, z, w) for each free rotation, a
tangent vector ``v`` of size ``nv`` is a small change of it. All functions take leading dimensions, of instants or
people. World: x forward, y left, z up (REP-103), metres, radians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.skeleton import FloatArray, IntArray

SEGMENTS: tuple[str, ...] = (
    "pelvis",
    "lower_trunk",
    "upper_trunk",
    "head",
    "clavicle_left",
    "clavicle_right",
    "upper_arm_left",
    "upper_arm_right",
    "forearm_left",
    "forearm_right",
    "hand_left",
    "hand_right",
)
"""Names of the segments of a body above the hips, parents before children."""


class ModelError(BodyTrackingError):
    """Raised for a configuration or segment lengths that do not fit the model."""


@dataclass(frozen=True, slots=True, eq=False)
class Posture:
    """Positions of the joints and poses of the segments.

    Attributes:
        positions: (..., m, 3) metres, the model's ``joints``, in world.
        origins: (..., s, 3) metres, origins of the segments' frames, in world.
        rotations: (..., s, 3, 3) a segment's vectors to world.
    """

    positions: FloatArray
    origins: FloatArray
    rotations: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Linearisation:
    """A posture with its derivatives.

    Attributes:
        posture: the posture.
        jacobian: (..., m, 3, nv) metres per tangent unit: of the positions.
        length_jacobian: (..., m, 3, nl) of the positions by the segment lengths.
        rotation_jacobian: (..., s, 3, nv) angular velocity of each segment in world per tangent velocity.
    """

    posture: Posture
    jacobian: FloatArray
    length_jacobian: FloatArray
    rotation_jacobian: FloatArray


class BodyModel(Protocol):
    """A tree of rigid segments.

    Attributes:
        name: of the model.
        joints: (m,) which :class:`~body_tracking.core.skeleton.Joint` each modelled point is.
        segment_names: s names.
        coordinate_names: nv names of the tangent coordinates.
        length_names: nl names of the segment lengths.
        nq: size of a configuration.
        nv: size of a tangent vector.
    """

    name: str
    joints: IntArray
    segment_names: tuple[str, ...]
    coordinate_names: tuple[str, ...]
    length_names: tuple[str, ...]
    nq: int
    nv: int

    def neutral(self) -> FloatArray:
        """(nq,) the zero pose."""

    def default_lengths(self, stature: float = 1.75) -> FloatArray:
        """(nl,) metres, of a person of average proportions."""

    def integrate(self, q: FloatArray, v: FloatArray) -> FloatArray:
        """(..., nq) the configuration (..., nq) moved by the tangent vector (..., nv)."""

    def difference(self, q0: FloatArray, q1: FloatArray) -> FloatArray:
        """(..., nv) the shortest ``v`` with ``integrate(q0, v) == q1``."""

    def forward(self, q: FloatArray, lengths: FloatArray) -> Posture:
        """Forward kinematics of all joints and segments.

        Args:
            q: (..., nq) configurations.
            lengths: (..., nl) metres.
        """

    def linearise(self, q: FloatArray, lengths: FloatArray) -> Linearisation:
        """Forward kinematics with the analytic derivatives; arguments as of :meth:`forward`."""

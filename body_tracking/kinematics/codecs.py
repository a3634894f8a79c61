"""The message of a model's segments."""

from __future__ import annotations

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.message_types import SEGMENTS
from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.codecs import Codec, Wire
from body_tracking.messages.model import segments_to_joint_state


class Segments(Codec):
    """The poses of the segments of a model."""

    type_name = SEGMENTS

    def __init__(self, model: UpperBody) -> None:
        self.model = model

    def encode(self, payload: ModelEstimate, wire: Wire) -> bytes:
        names, poses = self.model.segment_names, segment_poses(payload, self.model)
        return wire.serialize(SEGMENTS, segments_to_joint_state(payload, names, *poses, wire.types))


def segment_poses(estimate: ModelEstimate, model: UpperBody) -> tuple[FloatArray, FloatArray]:
    """(12, 3) origins and (12, 4) quaternions xyzw of the segments, in the estimate's frame."""
    posture = model.forward(estimate.q, estimate.lengths)
    return posture.origins, so3.matrix_to_quat(posture.rotations)

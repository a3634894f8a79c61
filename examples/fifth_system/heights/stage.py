"""The system's only stage, and the codec of its topic."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from body_tracking.core.message_types import IMAGE
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.qos import RELIABLE as RELIABLE_QOS
from body_tracking.core.skeleton import Joint
from body_tracking.messages.base import MessageError
from body_tracking.messages.codecs import Codec, Wire
from body_tracking.messages.images import array_to_image, image_to_array
from body_tracking.pipeline import graph
from body_tracking.pipeline.shared import RELIABLE, skeleton_input
from body_tracking.pipeline.stage import Now, Output, Port, Stage
from heights.system import HEIGHT


class Height(Codec):
    """Stamp in nanoseconds, and height in metres."""

    type_name = IMAGE

    def encode(self, payload: tuple[int, float], wire: Wire) -> bytes:
        pixels = np.array([[payload[1]]], np.float32)
        return wire.serialize(IMAGE, array_to_image(pixels, payload[0], "world", wire.types, "32FC1"))

    def decode(self, cdr: bytes, wire: Wire) -> tuple[int, float]:
        stamp_ns, _, pixels = image_to_array(wire.deserialize(IMAGE, cdr), {"32FC1": "f4"})
        if pixels.shape != (1, 1):
            raise MessageError(f"an image of {pixels.shape}, expected one number")
        return stamp_ns, float(pixels[0, 0])


class HeightStage(Stage):
    """Measures the height of filtered skeletons."""

    NAME = "heights"
    PARAMETERS = (Parameter("margin", 0.1, "what there is above the head joint", unit="m", live=True), RELIABLE)

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        self.inputs = (skeleton_input(graph.FILTERED, values),)
        self.outputs = (Port(HEIGHT, Height(), RELIABLE_QOS, measured=True),)

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        up = payload[0].positions[:, 2]
        if not (np.isfinite(up[Joint.HEAD]) and np.isfinite(up[[Joint.FOOT_LEFT, Joint.FOOT_RIGHT]]).any()):
            return  # of a filter without legs, or of somebody whose head is not seen
        height = float(up[Joint.HEAD] - np.nanmin(up)) + float(str(self.values["margin"]))
        yield Output(HEIGHT, (payload[0].stamp_ns, height), payload[0].stamp_ns)

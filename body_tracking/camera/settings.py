"""What the stages of colour cameras share: parameters, the networks, and the ports of images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

from body_tracking.camera.model_files import default_folder
from body_tracking.camera.people import PersonTracker
from body_tracking.camera.pose_model import PoseModel
from body_tracking.camera.topics import DRIVERS
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.mesh.topics import IMAGES
from body_tracking.messages.codecs import Codec
from body_tracking.pipeline.stage import Port

DRIVER = Parameter(
    "driver", "plain", "the cameras' ROS driver, which says on which topics they publish", choices=tuple(DRIVERS)
)
MODEL = Parameter(
    "model", "", "folder of the networks (`body_tracking camera model` fetches them); empty for the user's cache"
)
PEOPLE = Parameter("people", 1, "the largest number of people per camera", min=1, max=6)
SEARCH = Parameter("search_every", 0.3, "time between two searches for more people", "s", 0.0, 10.0)
THREADS = Parameter("threads", 2, "processors that a network may use", min=1, max=16)
"""Of two, since on slow cores one takes longer for an image than the time between two at 30 Hz (docs/measured.md)."""

WAIT_NS: Final = NANOSECONDS // 10
"""Longest wait of an image for the others of its time."""
_KEPT: Final = 64
"""Images of a topic that wait with the parameter ``reliable``: two seconds, 60 MB in colour at 640x480."""


def trackers_of(values: Mapping[str, Value]) -> Callable[[], PersonTracker]:
    """Makes a camera's tracker of people; all of them share the networks.

    Raises:
        PoseModelError: the networks are not there.
    """
    folder = Path(str(values["model"])).expanduser() if values["model"] else default_folder()
    model = PoseModel(folder, int(str(values["threads"])))
    people, search = int(str(values["people"])), float(str(values["search_every"]))
    return lambda: PersonTracker(model, people, search)


def image_port(topic: str, codec: Codec, values: Mapping[str, Value]) -> Port:
    """The input of a driver's images; with ``reliable`` nothing is left out, however long it takes."""
    leave_out = not values["reliable"]
    waiting = 0 if leave_out else _KEPT
    return Port(topic, codec, IMAGES, waiting, droppable=leave_out, perishable=leave_out, foreign=True)

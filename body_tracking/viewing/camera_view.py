"""The camera system in the viewer: colour images with the people drawn in."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.camera.codecs import CompressedColour
from body_tracking.camera.topics import people_topic
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import FloatArray
from body_tracking.core.sources import check_sensor_name
from body_tracking.markers.setup import camera_names
from body_tracking.messages.codecs import Codec
from body_tracking.viewing.handles import show
from body_tracking.viewing.snapshot import Decode

_PERIOD_S: Final = 0.1
"""Shortest interval between two images of a camera that are sent to the browsers, seconds."""


class CameraView:
    """Images of cameras on the page.

    Args:
        cameras: their names.
        clock: steady time in seconds, to limit the rate.

    Raises:
        SensorNameError: an invalid name.
    """

    body = ""
    layers: Mapping[str, tuple[str, bool]] = {"camera_images": ("camera images", True)}
    held: frozenset[str] = frozenset()

    def __init__(self, cameras: Sequence[str], clock: Callable[[], float] = time.monotonic) -> None:
        self._cameras = tuple(check_sensor_name(each) for each in cameras)
        self._clock = clock
        self._shown: dict[str, Any] = {}
        self._drawn: dict[str, tuple[bytes, float]] = {}
        (self._layer,) = self.layers

    def topics(self, visible: Mapping[str, bool]) -> Mapping[str, Codec]:
        """Topics of the visible layers, with the codecs of their messages."""
        return {people_topic(camera): CompressedColour() for camera in self._cameras if visible[self._layer]}

    def start(self, server: Any) -> None:
        """Create the widgets."""
        black = np.zeros((3, 4, 3), np.uint8)
        with server.gui.add_folder("Cameras", order=0.5):
            self._shown = {camera: server.gui.add_image(black, label=camera, format="jpeg") for camera in self._cameras}

    def draw(
        self,
        recent: Mapping[str, Sequence[bytes]],
        decode: Decode,
        visible: Mapping[str, bool],
        poses: Mapping[str, SensorPose],
    ) -> FloatArray | None:
        """Show the latest image of each camera."""
        for camera, image in self._shown.items():
            show(image, visible[self._layer])
            topic, now = people_topic(camera), self._clock()
            latest = (recent.get(topic, ()) or (b"",))[-1] if visible[self._layer] else b""
            drawn, at = self._drawn.get(camera, (b"", -np.inf))
            if latest and latest != drawn and now - at >= _PERIOD_S:
                self._drawn[camera] = latest, now
                found = decode(topic, latest)
                if found is not None:
                    image.image = found[2]
        return None


class RigView(CameraView):
    """Images of a rig's cameras on the page; the rig's file is in a folder.

    Raises:
        SetupError: no such file.
    """

    layers: Mapping[str, tuple[str, bool]] = {"rig_images": ("images of the rig's cameras", True)}

    def __init__(self, folder: str, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__(camera_names(Path(folder).expanduser()), clock)

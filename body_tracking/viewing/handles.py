"""Skeletons and batches of equal meshes in a viser scene, updated in place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import trimesh
import viser

from body_tracking.core.skeleton import FloatArray, IntArray, Joint
from body_tracking.viewing.colours import Colour, ColourArray, linear
from body_tracking.viewing.shapes import figure, joint_label
from body_tracking.viewing.snapshot import Seen

BALL: Final = trimesh.creation.icosphere(subdivisions=2)
_JOINT_RADIUS: Final = 1e-3
_JOINT: Final = trimesh.creation.icosphere(subdivisions=2, radius=_JOINT_RADIUS)
"""Small before scaling: until a joint is first pointed at, viser's invisible outline of joints takes clicks at the
origin, unscaled. A ball of a metre there caught the clicks on the legs of people behind the reference sensor."""
TUBE: Final = trimesh.creation.cylinder(radius=1.0, height=1.0, sections=16)
STALE: Final[Colour] = (190, 190, 190)
_CROWDED: Final = frozenset({Joint.HAND_LEFT, Joint.THUMB_LEFT, Joint.HAND_RIGHT, Joint.THUMB_RIGHT})
"""Joints so near to the wrist that their names would lie over its own; a click shows them."""


class Drawn:
    """Skeletons of one source: joints as balls, bones as lines; a click on a joint shows or hides its name."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour, radius: float, thickness: float) -> None:
        self._scene, self._name, self._colour, self._thickness = scene, name, colour, thickness
        self._radius = radius
        self._joints = Shapes(scene, f"{name}/joints", _JOINT, colour, clicked=self._on_click)
        self._lines: Any = None
        self._which: IntArray = np.empty((0, 2), np.intp)
        self._named: set[tuple[int, int]] = set()
        self._labels: dict[tuple[int, int], Any] = {}

    def hide(self) -> None:
        self.draw(Seen(), False)

    def draw(self, seen: Seen, visible: bool, names: bool = False) -> None:
        """Update the skeletons.

        Args:
            seen: the skeletons.
            visible: draw them.
            names: show the names of the joints, but of those of a hand only the wrist's and the tip's.
        """
        drawn = figure(seen.skeletons if visible else (), self._colour)
        self._which = drawn.which
        self._draw_names(drawn.joints, names)
        colours: Any = STALE if seen.stale else drawn.joint_colours
        count = len(drawn.joints)
        self._joints.draw(drawn.joints, None, np.full((count, 3), self._radius / _JOINT_RADIUS), colour=colours)
        colour = STALE if seen.stale else self._colour
        if self._lines is None or len(drawn.bones) > len(self._lines.points):
            room = max(24, len(drawn.bones))
            self._lines = self._scene.add_line_segments(
                f"{self._name}/bones", np.zeros((room, 2, 3)), colour, thickness=self._thickness
            )
        # unused lines have length 0
        points = np.zeros_like(self._lines.points)
        points[: len(drawn.bones)] = drawn.bones
        if len(drawn.bones):
            points[len(drawn.bones) :] = drawn.bones[0, 0]
            self._lines.points = points
            self._lines.colors = np.array(colour, np.uint8)
        show(self._lines, bool(len(drawn.bones)))

    def _draw_names(self, joints: FloatArray, everything: bool) -> None:
        keys = [(int(place), int(number)) for place, number in self._which]
        shown = {key for key in keys if everything and key[1] not in _CROWDED} | self._named
        wanted = {key: at for key, at in zip(keys, joints, strict=True) if key in shown}
        for key in self._labels.keys() - wanted.keys():
            self._labels.pop(key).remove()
        for key, at in wanted.items():
            if key not in self._labels:
                self._labels[key] = self._scene.add_label(
                    f"{self._name}/names/{key[0]}_{key[1]}", joint_label(key[1]), anchor="bottom-center"
                )
            self._labels[key].position = at

    def _on_click(self, index: int) -> None:
        which = self._which
        if index < len(which):
            self._named ^= {(int(which[index, 0]), int(which[index, 1]))}


class Shapes:
    """Any number of instances of one mesh, each scaled, rotated and placed."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        mesh: trimesh.Trimesh,
        colour: Colour,
        opacity: float | None = None,
        clicked: Callable[[int], None] | None = None,
    ) -> None:
        self._scene, self._name, self._mesh, self._colour, self._opacity = scene, name, mesh, colour, opacity
        self._clicked = clicked
        self._room = 0
        self._handle: Any = None

    def draw(
        self,
        positions: FloatArray,
        quats_xyzw: FloatArray | None,
        scales: FloatArray,
        colour: Colour | ColourArray | None = None,
    ) -> None:
        """Update all instances.

        Args:
            positions: (n, 3) metres.
            quats_xyzw: (n, 4) unit quaternions; None for all upright.
            scales: (n, 3) along the mesh's own axes.
            colour: of all instances, or (n, 3) of each.
        """
        count = len(positions)
        if count == 0:
            if self._handle is not None:
                show(self._handle, False)
            return
        if count > self._room:
            self._make(max(25, count))
        room = self._room
        # unused instances have size 0
        batch, wxyz, sizes = (np.zeros((room, size), np.float32) for size in (3, 4, 3))
        wxyz[:, 0] = 1.0
        batch[:count], sizes[:count] = positions, scales
        batch[count:] = positions[0]
        if quats_xyzw is not None:
            wxyz[:count] = np.roll(quats_xyzw, 1, axis=1)
        colours = np.zeros((room, 3), np.uint8)
        colours[:count] = linear(self._colour if colour is None else colour)
        handle = self._handle
        handle.batched_positions, handle.batched_scales, handle.batched_colors = batch, sizes, colours
        if quats_xyzw is not None:
            handle.batched_wxyzs = wxyz
        show(handle, True)

    def _make(self, room: int) -> None:
        self._room = room
        self._handle = self._scene.add_batched_meshes_simple(
            self._name,
            self._mesh.vertices,
            self._mesh.faces,
            np.tile([1.0, 0.0, 0.0, 0.0], (room, 1)),
            np.zeros((room, 3)),
            batched_scales=np.zeros((room, 3)),
            batched_colors=np.tile(np.array(self._colour, np.uint8), (room, 1)),
            opacity=self._opacity,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        if (clicked := self._clicked) is not None:

            def on_click(event: viser.SceneNodePointerEvent[Any]) -> None:
                if event.instance_index is not None:
                    clicked(event.instance_index)

            self._handle.on_click(on_click)


def show(handle: Any, visible: bool) -> None:
    if handle.visible != visible:
        handle.visible = visible

"""The page: a viser server with scene, curves and buttons.

All methods but :attr:`Page.watched` must be called from one thread; the server calls the controls from its own threads.
"""

from __future__ import annotations

import html
import time
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
import viser

from body_tracking.core import so3
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import Skeleton
from body_tracking.messages.node_status import NodeStatus
from body_tracking.pipeline.system import Layer, load
from body_tracking.viewing.colours import (
    BODY,
    FILTERED,
    FUSED,
    INFERRED,
    UNCERTAINTY,
    sensor_colours,
)
from body_tracking.viewing.curves import AngleHistory
from body_tracking.viewing.handles import BALL, STALE, TUBE, Drawn, Shapes, show
from body_tracking.viewing.panel import ControlPanel
from body_tracking.viewing.plots import Plots
from body_tracking.viewing.server import address_of, serve, stop
from body_tracking.viewing.shapes import (
    KINECT_VIEW,
    capsules,
    ellipsoids,
    floor_height,
    in_world,
    with_legs,
)
from body_tracking.viewing.snapshot import Controls, Decode, Seen, Snapshot, SystemView
from body_tracking.viewing.status import table

_LAST_S: Final = 0.3
"""Seconds for the browsers to receive the last text."""
WIDTH: Final = 290
"""Width of each panel beside the scene, pixels; the scene keeps 440 of a tablet's 1024."""

_INITIAL_TARGET: Final = np.array([2.2, 0.0, 0.0])
"""Point at which the camera looks before a person is seen: in front of the reference sensor, metres in world."""
_CAMERA_OFFSET: Final = np.array([-3.3, 1.5, 0.9])
"""From the target to the camera's initial position, metres: behind the sensor, to its side and above it."""
_FIELD: Final = float(np.radians(45.0))
"""Vertical angle of view."""
_ARMS: Final = 1.1
"""Metres from the middle of a person with raised arms that are in view, also in a narrow scene ..."""
_ROOM_S: Final = 30.0
"""Seconds in which a browser makes room for the panels."""
_FARTHEST: Final = 4.0
"""... but from no farther away than so many times :data:`_CAMERA_OFFSET`."""

LAYERS: Final[Mapping[str, tuple[str, bool]]] = {
    "sensors": ("skeletons of sensors", True),
    "frustums": ("sensors", True),
    "fused": ("fused skeleton", False),
    "filtered": ("filtered skeleton", True),
    "body": ("body", True),
    "uncertainty": ("95 % ellipsoids", False),
    "frames": ("frames of segments", False),
    "names": ("names of joints", False),
    "floor": ("floor", True),
}
"""Layers of the scene by name: label, and whether it is visible at first."""


class Page:
    """Serves the page.

    Args:
        host: address to listen on.
        port: the first one to try; the next ones are tried where it is in use.
        sensors: their names.
        controls: called when a user presses a button or chooses an option.
        filters: options.
        conventions: options.
        window: seconds that the plots show.
        layers: further layers of the scene, of other systems.
        views: of other systems, from several topics.
        start_page: whether the start page returns at this address when the graph ends.
        plays: whether a bag takes the place of the sensors.

    Attributes:
        visible: which layers are switched on, by name.

    Raises:
        PageError: the address is not one of this machine, or the same-origin check could not be installed.
    """

    def __init__(
        self,
        host: str,
        port: int,
        sensors: Sequence[str],
        controls: Controls,
        filters: Sequence[str],
        conventions: Sequence[str],
        window: float,
        layers: Sequence[Layer] = (),
        views: Sequence[SystemView] = (),
        start_page: bool = False,
        plays: bool = False,
    ) -> None:
        self._server = serve(host, port)
        self._controls = controls
        self._plays = plays
        self._choices = {**LAYERS, **{each.name: (each.text, each.shown) for each in layers}}
        for view in views:
            self._choices |= view.layers
        self._layers, self._views = [(each.name, load(each.draw)) for each in layers], views
        self.visible = {name: shown for name, (_, shown) in self._choices.items()}
        self._floor: float | None = None
        self._target = _INITIAL_TARGET
        self._scene(sensors)
        self._panels(filters, conventions, window, start_page)
        for view in views:
            view.start(self._server)
        self._server.on_client_connect(self._look_at_person)

    @property
    def address(self) -> str:
        """URL of the page."""
        return address_of(self._server)

    @property
    def watched(self) -> int:
        """Number of connected browsers."""
        return len(self._server.get_clients())

    def close(self) -> None:
        """Stop serving."""
        stop(self._server)

    # --- the scene

    def _scene(self, sensors: Sequence[str]) -> None:
        scene = self._server.scene
        scene.set_up_direction("+z")
        self._server.initial_camera.position = tuple(_INITIAL_TARGET + _CAMERA_OFFSET)
        self._server.initial_camera.look_at = tuple(_INITIAL_TARGET)
        self._server.initial_camera.fov = _FIELD
        self._grid = scene.add_grid(
            "/floor",
            12.0,
            12.0,
            cell_size=0.5,
            section_size=1.0,
            cell_color=(228, 230, 234),
            section_color=(205, 209, 215),
            position=(2.0, 0.0, -1.0),
        )
        scene.add_frame("/world", axes_length=0.2, axes_radius=0.006)
        self._drawn: dict[str, Drawn] = {}
        self._cameras: dict[str, Any] = {}
        self._colours = sensor_colours(sensors)
        for sensor, colour in self._colours.items():
            self._drawn[sensor] = Drawn(scene, f"/sensors/{sensor}/skeleton", colour, 0.018, 0.009)
            camera = scene.add_camera_frustum(
                f"/sensors/{sensor}/view",
                fov=float(KINECT_VIEW[1]),
                aspect=float(np.tan(KINECT_VIEW[0] / 2.0) / np.tan(KINECT_VIEW[1] / 2.0)),
                scale=0.18,
                thickness=0.006,
                color=colour,
                visible=False,
                cast_shadow=False,
            )
            scene.add_label(f"/sensors/{sensor}/view/name", sensor, position=(0.0, -0.1, 0.0), anchor="bottom-center")
            self._cameras[sensor] = camera
        self._drawn["fused"] = Drawn(scene, "/fused", FUSED, 0.02, 0.01)
        self._drawn["filtered"] = Drawn(scene, "/filtered", FILTERED, 0.022, 0.014)
        self._limbs = Shapes(scene, "/body/limbs", TUBE, BODY, 0.55)
        self._ends = Shapes(scene, "/body/ends", BALL, BODY, 0.55)
        self._clouds = Shapes(scene, "/uncertainty", BALL, UNCERTAINTY, 0.3)
        self._axes = scene.add_batched_axes(
            "/segments",
            np.array([[1.0, 0.0, 0.0, 0.0]]),
            np.zeros((1, 3)),
            np.zeros(1),
            axes_length=0.12,
            axes_radius=0.005,
        )

    def draw(self, snapshot: Snapshot) -> None:
        """Update the scene."""
        scene = self._server.scene
        with self._server.atomic():
            standing: list[Skeleton] = []
            for sensor, seen in snapshot.sensors.items():
                pose = snapshot.poses.get(sensor)
                camera, drawn = self._cameras[sensor], self._drawn[sensor]
                show(camera, self.visible["frustums"] and pose is not None)
                if pose is None:
                    drawn.hide()
                    continue
                camera.position, camera.wxyz = pose.translation, np.roll(pose.quat_xyzw, 1)
                placed = tuple(in_world(skeleton, pose) for skeleton in seen.skeletons)
                standing += placed if not seen.stale else ()
                drawn.draw(Seen(placed, seen.stale), self.visible["sensors"])
            self._drawn["fused"].draw(snapshot.fused, self.visible["fused"])
            others = (*(() if snapshot.fused.stale else snapshot.fused.skeletons), *standing)
            whole = tuple(with_legs(each, others) for each in snapshot.filtered.skeletons)
            filtered = Seen(whole, snapshot.filtered.stale)
            self._drawn["filtered"].draw(filtered, self.visible["filtered"], self.visible["names"])
            self._draw_body(filtered)
            self._draw_uncertainty(snapshot)
            self._draw_frames(snapshot)
            self._floor = floor_height([*standing, *snapshot.filtered.skeletons], self._floor)
            self._grid.position = (2.0, 0.0, -1.0 if self._floor is None else self._floor)
            show(self._grid, self.visible["floor"])
            for name, draw_layer in self._layers:
                draw_layer(scene, f"/layers/{name}", snapshot.layers.get(name) if self.visible[name] else None)
        bodies = snapshot.filtered.skeletons or tuple(standing)
        if bodies:
            points = np.concatenate([each.positions[each.valid] for each in bodies])
            if len(points):
                self._target = np.median(points, axis=0)

    def draw_views(
        self, recent: Mapping[str, Sequence[bytes]], decode: Decode, poses: Mapping[str, SensorPose]
    ) -> None:
        """Update the views of other systems; arguments as of :meth:`SystemView.draw`."""
        with self._server.atomic():
            for view in self._views:
                where = view.draw(recent, decode, self.visible, poses)
                if where is not None:
                    self._target = where

    def _draw_body(self, seen: Seen) -> None:
        shapes = capsules(seen.skeletons if self.visible["body"] else ())
        colour = STALE if seen.stale else BODY
        radii = shapes.radii
        self._limbs.draw(
            shapes.centres, shapes.quats_xyzw, np.stack([radii, radii, shapes.lengths], axis=1), colour=colour
        )
        self._ends.draw(shapes.ends.reshape(-1, 3), None, np.repeat(radii, 2)[:, None].repeat(3, axis=1), colour=colour)

    def _draw_uncertainty(self, snapshot: Snapshot) -> None:
        """Ellipsoids of the filtered skeleton, or of the fused one if only that is visible."""
        seen = snapshot.filtered if self.visible["filtered"] or not self.visible["fused"] else snapshot.fused
        shapes = ellipsoids(seen.skeletons if self.visible["uncertainty"] and not seen.stale else ())
        self._clouds.draw(shapes.centres, so3.matrix_to_quat(shapes.rotations), shapes.radii)

    def _draw_frames(self, snapshot: Snapshot) -> None:
        show(self._frames_box, bool(len(snapshot.origins)))
        there = len(snapshot.origins) if self.visible["frames"] else 0
        if there and len(self._axes.batched_positions) != there:
            scales, still = np.ones(there), np.tile([1.0, 0.0, 0.0, 0.0], (there, 1))
            self._axes.batched_scales, self._axes.batched_wxyzs = scales.astype(np.float32), still.astype(np.float32)
        if there:
            self._axes.batched_wxyzs = np.roll(snapshot.quats_xyzw, 1, axis=1).astype(np.float32)
            self._axes.batched_positions = snapshot.origins.astype(np.float32)
        show(self._axes, bool(there))

    def _look_at_person(self, client: viser.ClientHandle) -> None:
        """Show the whole person to a new browser, again when it has made room for the panels of this page."""
        width, end = client.camera.image_width, time.monotonic() + _ROOM_S

        def resized(camera: viser.CameraHandle) -> None:
            nonlocal width
            if camera.image_width != width and time.monotonic() < end:
                width = camera.image_width
                self._look(client, width)

        client.camera.on_update(resized)
        # now it has none, or the wider ones of the start page
        self._look(client, width - 2 * WIDTH)
        resized(client.camera)  # it may have changed meanwhile

    def _look(self, client: viser.ClientHandle, width: int) -> None:
        """Look at the person, in a scene of so many pixels in width."""
        target = self._target
        aspect = max(width, 1) / max(client.camera.image_height, 1)
        half_width = float(np.linalg.norm(_CAMERA_OFFSET) * np.tan(_FIELD / 2.0)) * aspect
        with client.atomic():
            client.camera.position = target + min(max(1.0, _ARMS / half_width), _FARTHEST) * _CAMERA_OFFSET
            client.camera.look_at = target

    # --- panels

    def _panels(self, filters: Sequence[str], conventions: Sequence[str], window: float, start_page: bool) -> None:
        gui = self._server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(WIDTH)
        sensors = tuple(self._colours)
        self._panel = ControlPanel(self._server, self._controls, filters, conventions, sensors, start_page, self._plays)
        gui.add_html(self._legend_text())
        with gui.add_folder("Show", expand_by_default=False):
            boxes = {name: self._checkbox(name, label, shown) for name, (label, shown) in self._choices.items()}
        self._frames_box = boxes["frames"]
        self._frames_box.visible = False  # until a filter on a body model runs
        with gui.add_folder("Nodes"):
            self._table = gui.add_html("no diagnostics yet")
        angles = gui.add_panel()
        with angles.add_tab("Joint angles \u00b1 95 %", viser.Icon.CHART_LINE):
            self._plots = Plots(gui, window)
        angles.dock_left()
        angles.set_width(WIDTH)

    def _legend_text(self) -> str:
        entries = [*self._colours.items(), ("filtered", FILTERED), ("inferred or not tracked", INFERRED)]
        dots = "".join(
            f"<span style='white-space:nowrap;margin-right:0.9em'><span style='color:rgb{colour}'>&#9679;</span> "
            f"{html.escape(name)}</span> "
            for name, colour in entries
        )
        return f"<div style='font-size:0.8em;padding:0.3em 0.6em'>{dots}</div>"

    def _checkbox(self, layer: str, label: str, shown: bool) -> Any:
        checkbox: Any = self._server.gui.add_checkbox(label, shown)
        checkbox.on_update(lambda _: self.visible.update({layer: checkbox.value}))
        return checkbox

    # --- slow updates

    def draw_curves(self, history: AngleHistory) -> None:
        """Show the chosen angles."""
        with self._server.atomic():
            self._plots.draw(history, history.age(time.monotonic_ns()))

    def draw_status(self, statuses: Mapping[str, NodeStatus], now: float) -> None:
        """Show the nodes' diagnostics, and the controls of nodes that report."""
        self._panel.draw(statuses, now, ended=False)
        self._table.content = table(statuses, now)

    def draw_end(self, statuses: Mapping[str, NodeStatus]) -> None:
        """Show that the graph has ended; the text stays in the browsers."""
        self._panel.draw(statuses, 0.0, ended=True)
        self._table.content = "ended with the graph"
        self._server.flush()
        time.sleep(_LAST_S)

    def draw_bodies(self, bodies: Sequence[str], chosen: str) -> None:
        """Update the list of persons with angles."""
        self._panel.draw_bodies(bodies, chosen)

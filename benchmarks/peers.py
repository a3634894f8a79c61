"""biorbd's extended Kalman filter and OpenSim's inverse kinematics, on the body of ``upper_body``.

Both are C++ with Python bindings from PyPI (``biorbd``, Fohanno 2010; ``opensim``, Delp 2007 and Seth 2018). They
describe a body as a tree of rigid segments that are joined by successive rotations. A ball joint of ``upper_body`` is
three of them: flexion, abduction and inward rotation at a shoulder (singular at an abduction of 90 degrees), yaw, pitch
and roll at the pelvis.
"""

from __future__ import annotations

import tempfile
import time
import warnings
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import biorbd
import numpy as np
import opensim
from scipy.spatial.transform import Rotation

from body_tracking.core.skeleton import JOINT_NAMES, FloatArray
from body_tracking.kinematics.ranges import RANGES
from body_tracking.kinematics.upper_body import PARENTS, SEGMENTS, UpperBody

_AXES = {
    "pelvis": "+z +y +x",
    "lower_trunk": "+y +x +z",
    "upper_trunk": "+y +x +z",
    "head": "+y +x",
    "clavicle_left": "-z +x",
    "clavicle_right": "+z -x",
    "upper_arm_left": "-y +x -z",
    "upper_arm_right": "-y -x +z",
    "forearm_left": "-y -z",
    "forearm_right": "-y +z",
    "hand_left": "-x -y",
    "hand_right": "+x -y",
}
"""Rotations of each segment against its parent: signed axes, intrinsic, in order."""
_POINTS = {
    "pelvis": ("SpineBase", "HipLeft", "HipRight"),
    "lower_trunk": ("SpineMid",),
    "upper_trunk": ("SpineShoulder", "Neck"),
    "head": ("Head",),
    "clavicle_": ("Shoulder",),
    "upper_arm_": ("Elbow",),
    "forearm_": ("Wrist",),
    "hand_": ("Hand", "HandTip", "Thumb"),
}
"""Points of each segment; names that end with _ are completed by the side."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A rigid segment; at the zero pose all frames are aligned with the world.

    Attributes:
        name: of the segment.
        parent: name of the parent; empty for the base, which is free.
        origin: (3,) metres, in the parent's frame.
        names: of its two or three rotations.
        axes: a letter for each: its axis, intrinsic.
        signs: 1 or -1 for each: the direction in which the model counts the angle.
        points: name and place (3,), metres, of each point that moves with it.
    """

    name: str
    parent: str
    origin: FloatArray
    names: tuple[str, ...]
    axes: str
    signs: FloatArray
    points: dict[str, FloatArray]


class Tree:
    """The body of one person, with 32 coordinates: position, yaw, pitch and roll of the base, and 26 angles.

    They have the order and the signs of the model's tangent.

    Args:
        model: the body.
        lengths: (21,) metres.

    Attributes:
        segments: 12, parents first.
        names: of the coordinates.
    """

    def __init__(self, model: UpperBody, lengths: FloatArray) -> None:
        self._model = model
        shoulders = {"x": "flexion", "y": "abduction", "z": "rotation"}
        names = [*model.coordinate_names[:3], "base_yaw", "base_pitch", "base_roll", *model.coordinate_names[6:]]
        for number, name in enumerate(names):
            if name.startswith("shoulder_"):
                _, axis, side = name.split("_")
                names[number] = f"shoulder_{shoulders[axis]}_{side}"
        self.names = tuple(names)
        zero = model.forward(model.neutral(), lengths)
        places = dict(zip((JOINT_NAMES[joint] for joint in model.joints), zero.positions, strict=True))
        self.segments = []
        for number, (name, parent) in enumerate(zip(SEGMENTS, PARENTS, strict=True)):
            side = name.rsplit("_", 1)[-1]
            points = _POINTS.get(name) or [each + side.title() for each in _POINTS[name.removesuffix(side)]]
            axes = _AXES[name].split()
            self.segments.append(
                Segment(
                    name,
                    "" if parent < 0 else SEGMENTS[parent],
                    zero.origins[number] - zero.origins[max(parent, 0)],
                    self.names[model.segment_coordinates[number]],
                    "".join(axis[1] for axis in axes),
                    np.array([float(f"{axis[0]}1") for axis in axes]),
                    {point: places[point] - zero.origins[number] for point in points},
                )
            )
        self._balls = [
            (model.quaternion_of(each.name), turned, each)
            for each, turned in zip(self.segments, model.segment_coordinates, strict=True)
            if each.name in ("pelvis", "upper_arm_left", "upper_arm_right")
        ]
        self.order = [JOINT_NAMES[joint] for joint in model.joints]

    def coordinates(self, q: FloatArray) -> FloatArray:
        """(n, 32) coordinates of (n, 35) configurations of the model."""
        found = np.empty((len(q), self._model.nv))
        found[:, :3] = q[:, :3]
        found[:, self._model.scalar_v] = q[:, self._model.scalar_q]
        for quaternion, where, segment in self._balls:
            found[:, where] = segment.signs * Rotation.from_quat(q[:, quaternion]).as_euler(segment.axes.upper())
        return found

    def configurations(self, coordinates: FloatArray) -> FloatArray:
        """(n, 35) configurations of the model of (n, 32) coordinates."""
        q = np.empty((len(coordinates), self._model.nq))
        q[:, :3] = coordinates[:, :3]
        q[:, self._model.scalar_q] = coordinates[:, self._model.scalar_v]
        for quaternion, where, segment in self._balls:
            angles = segment.signs * coordinates[:, where]
            q[:, quaternion] = Rotation.from_euler(segment.axes.upper(), angles).as_quat()
        return q


# --- biorbd


def _text(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers)


def biomod(tree: Tree, locked: Collection[str] = ()) -> str:
    """The body as a bioMod file (version 4), without the rotations ``locked``, which stay zero."""
    lines = ["version 4"]
    for each in tree.segments:
        free = "".join(axis for axis, name in zip(each.axes, each.names, strict=True) if name not in locked)
        lines += [f"segment {each.name}", f"parent {each.parent or 'base'}", f"rt 0 0 0 xyz {_text(each.origin)}"]
        lines += ["translations xyz"] * (not each.parent)
        # the parser needs masses, the kinematics does not
        lines += [f"rotations {free}", "mass 1", "inertia 0.01 0 0 0 0.01 0 0 0 0.01", "com 0 0 0", "endsegment"]
    for name in tree.order:
        segment = next(each for each in tree.segments if name in each.points)
        place = _text(segment.points[name])
        lines += [f"marker {name}", f"parent {segment.name}", f"position {place}", "technical 1", "endmarker"]
    return "\n".join(lines) + "\n"


class BiorbdEkf:
    """``biorbd.KalmanReconsMarkers``: an extended Kalman filter of coordinates, rates and accelerations.

    Its process noise is a white jerk of unit density on every coordinate, so that the noise of the points tunes it. It
    has no limits of angles and states no covariance.

    Args:
        tree: the body.
        rate: frames per second.
        noise: variance of a coordinate of a point, relative to the process noise (``noiseFactor``).
        error: initial variance of coordinates, rates and accelerations (``errorFactor``).
        start: (32,) coordinates of the first frame; zero if None.
        locked: names of rotations that stay zero.
    """

    def __init__(
        self,
        tree: Tree,
        rate: float,
        noise: float,
        error: float,
        start: FloatArray | None = None,
        locked: Collection[str] = (),
    ) -> None:
        self._signs = np.concatenate([np.ones(3), *(each.signs for each in tree.segments)])
        self._free = np.flatnonzero([name not in locked for name in tree.names])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "upper_body.bioMod"
            path.write_text(biomod(tree, locked))
            self._model = biorbd.Model(str(path))
        self._filter = biorbd.KalmanReconsMarkers(self._model, biorbd.KalmanParam(rate, noise, error))
        zero = np.zeros(self._model.nbQ())
        # all three: a new GeneralizedVelocity is not initialised
        self._filter.setInitState(zero if start is None else (start * self._signs)[self._free], zero, zero)

    def positions(self, coordinates: FloatArray) -> FloatArray:
        """(n, 19, 3) metres: the points by its own forward kinematics, at (n, 32) coordinates."""
        theirs = (coordinates * self._signs)[:, self._free]
        return np.array([[marker.to_array() for marker in self._model.markers(each)] for each in theirs])

    def run(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 32) coordinates, and (n,) seconds of processor time, from (n, 19, 3) metres; NaN where missing."""
        kinds = biorbd.GeneralizedCoordinates, biorbd.GeneralizedVelocity, biorbd.GeneralizedAcceleration
        state = tuple(kind(self._model) for kind in kinds)
        found, seconds = np.zeros((len(positions), len(self._signs))), np.empty(len(positions))
        for frame, points in enumerate(positions):
            started = time.process_time()
            self._filter.reconstructFrame(self._model, points.ravel(), *state)
            found[frame, self._free] = state[0].to_array()
            seconds[frame] = time.process_time() - started
        return found * self._signs, seconds


# --- OpenSim


def _vec3(numbers: FloatArray) -> Any:
    return opensim.Vec3(*map(float, numbers))


class OpenSimIk:
    """``opensim.InverseKinematicsSolver``: each frame by itself, from the pose of the frame before; all points weigh 1.

    Args:
        tree: the body.
        accuracy: of the solver; the default of OpenSim's tool is 1e-5.
        limited: whether angles are limited to the ranges of motion.
        prior: weight of a coordinate task that draws every angle to zero; 0 for none.
        start: (32,) coordinates of the first frame; zero if None.
    """

    def __init__(
        self, tree: Tree, accuracy: float, limited: bool = False, prior: float = 0.0, start: FloatArray | None = None
    ) -> None:
        opensim.Logger.removeFileSink()  # it would write opensim.log into the current folder
        opensim.Logger.setLevelString("Error")
        self._tree, self._accuracy, self._prior = tree, accuracy, prior
        # Its joints turn about their own x, then y, then z. ``matrix @ ours`` are its coordinates.
        self._matrix = np.zeros((len(tree.names), len(tree.names)))
        self._model = self._built(limited)
        self._state = self._model.initSystem()
        self._pose(np.arange(len(tree.names)) * 1e-3, self._model.getCoordinateSet(), tree.names)
        # the places of the coordinates in the solver's own order
        held = np.rint(1e3 * self._state.getQ().to_numpy()).astype(int)
        self._places = np.array([np.flatnonzero(held == number)[0] for number in range(len(tree.names))])
        self._set(np.zeros(len(tree.names)) if start is None else start)

    def _built(self, limited: bool) -> Any:
        model, bodies, tree = opensim.Model(), {}, self._tree
        for each in tree.segments:
            body = bodies[each.name] = opensim.Body(each.name, 1.0, opensim.Vec3(0), opensim.Inertia(0.01, 0.01, 0.01))
            model.addBody(body)
            first, second = (each.signs[k] * np.eye(3)["xyz".index(each.axes[k])] for k in (0, 1))
            frame = np.column_stack([first, second, np.cross(first, second)])
            with warnings.catch_warnings():  # the angles of a quarter turn are not unique, and any will do
                warnings.filterwarnings("ignore", "Gimbal lock")
                turned = _vec3(Rotation.from_matrix(frame).as_euler("XYZ"))
            parent, make = model.getGround(), opensim.FreeJoint
            names = each.names
            if each.parent:
                parent, make = bodies[each.parent], (opensim.UniversalJoint, opensim.GimbalJoint)[len(names) - 2]
            else:
                names += tree.names[:3]
                self._matrix[:3, :3] = frame.T
            joint = make(f"{each.name}_joint", parent, _vec3(each.origin), turned, body, opensim.Vec3(0), turned)
            for number, name in enumerate(names):
                joint.upd_coordinates(number).setName(name)
            model.addJoint(joint)
            for number, (name, axis) in enumerate(zip(each.names, each.axes, strict=True)):
                sign = each.signs[number] * frame["xyz".index(axis), number]
                self._matrix[tree.names.index(name), tree.names.index(name)] = sign
        for point in tree.order:
            segment = next(each for each in tree.segments if point in each.points)
            model.addMarker(opensim.Marker(point, bodies[segment.name], _vec3(segment.points[point])))
        model.finalizeConnections()
        for number, name in enumerate(tree.names if limited else ()):
            bounds = RANGES.get(name.removesuffix("_left").removesuffix("_right"))
            if bounds is not None:
                low, high = sorted(self._matrix[number].sum() * np.radians(bounds))
                coordinate = model.updCoordinateSet().get(name)
                coordinate.setRangeMin(low)
                coordinate.setRangeMax(high)
                coordinate.setDefaultClamped(True)
        return model

    def _pose(self, values: FloatArray, coordinates: Any, names: Collection[str]) -> None:
        for name, value in zip(names, values, strict=True):
            coordinates.get(name).setValue(self._state, float(value), False)

    def _set(self, coordinates: FloatArray) -> None:
        self._pose(self._matrix @ coordinates, self._model.getCoordinateSet(), self._tree.names)

    def positions(self, coordinates: FloatArray) -> FloatArray:
        """(n, 19, 3) metres: the points by its own forward kinematics, at (n, 32) coordinates."""
        found = np.empty((len(coordinates), len(self._tree.order), 3))
        for frame, each in enumerate(coordinates):
            self._set(each)
            self._model.realizePosition(self._state)
            for number, name in enumerate(self._tree.order):
                found[frame, number] = self._model.getMarkerSet().get(name).getLocationInGround(self._state).to_numpy()
        return found

    def run(self, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """(n, 32) coordinates, and (n,) seconds of processor time, from (n, 19, 3) metres; NaN where missing."""
        table, labels = opensim.TimeSeriesTableVec3(), opensim.StdVectorString()
        weights, tasks = opensim.SetMarkerWeights(), opensim.SimTKArrayCoordinateReference()
        for name in self._tree.order:
            labels.append(name)
            weights.cloneAndAppend(opensim.MarkerWeight(name, 1.0))
        table.setColumnLabels(labels)
        for frame, points in enumerate(positions):
            row = opensim.RowVectorVec3(len(points))
            for number, point in enumerate(points):
                row[number] = _vec3(point)
            table.appendRow(float(frame), row)
        for name in self._tree.names[6:] if self._prior > 0.0 else ():
            task = opensim.CoordinateReference(name, opensim.Constant(0.0))
            task.setWeight(self._prior)
            tasks.push_back(task)
        solver = opensim.InverseKinematicsSolver(self._model, opensim.MarkersReference(table, weights), tasks)
        solver.setAccuracy(self._accuracy)
        found, seconds = np.empty((len(positions), len(self._places))), np.empty(len(positions))
        for frame in range(len(positions)):
            started = time.process_time()
            self._state.setTime(float(frame))
            (solver.track if frame else solver.assemble)(self._state)
            found[frame] = self._state.getQ().to_numpy()[self._places]
            seconds[frame] = time.process_time() - started
        return found @ self._matrix, seconds

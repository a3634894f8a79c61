"""OpenSim's inverse kinematics (C++, PyPI ``opensim``; Delp 2007, Seth 2018) on the same body."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import opensim
from scipy.spatial.transform import Rotation

from body_tracking.skeleton import FloatArray
from peers.tree import Segment, Tree


def _joint_frame(segment: Segment) -> FloatArray:
    """(3, 3) frame of a native joint, which turns about its own x, then y, then z, in the segment's frame."""
    first, second = (segment.signs[number] * np.eye(3)["xyz".index(segment.axes[number])] for number in (0, 1))
    return np.column_stack([first, second, np.cross(first, second)])


def _vec3(numbers: FloatArray) -> Any:

    return opensim.Vec3(*(float(number) for number in numbers))


def to_opensim(tree: Tree) -> FloatArray:
    """(32, 32) ``opensim = matrix @ tree`` of coordinates, in the same order: a signed permutation.

    The third rotation of a joint may be counted the other way round, and the base's position is told in the frame of
    its joint.
    """
    matrix = np.zeros((len(tree.names), len(tree.names)))
    for segment in tree.segments:
        frame = _joint_frame(segment)
        if segment.parent is None:
            matrix[:3, :3] = frame.T
        for number, (name, axis) in enumerate(zip(segment.names, segment.axes, strict=True)):
            place = tree.names.index(name)
            matrix[place, place] = segment.signs[number] * frame["xyz".index(axis), number]
    return matrix


def osim_model(tree: Tree, limits: Mapping[str, tuple[float, float]] | None = None) -> Any:
    """The body as an ``opensim.Model``; its ``printToXML`` writes the .osim file.

    The joints are native ones (free, gimbal, universal) in turned frames. Custom joints with the tree's own axes find
    the same poses, and take up to 40 % longer.

    Args:
        tree: the body.
        limits: radians, (least, greatest) of coordinates by name, which are then clamped.
    """
    model = opensim.Model()
    model.setName("upper_body")
    bodies = {}
    for segment in tree.segments:
        body = opensim.Body(segment.name, 1.0, opensim.Vec3(0), opensim.Inertia(0.01, 0.01, 0.01))
        model.addBody(body)
        bodies[segment.name] = body
        with warnings.catch_warnings():  # the angles of a quarter turn are not unique, and any will do
            warnings.filterwarnings("ignore", "Gimbal lock")
            turned = _vec3(Rotation.from_matrix(_joint_frame(segment)).as_euler("XYZ"))
        names = segment.names
        if segment.parent is None:
            parent, make = model.getGround(), opensim.FreeJoint
            names += tree.names[:3]
        else:
            parent, make = bodies[segment.parent], (opensim.UniversalJoint, opensim.GimbalJoint)[len(names) - 2]
        joint = make(f"{segment.name}_joint", parent, _vec3(segment.origin), turned, body, opensim.Vec3(0), turned)
        for number, name in enumerate(names):
            joint.upd_coordinates(number).setName(name)
        model.addJoint(joint)
    for marker in tree.markers:
        model.addMarker(opensim.Marker(marker.name, bodies[marker.segment], _vec3(marker.place)))
    model.finalizeConnections()
    signs = to_opensim(tree).sum(axis=1)
    for name, bounds in (limits or {}).items():
        low, high = sorted(float(signs[tree.names.index(name)] * bound) for bound in bounds)
        coordinate = model.updCoordinateSet().get(name)
        coordinate.setRangeMin(low)
        coordinate.setRangeMax(high)
        coordinate.setDefaultClamped(True)
    return model


class OpenSimIk:
    """``opensim.InverseKinematicsSolver``: each frame by itself, from the pose of the frame before it.

    All markers weigh 1. A missing point is NaN to it and left out of the sum.
    """

    def __init__(
        self,
        tree: Tree,
        accuracy: float,
        limits: Mapping[str, tuple[float, float]] | None = None,
        prior: float = 0.0,
        start: FloatArray | None = None,
    ) -> None:
        """Prepare a run.

        Args:
            tree: the body.
            accuracy: of the solver; the inverse kinematics tool's default is 1e-5.
            limits: as of :func:`osim_model`.
            prior: weight of a coordinate task that draws every joint angle to zero; 0 for none.
            start: (32,) coordinates to start from; without, from zero.
        """
        opensim.Logger.removeFileSink()  # or it leaves an opensim.log wherever it runs
        opensim.Logger.setLevelString("Error")
        self._tree, self._accuracy, self._prior = tree, accuracy, prior
        self._theirs = to_opensim(tree)
        self._model = osim_model(tree, limits)
        self._state = self._model.initSystem()
        coordinates = self._model.getCoordinateSet()
        # where the state's vector of coordinates, in the solver's own order, holds each
        for number, name in enumerate(tree.names):
            coordinates.get(name).setValue(self._state, 1e-3 * (number + 1), False)
        held = np.rint(1e3 * self._state.getQ().to_numpy()).astype(int)
        self._places = np.array([np.flatnonzero(held == number + 1)[0] for number in range(len(tree.names))])
        self._pose(np.zeros(len(tree.names)) if start is None else start)

    def _pose(self, coordinates: FloatArray) -> None:
        for name, value in zip(self._tree.names, self._theirs @ coordinates, strict=True):
            self._model.getCoordinateSet().get(name).setValue(self._state, float(value), False)

    def positions(self, coordinates: FloatArray) -> FloatArray:
        """(n, 19, 3) the points by OpenSim's own forward kinematics, at the tree's coordinates (n, 32)."""
        found = np.empty((len(coordinates), len(self._tree.markers), 3))
        for frame, each in enumerate(coordinates):
            self._pose(each)
            self._model.realizePosition(self._state)
            for number, marker in enumerate(self._tree.markers):
                place = self._model.getMarkerSet().get(marker.name).getLocationInGround(self._state)
                found[frame, number] = place.to_numpy()
        return found

    def run(self, times: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Solve every frame of a recording.

        Args:
            times: (n,) seconds.
            positions: (n, 19, 3) metres, NaN where a point is missing.

        Returns:
            (n, 32) coordinates of the tree; (n,) seconds of processor time of each frame.
        """
        table = opensim.TimeSeriesTableVec3()
        labels = opensim.StdVectorString()
        weights = opensim.SetMarkerWeights()
        for marker in self._tree.markers:
            labels.append(marker.name)
            weights.cloneAndAppend(opensim.MarkerWeight(marker.name, 1.0))
        table.setColumnLabels(labels)
        for instant, points in zip(times, positions, strict=True):
            row = opensim.RowVectorVec3(len(points))
            for number, point in enumerate(points):
                row[number] = _vec3(point)
            table.appendRow(float(instant), row)
        tasks = opensim.SimTKArrayCoordinateReference()
        if self._prior > 0.0:
            for name in self._tree.names[6:]:
                task = opensim.CoordinateReference(name, opensim.Constant(0.0))
                task.setWeight(self._prior)
                tasks.push_back(task)
        solver = opensim.InverseKinematicsSolver(self._model, opensim.MarkersReference(table, weights), tasks)
        solver.setAccuracy(self._accuracy)

        state, places = self._state, self._places
        found, seconds = np.empty((len(times), len(places))), np.empty(len(times))
        for frame, instant in enumerate(times):
            started = time.process_time()
            state.setTime(float(instant))
            if frame == 0:
                solver.assemble(state)
            else:
                solver.track(state)
            found[frame] = state.getQ().to_numpy()[places]
            seconds[frame] = time.process_time() - started
        return found @ self._theirs, seconds

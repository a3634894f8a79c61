"""The model ``upper_body`` with compiled kinematics of one configuration at a time.

The functions of :class:`UpperBody` handle any number of configurations as arrays, and take a millisecond for a single
one. Importing this module imports numba, which takes half a second.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from body_tracking.core.body_model import Linearisation, ModelError, Posture
from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.kinematics.upper_body import AXES, LENGTHS, ORIGINS, PARENTS, POINTS, UpperBody

_NV, _NL = 32, 21
_SMALL = 1e-8


class Tree(NamedTuple):
    """The tree of segments as arrays of integers; an axis or a direction is a column of the rotation and a sign.

    Attributes:
        parents: (12,).
        coordinates: (12, 2) first coordinate of the tangent that turns a segment, and the one after the last.
        configuration: (12,) index of a segment's first angle, or of its quaternion, in the configuration.
        ball: (12,) 1 where a segment turns freely.
        axes: (32, 2) column and sign of the axis of each coordinate.
        origins: (12,) the point at the origin of each segment.
        points: (12, 2) first point of a segment, and the one after the last, in ``order``.
        order: (19,) points in the order of their segments.
        parts: (19, 2) first part of a point's position in its segment, and the one after the last.
        part: (n, 3) index of the length, column and sign of each part.
    """

    parents: IntArray
    coordinates: IntArray
    configuration: IntArray
    ball: IntArray
    axes: IntArray
    origins: IntArray
    points: IntArray
    order: IntArray
    parts: IntArray
    part: IntArray


@compiled
def exp(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """The unit quaternion xyzw of a rotation vector."""
    half = 0.5 * math.sqrt(x * x + y * y + z * z)
    factor = 0.5 * math.sin(half) / half if half > _SMALL else 0.5
    return factor * x, factor * y, factor * z, math.cos(half)


@compiled
def integrated(q: FloatArray, v: FloatArray, tree: Tree) -> FloatArray:
    """(35,) the configuration moved by a tangent vector (32,)."""
    moved = q.copy()
    moved[0] += v[0]
    moved[1] += v[1]
    moved[2] += v[2]
    for segment in range(len(tree.parents)):
        first, end = tree.coordinates[segment, 0], tree.coordinates[segment, 1]
        place = tree.configuration[segment]
        if tree.ball[segment]:
            bx, by, bz, bw = exp(v[first], v[first + 1], v[first + 2])
            ax, ay, az, aw = q[place], q[place + 1], q[place + 2], q[place + 3]
            x = aw * bx + bw * ax + ay * bz - az * by
            y = aw * by + bw * ay + az * bx - ax * bz
            z = aw * bz + bw * az + ax * by - ay * bx
            w = aw * bw - ax * bx - ay * by - az * bz
            size = math.sqrt(x * x + y * y + z * z + w * w)
            moved[place], moved[place + 1] = x / size, y / size
            moved[place + 2], moved[place + 3] = z / size, w / size
        else:
            for k in range(end - first):
                moved[place + k] += v[first + k]
    return moved


@compiled
def placed(q: FloatArray, lengths: FloatArray, tree: Tree) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Forward kinematics.

    Returns:
        (19, 3) points, (12, 3, 3) rotations of the segments, (32, 3) axes of the coordinates, all in world.
    """
    rotations = np.empty((len(tree.parents), 3, 3))
    axes = np.zeros((len(tree.axes), 3))
    positions = np.empty((len(tree.order), 3))
    for segment in range(len(tree.parents)):
        first, end = tree.coordinates[segment, 0], tree.coordinates[segment, 1]
        place, parent = tree.configuration[segment], tree.parents[segment]
        r = rotations[segment]
        if tree.ball[segment]:
            x, y, z, w = q[place], q[place + 1], q[place + 2], q[place + 3]
            own = np.empty((3, 3))
            own[0, 0], own[0, 1], own[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
            own[1, 0], own[1, 1], own[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
            own[2, 0], own[2, 1], own[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
            if parent < 0:
                r[:] = own
            else:
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for k in range(3):
                            total += rotations[parent, i, k] * own[k, j]
                        r[i, j] = total
            for k in range(3):
                for i in range(3):
                    axes[first + k, i] = r[i, k]
        else:
            r[:] = rotations[parent]
            for k in range(first, end):
                column, sign = tree.axes[k, 0], tree.axes[k, 1]
                for i in range(3):
                    axes[k, i] = sign * r[i, column]
                angle = sign * q[place + k - first]
                sine, cosine = math.sin(angle), math.cos(angle)
                b, c = (column + 1) % 3, (column + 2) % 3
                for i in range(3):
                    rb, rc = r[i, b], r[i, c]
                    r[i, b], r[i, c] = cosine * rb + sine * rc, cosine * rc - sine * rb
        for number in range(tree.points[segment, 0], tree.points[segment, 1]):
            point = tree.order[number]
            for i in range(3):
                # the base's frame is at its own point, which has no parts
                total = q[i] if parent < 0 else positions[tree.origins[segment], i]
                for k in range(tree.parts[point, 0], tree.parts[point, 1]):
                    total += tree.part[k, 2] * lengths[tree.part[k, 0]] * r[i, tree.part[k, 1]]
                positions[point, i] = total
    return positions, rotations, axes


@compiled
def linearised(
    q: FloatArray, lengths: FloatArray, tree: Tree
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Forward kinematics and its derivatives.

    Returns:
        (19, 3) points, (12, 3, 3) rotations, (32, 3) axes, (57, 53) derivative of the points by tangent and lengths,
        (12, 3, 32) angular velocities of the segments per tangent velocity.
    """
    positions, rotations, axes = placed(q, lengths, tree)
    observation = np.zeros((3 * len(positions), _NV + _NL))
    turning = np.zeros((len(rotations), 3, _NV))
    for segment in range(len(tree.parents)):
        parent, origin = tree.parents[segment], tree.origins[segment]
        if parent >= 0:
            turning[segment] = turning[parent]
        for k in range(tree.coordinates[segment, 0], tree.coordinates[segment, 1]):
            for i in range(3):
                turning[segment, i, k] = axes[k, i]
        for number in range(tree.points[segment, 0], tree.points[segment, 1]):
            point = tree.order[number]
            row = 3 * point
            for i in range(3):
                observation[row + i, i] = 1.0
                if parent >= 0:
                    for k in range(_NV, _NV + _NL):
                        observation[row + i, k] = observation[3 * origin + i, k]
                for k in range(tree.parts[point, 0], tree.parts[point, 1]):
                    observation[row + i, _NV + tree.part[k, 0]] += (
                        tree.part[k, 2] * rotations[segment, i, tree.part[k, 1]]
                    )
            ancestor = segment
            while ancestor >= 0:
                centre = tree.origins[ancestor]
                x = positions[point, 0] - positions[centre, 0]
                y = positions[point, 1] - positions[centre, 1]
                z = positions[point, 2] - positions[centre, 2]
                for k in range(tree.coordinates[ancestor, 0], tree.coordinates[ancestor, 1]):
                    a, b, c = axes[k, 0], axes[k, 1], axes[k, 2]
                    observation[row, k] = b * z - c * y
                    observation[row + 1, k] = c * x - a * z
                    observation[row + 2, k] = a * y - b * x
                ancestor = tree.parents[ancestor]
    return positions, rotations, axes, observation, turning


@compiled
def curved(observation: FloatArray, axes: FloatArray, covariance: FloatArray, tree: Tree) -> FloatArray:
    """(19, 3) metres: half the sum over pairs of coordinates of covariance times second derivative of the points.

    The second derivative is the outer axis x (derivative by the inner coordinate); for two coordinates of one ball
    joint both orders count by half.
    """
    count = len(observation) // 3
    result = np.zeros((count, 3))
    chain = np.empty(_NV, dtype=np.int64)
    joint = np.empty(_NV, dtype=np.int64)
    for segment in range(len(tree.parents)):
        size = 0
        ancestor = segment
        while ancestor >= 0:
            for k in range(tree.coordinates[ancestor, 0], tree.coordinates[ancestor, 1]):
                chain[size], joint[size] = k, ancestor if tree.ball[ancestor] else -1
                size += 1
            ancestor = tree.parents[ancestor]
        for number in range(tree.points[segment, 0], tree.points[segment, 1]):
            row = 3 * tree.order[number]
            for outer in range(size):
                k = chain[outer]
                x, y, z = 0.0, 0.0, 0.0
                for inner in range(size):
                    m = chain[inner]
                    if m == k or (joint[inner] >= 0 and joint[inner] == joint[outer]):
                        weight = 0.5 * covariance[k, m]
                    elif m > k:
                        weight = covariance[k, m]
                    else:
                        continue
                    x += weight * observation[row, m]
                    y += weight * observation[row + 1, m]
                    z += weight * observation[row + 2, m]
                a, b, c = axes[k, 0], axes[k, 1], axes[k, 2]
                point = row // 3
                result[point, 0] += b * z - c * y
                result[point, 1] += c * x - a * z
                result[point, 2] += a * y - b * x
    return result


def _tree(model: UpperBody) -> Tree:
    axes = np.zeros((model.nv, 2), dtype=np.intp)
    coordinates = np.array([[part.start, part.stop] for part in model.segment_coordinates], dtype=np.intp)
    place, configuration = 3, []
    for joint, (first, end) in zip(AXES, coordinates.tolist(), strict=True):
        configuration.append(place)
        place += 4 if joint is None else end - first
        for number, (_, axis) in enumerate(joint or ()):
            column = int(np.abs(axis).argmax())
            axes[first + number] = column, int(axis[column])
    segments = [model.segment_names.index(name) for _, name, _ in POINTS]
    order = np.argsort(segments, kind="stable").astype(np.intp)
    ends = np.cumsum(np.bincount(segments, minlength=len(PARENTS)))
    parts = [len(own) for _, _, own in POINTS]
    point_of = {joint: number for number, (joint, _, _) in enumerate(POINTS)}
    part = [
        (LENGTHS.index(name), int(np.abs(axis).argmax()), int(axis.sum())) for _, _, own in POINTS for name, axis in own
    ]
    return Tree(
        np.array(PARENTS, dtype=np.intp),
        coordinates,
        np.array(configuration, dtype=np.intp),
        np.array([joint is None for joint in AXES], dtype=np.intp),
        axes,
        np.array([point_of[joint] for joint in ORIGINS], dtype=np.intp),
        np.stack([np.append(0, ends[:-1]), ends], axis=1).astype(np.intp),
        order,
        np.stack([np.cumsum(parts) - parts, np.cumsum(parts)], axis=1).astype(np.intp),
        np.array(part, dtype=np.intp),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Linearised(Linearisation):
    """The linearisation of one configuration.

    Attributes:
        axes: (32, 3) of the coordinates, in world.
        observation: (57, 53) derivative of the points by tangent and lengths.
    """

    axes: FloatArray
    observation: FloatArray


class CompiledUpperBody(UpperBody):
    """:class:`UpperBody`; a single configuration takes some microseconds.

    Attributes:
        tree: for compiled functions.
    """

    def __init__(self) -> None:
        super().__init__()
        self.tree = _tree(self)
        self._average = self.default_lengths()

    def integrate(self, q: FloatArray, v: FloatArray) -> FloatArray:
        if q.ndim == v.ndim == 1:
            return integrated(q, v, self.tree)
        return super().integrate(q, v)

    def forward(self, q: FloatArray, lengths: FloatArray) -> Posture:
        if q.ndim != 1 or lengths.ndim != 1:
            return super().forward(q, lengths)
        self._check(q, lengths)
        positions, rotations, _ = placed(q, lengths, self.tree)
        return Posture(positions, positions[self.tree.origins], rotations)

    def linearise(self, q: FloatArray, lengths: FloatArray) -> Linearisation:
        return super().linearise(q, lengths) if q.ndim != 1 or lengths.ndim != 1 else self.linearised(q, lengths)

    def linearised(self, q: FloatArray, lengths: FloatArray) -> Linearised:
        """:meth:`linearise` of one configuration: both derivatives of the points are parts of one array."""
        self._check(q, lengths)
        positions, rotations, axes, observation, turning = linearised(q, lengths, self.tree)
        derivative = observation.reshape(-1, 3, _NV + _NL)
        posture = Posture(positions, positions[self.tree.origins], rotations)
        return Linearised(posture, derivative[..., :_NV], derivative[..., _NV:], turning, axes, observation)

    def curvature(self, lines: Linearisation, covariance: FloatArray) -> FloatArray:
        if isinstance(lines, Linearised):
            return curved(lines.observation, lines.axes, covariance, self.tree)
        return super().curvature(lines, covariance)

    def turning(self, q: FloatArray, segment: int) -> tuple[FloatArray, FloatArray]:
        if q.ndim != 1:
            return super().turning(q, segment)
        _, rotations, _, _, turning = linearised(q, self._average, self.tree)
        return rotations[segment], turning[segment]

    def _check(self, q: FloatArray, lengths: FloatArray) -> None:
        if len(q) != self.nq:
            raise ModelError(f"upper_body: a configuration of {len(q)} numbers, expected {self.nq}")
        if len(lengths) != len(LENGTHS):
            raise ModelError(f"upper_body: {len(lengths)} segment lengths, expected {len(LENGTHS)}")

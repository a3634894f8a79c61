"""biorbd's extended Kalman filter (C++, PyPI ``biorbd``; Fohanno 2010) on the same body."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Collection
from pathlib import Path

import biorbd
import numpy as np

from body_tracking.skeleton import FloatArray
from peers.tree import Tree


def biomod(tree: Tree, locked: Collection[str] = ()) -> str:
    """The body as a bioMod file (version 4).

    Args:
        tree: the body. Its masses are there for the parser; the kinematics does not use them.
        locked: names of angles that the file leaves out, which keeps them at zero.
    """
    lines = ["version 4"]
    for segment in tree.segments:
        free = "".join(axis for axis, name in zip(segment.axes, segment.names, strict=True) if name not in locked)
        lines += [
            f"segment {segment.name}",
            f"  parent {segment.parent or 'base'}",
            f"  rt 0 0 0 xyz {' '.join(repr(float(number)) for number in segment.origin)}",
            *(["  translations xyz"] if segment.parent is None else []),
            f"  rotations {free}",
            "  mass 1",
            "  inertia 0.01 0 0 0 0.01 0 0 0 0.01",
            "  com 0 0 0",
            "endsegment",
        ]
    for marker in tree.markers:
        lines += [
            f"marker {marker.name}",
            f"  parent {marker.segment}",
            f"  position {' '.join(repr(float(number)) for number in marker.place)}",
            "  technical 1",
            "endmarker",
        ]
    return "\n".join(lines) + "\n"


class BiorbdEkf:
    """``biorbd.KalmanReconsMarkers``, a Kalman filter on coordinates, rates and accelerations.

    Its process noise is a white jerk of unit density on every coordinate (rad2/s5 and m2/s5 alike) and cannot be set,
    so that ``noise`` is the one thing that tunes it. Angles have no limits in it, and their estimate no covariance
    that could be read. A missing point is NaN to it (or zero) and left out of the update.
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
        """Prepare a run.

        Args:
            tree: the body.
            rate: frames per second.
            noise: variance of a coordinate of a point, against the unit process noise (``noiseFactor``).
            error: initial variance of all coordinates, rates and accelerations (``errorFactor``).
            start: (32,) coordinates to start from; without, from zero.
            locked: names of angles that stay zero.
        """
        self._signs = np.concatenate([np.ones(3), tree.signs])
        self._free = np.array([number for number, name in enumerate(tree.names) if name not in locked])
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "upper_body.bioMod"
            path.write_text(biomod(tree, locked))
            self._model = biorbd.Model(str(path))
        self._filter = biorbd.KalmanReconsMarkers(self._model, biorbd.KalmanParam(rate, noise, error))
        zero = np.zeros(self._model.nbQ())
        state = zero if start is None else self._theirs(start)
        # All three, and arrays: a fresh biorbd.GeneralizedVelocity holds whatever the memory held.
        self._filter.setInitState(state, zero, zero)
        self._state = (
            biorbd.GeneralizedCoordinates(self._model),
            biorbd.GeneralizedVelocity(self._model),
            biorbd.GeneralizedAcceleration(self._model),
        )

    def _theirs(self, coordinates: FloatArray) -> FloatArray:
        """(..., free) coordinates with the signs of biorbd, whose axes are all positive."""
        theirs: FloatArray = (coordinates * self._signs)[..., self._free]
        return theirs

    def positions(self, coordinates: FloatArray) -> FloatArray:
        """(n, 19, 3) the points by biorbd's own forward kinematics, at the tree's coordinates (n, 32)."""
        return np.array(
            [[marker.to_array() for marker in self._model.markers(each)] for each in self._theirs(coordinates)]
        )

    def run(self, times: FloatArray, positions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Filter a recording.

        Args:
            times: (n,) seconds; the filter takes them for equally spaced.
            positions: (n, 19, 3) metres, NaN where a point is missing.

        Returns:
            (n, 32) coordinates of the tree; (n,) seconds of processor time of each frame.
        """
        found, seconds = np.empty((len(times), self._model.nbQ())), np.empty(len(times))
        filter_, model, state = self._filter, self._model, self._state
        for frame, points in enumerate(positions):
            started = time.process_time()
            filter_.reconstructFrame(model, points.ravel(), *state)
            found[frame] = state[0].to_array()
            seconds[frame] = time.process_time() - started
        coordinates = np.zeros((len(times), len(self._signs)))
        coordinates[:, self._free] = found
        return coordinates * self._signs, seconds

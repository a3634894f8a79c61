"""The mesh fitted to real depth images: a Kinect v2's of a walker, and 34 views of one person who turns.

``rms`` is the distance point to plane of the measured points from the surface, millimetres, over the points within
60 mm of it; their share is ``points``; ``rms of all`` is over all points. ``overlap`` is the intersection over the
union of the rendered mesh and the person's mask, over the measured pixels. The mask of ``kinect_depth`` also has specks
of the treadmill: its largest piece is used, after an opening by 5 pixels.

The views of ``depth_turn`` are tracked as a sequence of 10 images per second: with the mean person's body, then with
the person's body from six of the views; figures are of the other 28. ``torso`` is the angle between the rotations of
the thorax and of the camera between two views, degrees, median over all pairs of views; it includes the person's own
bending and twisting, and varies with the six views: its bar is of the median over ten choices of them. In the last row
the person is found without the masks.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import common
import cv2
import numpy as np
from common import recordings, report, verdicts

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, SingleArray
from body_tracking.mesh.body_index import NO_BODY
from body_tracking.mesh.body_model import Body, load
from body_tracking.mesh.depth import DepthCamera, to_metres
from body_tracking.mesh.energy import Observation
from body_tracking.mesh.personalisation import Person, personalise
from body_tracking.mesh.raster import render
from body_tracking.mesh.solver import Fit, MeshFitter
from body_tracking.mesh.tracking import MeshTracker, observe_person
from body_tracking.simulation.depth_scene import kinect_camera

SETS = ((0, 6, 11, 17, 23, 28), (3, 9, 14, 20, 26, 31))
"""Two disjoint sets of views for the person's shape, each about 60 degrees apart."""
_VIEWS = 34
_RNG = np.random.default_rng(5)
DRAWN = [tuple(sorted(_RNG.choice(_VIEWS, 6, replace=False).tolist())) for _ in range(8)]
"""Further choices of six views for the turn of the torso, which one choice alone gives to half a degree."""
_RATE = 10.0
"""Images per second: the benchmark uses every third image of a sequence at about 30."""


class View(NamedTuple):
    """An image of the turning person.

    Attributes:
        depth: (480, 640) metres, 0 where missing.
        mask: (480, 640) the person's pixels.
        turn: (3, 3) rotation from the camera's axes to the person's.
    """

    depth: SingleArray
    mask: BoolArray
    turn: FloatArray


class Shown(NamedTuple):
    """The observation of the person in one image, and the fit."""

    observation: Observation
    fit: Fit


def figures_of(shown: Shown, mask: BoolArray, faces: Any) -> dict[str, float]:
    """The figures of one fit."""
    seen, fit = shown
    offsets = ((fit.matches.places - seen.points) * fit.matches.normals).sum(axis=1)
    mesh = render(fit.posed.vertices, faces, seen.camera).depth > 0.0
    known = seen.depth > 0.0
    return {
        "rms": 1e3 * fit.rms,
        "rms of all": 1e3 * common.rms(offsets),
        "points": fit.matched,
        "overlap": float((mesh & mask & known).sum() / ((mesh | mask) & known).sum()),
    }


def largest_piece(mask: BoolArray) -> BoolArray:
    """The largest piece of a mask, after an opening."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5), np.uint8))
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(opened, connectivity=4)
    return np.asarray(labels == 1 + statistics[1:, cv2.CC_STAT_AREA].argmax())


def walker(folder: Path) -> dict[str, dict[str, float]]:
    """The Kinect's image, by a search: with the mean person's body, and with a shape from this one image."""
    files = recordings(folder, ("lab_004378_depth.png", "lab_004378_mask.png"))
    pixels, masked = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files)
    depth = to_metres(pixels)
    mask = largest_piece((masked > 0) & (depth > 0.0))
    seen = observe_person(DepthCamera(kinect_camera()), depth, mask, 600)
    model = load()
    first = MeshFitter(model.body()).search(seen)
    own = personalise(model, [seen], [first.pose]).fits[0]
    fits = {"mean person": first, "own shape": own}
    return {name: figures_of(Shown(seen, fit), mask, model.faces) for name, fit in fits.items()}


def read_views(folder: Path) -> list[View]:
    """The views, in the order in which the person turned."""
    numbers = range(0, 3 * _VIEWS, 3)
    kinds = ("depth.png", "mask.jpg", "camera.xml")
    files = recordings(folder, (f"{number:010}_{kind}" for number in numbers for kind in kinds))
    views = []
    for image, mask, camera in zip(files[::3], files[1::3], files[2::3], strict=True):
        storage = cv2.FileStorage(str(camera), cv2.FILE_STORAGE_READ)
        pixels, grey = cv2.imread(str(image), cv2.IMREAD_UNCHANGED), cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        views.append(View(to_metres(pixels), grey > 127, storage.getNode("R").mat().astype(float)))
        storage.release()
    return views


def tracked(
    views: Sequence[View], view: DepthCamera, body: Body, covariance: FloatArray, *, masked: bool = True
) -> dict[int, Shown]:
    """The views with a tracked person, by number."""
    tracker, found = MeshTracker(view, body, covariance), {}
    for number, (depth, mask, _) in enumerate(views):
        index = np.where(mask, 0, NO_BODY).astype(np.uint8) if masked else None
        result = tracker.update(round(number / _RATE * NANOSECONDS), depth, index)
        if result is not None:
            assert tracker.observation is not None
            found[number] = Shown(tracker.observation, result.fit)
    return found


def person_of(views: dict[int, Shown], chosen: Iterable[int], body: Body) -> Person:
    """The person's shape from the chosen views in which they were tracked."""
    used = [views[number] for number in chosen if number in views]
    return personalise(body.model, [each.observation for each in used], [each.fit.pose for each in used])


def torso(views: Sequence[View], shown: dict[int, Shown], chosen: Sequence[int], thorax: int) -> dict[str, float]:
    """Angles between the rotations of thorax and camera, degrees: medians over all pairs, and over neighbours."""
    turns = {number: views[number].turn @ shown[number].fit.frames[thorax] for number in chosen if number in shown}

    def median(pairs: Iterable[tuple[FloatArray, FloatArray]]) -> float:
        apart = np.array([first.T @ second for first, second in pairs])
        return float(np.median(np.degrees(np.linalg.norm(so3.rotation_vectors(apart), axis=1))))

    return {"torso": median(combinations(turns.values(), 2)), "neighbours": median(pairwise(turns.values()))}


def turning(folder: Path) -> dict[str, Any]:
    """The turning person: figures of the views that were not used for the shape, and shoulder widths."""
    views = read_views(folder)
    matrix = np.array([[525.0, 0.0, 320.0], [0.0, 525.0, 240.0], [0.0, 0.0, 1.0]])
    view = DepthCamera(Camera("depth_turn", 640, 480, matrix, np.zeros(5)))
    mean = load().body()
    model, unknown = mean.model, np.eye(len(mean.shape))
    thorax = model.index("spine3")
    shoulders = [model.index("left_shoulder"), model.index("right_shoulder")]
    rest = [number for number in range(len(views)) if number not in SETS[0]]
    first = tracked(views, view, mean, unknown)
    people = [person_of(first, chosen, mean) for chosen in SETS]
    own = people[0]
    runs = {
        "mean person": first,
        "own shape": tracked(views, view, own.body, own.covariance),
        "own shape, no masks": tracked(views, view, own.body, own.covariance, masked=False),
    }
    rows = {}
    for name, shown in runs.items():
        each = [figures_of(shown[n], views[n].mask, model.faces) for n in rest if n in shown]
        medians = {figure: float(np.median([one[figure] for one in each])) for figure in each[0]}
        rows[name] = {**medians, **torso(views, shown, rest, thorax), "lost": len(rest) - len(each)}
    torsos = [rows["own shape"]["torso"]]
    for chosen in (SETS[1], *DRAWN):
        other = person_of(first, chosen, mean)
        shown = tracked(views, view, other.body, other.covariance)
        torsos.append(torso(views, shown, [n for n in range(len(views)) if n not in chosen], thorax)["torso"])
    widths = [1e3 * float(np.linalg.norm(np.diff(each.body.joints[shoulders], axis=0))) for each in people]
    spread = {"median": float(np.median(torsos)), "least": min(torsos), "most": max(torsos)}
    return {"views": rows, "shoulder widths, mm": widths, "torso by ten choices of six views": spread}


def main() -> int:
    arguments = common.parser(__doc__, data=True).parse_args()
    kinect = walker(arguments.data / "kinect_depth")
    turn = turning(arguments.data / "depth_turn")
    report(arguments, {"kinect_depth": kinect, "depth_turn": turn})
    own, widths = turn["views"]["own shape"], turn["shoulder widths, mm"]
    return verdicts(
        arguments,
        {
            "kinect_depth: 16 mm RMS": all(each["rms"] <= 16.0 for each in kinect.values()),
            "kinect_depth: silhouettes overlap by 0.78": all(each["overlap"] >= 0.78 for each in kinect.values()),
            "depth_turn: median of 20 mm RMS, none lost": own["rms of all"] <= 20.0 and own["lost"] == 0,
            "depth_turn: torso within 5 deg": turn["torso by ten choices of six views"]["median"] <= 5.0,
            "depth_turn: shoulder widths within 15 mm": abs(widths[0] - widths[1]) <= 15.0,
        },
    )


if __name__ == "__main__":
    sys.exit(main())

"""Cameras around a room, calibrated alone by boards and placed by a waved wand.

Cameras like Gaschler's (834 pixels of focal length, 640x480) stand on a circle of 2 m, look at its centre, and are each
calibrated with 13 boards of their own (noise of 0.06 pixels). A wand of 0.45 m with three balls (noise of 0.1 pixels,
one sighting in a hundred wrong) is waved in the middle. The poses relative to the first camera are compared with the
true ones: RMS of turn and translation (3D), the share of errors within 1.96 stated standard deviations, and the RMS of
errors over stated standard deviations; with the lenses' covariance as a prior, as in ``markers wand``, and with fixed
lenses.
"""

from __future__ import annotations

import sys
from typing import Any

import common
import numpy as np
from scipy.linalg import block_diag

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import projection
from body_tracking.markers.bundle import Corners
from body_tracking.markers.bundle_points import Sightings
from body_tracking.markers.camera_calibration import calibrate_cameras
from body_tracking.markers.rig import POSE, Rig
from body_tracking.markers.wand import Wand, calibrate_wand

ROOMS = (2, 4, 8)
PLACES = (60, 240)
WAND = Wand((0.0, 0.15, 0.45))
RADIUS, BETWEEN = 2.0, np.radians(35.0)
"""Distance of the cameras from the middle, metres, and angle between neighbours seen from there, radians."""
BOARDS, CORNER_NOISE, BALL_NOISE, WRONG = 13, 0.06, 0.1, 0.01
INSIDE_BAR, RATIO_BAR = (88.0, 99.5), 1.4


def room(count: int) -> Rig:
    """Cameras on an arc; the rig's frame is that of the first."""
    matrix = np.array([[834.0, 0.0, 318.0], [0.0, 834.0, 245.0], [0.0, 0.0, 1.0]])
    lens = np.array([-0.236, 0.304, 0.0, 0.0, 0.0])
    cameras = tuple(Camera(f"camera{index}", 640, 480, matrix, lens) for index in range(count))
    turns = so3.quat_to_matrix(so3.exp(np.outer(BETWEEN * np.arange(count), [0.0, 1.0, 0.0])))
    middle = np.array([0.0, 0.0, RADIUS])
    size = 15 * count
    return Rig(cameras, turns, middle - turns @ middle, np.zeros((size, size)))


def lens_of(camera: Camera, rng: np.random.Generator) -> Rig:
    """The camera as calibrated with its own boards."""
    board = np.stack([*np.meshgrid(0.04 * np.arange(9), 0.04 * np.arange(6)), np.zeros((6, 9))], axis=-1).reshape(-1, 3)
    seen: list[FloatArray] = []
    while len(seen) < BOARDS:
        turn = so3.quat_to_matrix(so3.exp(rng.uniform(-0.6, 0.6, 3)))
        place = rng.uniform([-0.25, -0.2, 0.7], [0.25, 0.2, 1.3])
        pixels = camera.project((board - board.mean(axis=0)) @ turn.T + place)
        if camera.contains(pixels).all():
            seen.append(pixels + rng.normal(0.0, CORNER_NOISE, pixels.shape))
    views = np.repeat(np.arange(BOARDS), len(board))
    corners = Corners(np.zeros_like(views), views, np.tile(board, (BOARDS, 1)), np.concatenate(seen))
    return calibrate_cameras([camera.frame_id], [(camera.width, camera.height)], corners).rig


def waved(truth: Rig, places: int, rng: np.random.Generator) -> Sightings:
    """Sightings of the wand's balls in the cameras that see all of them."""
    middle = np.array([0.0, 0.0, RADIUS]) + rng.uniform(-0.5, 0.5, (places, 3))
    along = rng.normal(size=(places, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    balls = middle[:, None] + (np.array(WAND.places) - 0.5 * WAND.places[-1])[:, None] * along[:, None]
    pixels = truth.project(balls)
    pixels += rng.normal(0.0, BALL_NOISE, pixels.shape)
    seen = np.stack([camera.contains(each) for camera, each in zip(truth.cameras, pixels, strict=True)])
    wrong = rng.random(seen.shape) < WRONG
    pixels[wrong] = rng.uniform([0.0, 0.0], [640.0, 480.0], (int(wrong.sum()), 2))
    seen &= seen.all(axis=-1, keepdims=True)
    cameras, views, points = np.nonzero(seen)
    return Sightings(cameras, views, points, pixels[seen])


def errors(truth: Rig, found: Rig) -> tuple[FloatArray, FloatArray]:
    """(n - 1, 6) errors of turn and translation, radians and metres, and the stated standard deviations."""
    turn = so3.rotation_vectors(truth.rotations @ found.rotations.transpose(0, 2, 1))
    wrong = np.concatenate([turn, truth.translations - found.translations], axis=1)
    stated = np.sqrt(np.diag(found.covariance))
    ends = projection.offsets(found)[1:]
    return wrong[1:], np.stack([stated[end - POSE : end] for end in ends])[1:]


def calibration(job: tuple[int, int, int]) -> dict[str, tuple[FloatArray, FloatArray]]:
    """Errors and deviations in a room (numbers of cameras, places and draw), with a prior and with fixed lenses."""
    count, places, number = job
    rng = np.random.default_rng([number, count, places, 34])
    truth = room(count)
    lenses = [lens_of(camera, rng) for camera in truth.cameras]
    cameras = [each.cameras[0] for each in lenses]
    covariance = np.asarray(block_diag(*(each.covariance for each in lenses)))
    seen = waved(truth, places, rng)
    return {
        "prior": errors(truth, calibrate_wand(cameras, seen, WAND, covariance).rig),
        "held": errors(truth, calibrate_wand(cameras, seen, WAND).rig),
    }


def pooled(results: list[dict[str, tuple[FloatArray, FloatArray]]]) -> dict[str, dict[str, float]]:
    """The figures of one kind of room."""
    rows = {}
    for name in results[0]:
        wrong, stated = (np.concatenate([each[name][part] for each in results]) for part in range(2))
        ratio = wrong / stated
        rows[name] = {
            "turn, deg": float(np.degrees(common.rms(np.linalg.norm(wrong[:, :3], axis=1)))),
            "translation, mm": 1e3 * common.rms(np.linalg.norm(wrong[:, 3:], axis=1)),
            "inside, %": float(100.0 * np.mean(np.abs(ratio) <= 1.96)),
            "over stated": common.rms(ratio),
        }
    return rows


def main() -> int:
    """The benchmark."""
    parser = common.parser(__doc__, jobs=True)
    parser.add_argument("--draws", type=int, default=10, metavar="N", help="of each room (default: %(default)s)")
    args = parser.parse_args()
    figures: dict[str, Any] = {}
    kinds = [(count, places) for count in ROOMS for places in PLACES]
    jobs = [(*kind, number) for kind in kinds for number in range(args.draws)]
    results = common.mapped(calibration, jobs, args.jobs)
    for index, (count, places) in enumerate(kinds):
        own = results[index * args.draws : (index + 1) * args.draws]
        figures[f"{count} cameras, {places} places of the wand"] = pooled(own)
    common.report(args, figures)
    met = {}
    for title, rows in figures.items():
        row = rows["prior"]
        met[f"{title}: {row['inside, %']:.1f} % inside, {INSIDE_BAR[0]:g} or more"] = row["inside, %"] >= INSIDE_BAR[0]
        met[f"{title}: errors over stated {row['over stated']:.2f}, at most {RATIO_BAR:g}"] = (
            row["over stated"] <= RATIO_BAR
        )
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

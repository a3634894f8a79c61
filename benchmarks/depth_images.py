"""A real depth image of a Kinect v2 beside simulated ones.

``noise`` is the standard deviation from second differences of neighbours, by distance; ``holes`` the share of missing
pixels of the image; ``outline zeros`` the share within 2 pixels of the person's outline; ``rim`` the share of the
pixels at the rim of the person's mask whose depth differs by more than 40 mm from the mask two pixels inside. ``rim
kept`` and ``inside kept`` are the shares of those pixels, and of the pixels inside, left after rejection of flying
pixels.
"""

from __future__ import annotations

import sys

import common
import cv2
import numpy as np
from common import recordings, report, verdicts
from mesh_runs import people

from body_tracking.core.skeleton import BoolArray, SingleArray
from body_tracking.mesh.depth import supported, to_metres
from body_tracking.simulation.depth_scene import DepthScene, held_out

MOTIONS = ("two_handed_wave", "walking_and_turning", "reaching")


def statistics(depth: SingleArray, mask: BoolArray) -> dict[str, float]:
    """The figures of one image with the person's mask."""
    there = depth > 0.0
    second = np.abs(depth[:, 2:] - 2.0 * depth[:, 1:-1] + depth[:, :-2]).astype(float)
    whole = there[:, 2:] & there[:, 1:-1] & there[:, :-2]
    found = {}
    for low, high in ((1.6, 2.4), (3.0, 4.0)):
        chosen = second[whole & (depth[:, 1:-1] > low) & (depth[:, 1:-1] < high)]
        found[f"noise at {low} to {high} m, mm"] = 1e3 * 1.4826 * float(np.median(chosen)) / np.sqrt(6.0)
    ones = np.ones((3, 3), np.uint8)
    own = (mask & there).astype(np.uint8)
    closed = cv2.morphologyEx(own, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    band = (cv2.dilate(closed, ones, iterations=2) > 0) & (cv2.erode(closed, ones, iterations=2) == 0)
    rim = (own > 0) & (cv2.erode(own, ones) == 0) & (cv2.erode(closed, ones) == 0)
    inner = cv2.erode(own, ones, iterations=2) > 0
    near = np.full(depth.shape, np.nan)
    for row, column in np.argwhere(rim):
        block = slice(max(row - 4, 0), row + 5), slice(max(column - 4, 0), column + 5)
        if inner[block].any():
            near[row, column] = np.median(depth[block][inner[block]])
    judged = rim & np.isfinite(near)
    off = np.abs(depth - near) > 0.04
    good = supported(depth)
    return {
        **found,
        "holes": float((~there).mean()),
        "outline zeros": float((~there)[band].mean()),
        "rim": float(off[judged].mean()),
        "rim kept": float(good[judged & off].mean()),
        "inside kept": float(good[inner].mean()),
    }


def main() -> int:
    arguments = common.parser(__doc__, seeds=4, data=True).parse_args()
    makehuman = people()
    files = recordings(arguments.data / "kinect_depth", ("lab_004378_depth.png", "lab_004378_mask.png"))
    pixels, masked = (cv2.imread(str(file), cv2.IMREAD_UNCHANGED) for file in files)
    depth, mask = to_metres(pixels), masked > 0
    real, simulated = statistics(depth, mask), []
    for seed in range(arguments.seeds):
        scene = DepthScene(held_out(makehuman, seed), MOTIONS[seed % len(MOTIONS)], seed, table=seed % 2 == 1)
        simulated += [statistics(to_metres(frame.image), frame.person) for frame in scene.frames(3.0, 6.0, 30)]
    figures = {
        name: {"real": real[name], "simulated": float(np.nanmedian([each[name] for each in simulated]))}
        for name in real
    }
    report(arguments, figures)
    within = {
        f"{name}: simulated within a factor of two of the real one": 0.5 <= each["simulated"] / each["real"] <= 2.0
        for name, each in figures.items()
        if "kept" not in name
    }
    return verdicts(arguments, within)


if __name__ == "__main__":
    sys.exit(main())

"""Overlays of the marker system: detected balls with their targets' names in an image, and the chain in space."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.skeleton import FloatArray, IntArray
from body_tracking.markers.chain import Chain
from body_tracking.markers.observations import ImageBalls, TargetPose
from body_tracking.markers.rig import Rig
from body_tracking.markers.targets import Target

Colour = tuple[int, int, int]
NO_TARGET: Final[Colour] = (235, 235, 235)
"""Colour of balls that belong to no target."""
_NEAR_PX: Final = 4.0
"""Largest distance in pixels between a target's projected ball and its detection; the error is tenths, a ball's radius
3 or more."""


def targets_of_balls(
    rig: Rig, camera: int, pixels: FloatArray, targets: Mapping[str, Target], poses: Sequence[TargetPose]
) -> IntArray:
    """Which target each ball in an image belongs to.

    Args:
        rig: the cameras.
        camera: index of the image's camera.
        pixels: (n, 2) of the balls.
        targets: by name.
        poses: of the visible targets, in the rig's frame.

    Returns:
        (n,) index of the pose, -1 for a ball of no target.
    """
    found = np.full(len(pixels), -1, dtype=np.intp)
    nearest = np.full(len(pixels), _NEAR_PX)
    for index, pose in enumerate(poses):
        balls = targets[pose.name].points @ pose.rotation.T + pose.translation
        apart = np.linalg.norm(pixels[:, None] - rig.project(balls)[camera], axis=-1)
        closest = np.where(np.isfinite(apart), apart, np.inf).min(axis=1, initial=np.inf)
        better = closest < nearest
        found[better], nearest[better] = index, closest[better]
    return found


def annotate(
    image: NDArray[Any], balls: ImageBalls | None, owners: IntArray, names: Sequence[str], colours: Sequence[Colour]
) -> NDArray[np.uint8]:
    """The image in colour, with a circle around each ball and the name of each target above its balls.

    Args:
        image: (height, width) uint8 or uint16.
        balls: detected in the image; None for the bare image.
        owners: (n,) index of the target of each ball, -1 for none.
        names: of the targets.
        colours: of the targets, RGB.
    """
    # 16 bit images: sensors use either the upper bits or the lower 10 to 12
    shift = max(0, int(image.max(initial=0)).bit_length() - 8) if image.dtype == np.uint16 else 0
    drawn: NDArray[np.uint8] = np.repeat((image >> shift).astype(np.uint8)[:, :, None], 3, axis=2)
    if balls is None:
        return drawn
    for pixel, area, owner in zip(balls.pixels, balls.areas, owners.tolist(), strict=True):
        centre = round(float(pixel[0])), round(float(pixel[1]))
        colour = NO_TARGET if owner < 0 else colours[owner]
        cv2.circle(drawn, centre, int(np.sqrt(max(area, 0.0) / np.pi)) + 4, colour, 2, cv2.LINE_AA)
    for index, (name, colour) in enumerate(zip(names, colours, strict=True)):
        own = balls.pixels[owners == index]
        if len(own):
            left, top = own.min(axis=0).astype(int).tolist()
            place = left, max(24, top - 14)
            cv2.putText(drawn, name, place, cv2.FONT_HERSHEY_SIMPLEX, 0.8, colour, 2, cv2.LINE_AA)
    return drawn


def chain_places(chain: Chain, poses: Sequence[TargetPose]) -> tuple[FloatArray, FloatArray]:
    """Joint centres and segments of the chain from its visible targets; a joint without a visible target is omitted.

    Returns:
        (j, 3) centres of the joints, the mean of both estimates where both targets are visible; (n, 2, 3) lines from
        each target to its joints.
    """
    seen = {pose.name: pose for pose in poses}
    centres, lines = [], []
    for joint in chain.joints:
        ends, places = [], []
        for name, centre in ((joint.parent, joint.parent_centre), (joint.child, joint.child_centre)):
            if name in seen:
                ends.append(seen[name].translation)
                places.append(seen[name].rotation @ centre + seen[name].translation)
        if places:
            middle = np.mean(places, axis=0)
            centres.append(middle)
            lines += [np.stack([end, middle]) for end in ends]
    return np.array(centres).reshape(-1, 3), np.array(lines).reshape(-1, 2, 3)

"""``body_tracking camera``: the networks that find people in images, and pictures of what they find."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.camera import model_files
from body_tracking.camera.pictures import draw
from body_tracking.camera.pose_model import Landmarks, PoseModel
from body_tracking.core.errors import BodyTrackingError
from body_tracking.recording.picture import write_picture

_ROUNDS: Final = 3
"""Number of searches in a single image, each in the region of the previous result, as in a video."""


class CameraCommandError(BodyTrackingError):
    """Raised when an image cannot be read."""


def people_in(image: NDArray[np.uint8], model: PoseModel, people: int) -> list[Landmarks]:
    """The people in a single image (height, width, 3) of red, green, blue."""
    found = []
    for detected in model.detect(image)[:people]:
        region = detected
        for _ in range(_ROUNDS):
            landmarks = model.find(image, region)
            region = landmarks.next_region
        if landmarks.presence > 0.5:
            found.append(landmarks)
    return found


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking camera``."""
    command = subparsers.add_parser(
        "camera", description="The networks that find people in images, and pictures of what they find."
    )
    actions = command.add_subparsers(metavar="ACTION", required=True)
    text = "fetch the networks, if they are not there (MediaPipe's, Apache licence 2.0; 35 MB by pip)"
    model = actions.add_parser("model", help=text, description=text)
    model.add_argument("folder", type=Path, nargs="?", metavar="FOLDER", help="where to (default: the user's cache)")
    model.set_defaults(run=_model)
    text = "draw the people in an image"
    show = actions.add_parser("show", help=text, description=text)
    show.add_argument("image", type=Path, metavar="IMAGE", help="PNG or JPEG file")
    show.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="picture to write")
    show.add_argument("--people", type=int, default=6, metavar="N", help="the largest number of people (default: 6)")
    show.add_argument("--pose-model", type=Path, metavar="FOLDER", help="folder of the networks")
    show.set_defaults(run=_show)


def _model(args: argparse.Namespace) -> int:
    folder = args.folder or model_files.default_folder()
    if not model_files.are_whole(folder):
        print("fetching MediaPipe's networks by pip (35 MB)")
        model_files.fetch(folder)
    print(f"networks: {folder}")
    return 0


def _show(args: argparse.Namespace) -> int:
    if not args.image.is_file():  # OpenCV would print a line of its own
        raise CameraCommandError(f"{args.image}: {'not an image' if args.image.exists() else 'no such file'}")
    model = PoseModel(args.pose_model or model_files.default_folder())
    pixels: Any = cv2.imread(str(args.image), cv2.IMREAD_COLOR)
    if pixels is None:
        raise CameraCommandError(f"{args.image}: not an image")
    image = np.ascontiguousarray(pixels[..., ::-1])
    found = people_in(image, model, max(args.people, 1))
    for each in found:
        draw(image, each)
    write_picture(args.output, image)
    print(f"people: {len(found)}\npicture: {args.output}")
    return 0

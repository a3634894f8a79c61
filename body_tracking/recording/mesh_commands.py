"""``body_tracking mesh``: the shape of a person from a recording, and pictures of the mesh over depth images."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import check_new
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.mesh.codecs import DepthImage, MeshMarker
from body_tracking.mesh.picture import overlay
from body_tracking.mesh.stage import MeshStage
from body_tracking.mesh.topics import body_index_topic, depth_topic, info_topic, mesh_topic
from body_tracking.messages.cdr import stamp_of
from body_tracking.messages.codecs import CameraInfo
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.picture import write_picture
from body_tracking.recording.progress import Progress
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE

_SIDE: Final = 360
"""Side of a drawn image, pixels."""


class MeshCommandError(BodyTrackingError):
    """Raised when a recording cannot be used."""


def _messages(bag: RigReader, camera: str, *more: str) -> Iterator[tuple[str, bytes, int]]:
    """Topic, message and log time of the images and the calibration of a depth camera, and of more topics.

    Raises:
        MeshCommandError: a topic is missing.
    """
    topics = (info_topic(camera), depth_topic(camera), *more)
    for topic in topics:
        if topic not in bag.topics:
            made = f", which replay --depth {camera} makes" if topic == mesh_topic(camera) else ""
            raise MeshCommandError(f"{bag.path}: no topic {topic}{made}; {graph.listed(bag.topics)}")
    for raw in bag.messages(topics):
        yield raw.topic, raw.cdr, raw.log_time_ns


def personalise(bag_path: Path, camera: str, out: Path) -> str:
    """Estimate the shape of the person in a recording, as ``mesh_tracker`` does, and write it.

    Returns:
        A line about the estimated shape.

    Raises:
        MeshCommandError: no depth images, or too few different poses.
        PersonFileError: the file cannot be written.
    """
    stage = MeshStage(check_all(MeshStage.PARAMETERS, {"camera": camera}), lambda topic: False)
    sensor = stage.sensor
    runner = OfflineRunner((stage,), BAG_WIRE, lambda topic, cdr, at_ns: None)
    with RigReader(bag_path) as bag:
        progress = Progress(bag.start_ns, bag.end_ns)
        bodies = body_index_topic(camera)
        for topic, cdr, at_ns in _messages(bag, camera, *([bodies] if bodies in bag.topics else [])):
            runner.push(topic, cdr, at_ns)
            progress.at(at_ns)
            if sensor.counters["personalisations"]:
                break
        progress.end()
    for problem in runner.problems:
        print(f"warning: {problem}", file=sys.stderr)
    if not sensor.counters["personalisations"]:
        counted = ", ".join(f"{name}: {count}" for name, count in sorted(sensor.counters.items()))
        raise MeshCommandError(f"{bag_path}: too few different poses of a person, or nobody was tracked ({counted})")
    sensor.save_to(out)
    return stage.events[-1]


def pictures(recording: Path, camera: str, count: int) -> list[NDArray[np.uint8]]:
    """Depth images of the person, evenly spaced over a recording; below each a copy with the mesh drawn over it.

    Args:
        recording: with depth images and the mesh.
        camera: its name.
        count: largest number of images.

    Raises:
        MeshCommandError: depth images or meshes are missing.
    """
    info: Camera | None = None
    images: dict[int, bytes] = {}
    meshes: dict[int, Any] = {}
    with RigReader(recording) as bag:
        for topic, cdr, _ in _messages(bag, camera, mesh_topic(camera)):
            if topic == info_topic(camera):
                info = CameraInfo().decode(cdr, BAG_WIRE)
            elif topic == mesh_topic(camera):
                stamp_ns, _, corners = MeshMarker().decode(cdr, BAG_WIRE)
                meshes[stamp_ns] = corners
            else:
                images[stamp_of(cdr)] = cdr
    both = sorted(images.keys() & meshes.keys())
    if info is None or not both:
        raise MeshCommandError(f"{recording}: no depth image with a mesh of its time")
    chosen = np.unique(np.linspace(0, len(both) - 1, count).round().astype(int))
    found = []
    for stamp_ns in (both[number] for number in chosen):
        depth, corners = DepthImage().decode(images[stamp_ns], BAG_WIRE)[2], meshes[stamp_ns]
        box = _box(info.project(corners.reshape(-1, 3)), info)
        size = _SIDE, _SIDE
        column = [
            np.asarray(cv2.resize(overlay(depth, each, info)[box], size, interpolation=cv2.INTER_NEAREST), np.uint8)
            for each in (corners[:0], corners)
        ]
        text = f"{(stamp_ns - both[0]) / NANOSECONDS:.1f} s"
        column[0][-40:, :100] = 0  # readable on any ground
        cv2.putText(column[0], text, (8, _SIDE - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2, cv2.LINE_AA)
        found.append(np.concatenate(column))
    return found


def _box(pixels: FloatArray, camera: Camera) -> tuple[slice, slice]:
    """The square about pixels, with a margin, within the image."""
    low, high = np.nanmin(pixels, axis=0), np.nanmax(pixels, axis=0)
    side = int(min(1.15 * float((high - low).max()) + 4.0, camera.width, camera.height))
    left, top = np.clip(0.5 * (low + high - side), 0, [camera.width - side, camera.height - side]).astype(int).tolist()
    return slice(top, top + side), slice(left, left + side)


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking mesh``."""
    command = subparsers.add_parser(
        "mesh", description="The shape of a person from a recording, and pictures of the mesh over depth images."
    )
    actions = command.add_subparsers(metavar="ACTION", required=True)
    text = "write the shape of a recorded person, for up --person"
    shape = actions.add_parser("personalise", help=text, description=text)
    shape.add_argument("bag", type=Path, metavar="BAG", help="recording with depth images")
    shape.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="YAML file to write")
    shape.add_argument("--overwrite", action="store_true", help="replace an existing FILE")
    shape.set_defaults(run=_personalise)
    text = "draw the mesh over depth images"
    show = actions.add_parser("show", help=text, description=text)
    show.add_argument("bag", type=Path, metavar="BAG", help="recording with depth images and the mesh")
    show.add_argument("-o", "--output", type=Path, required=True, metavar="FILE", help="picture to write")
    show.add_argument(
        "--images", type=int, default=4, metavar="N", help="evenly spaced over the recording (default: 4)"
    )
    show.set_defaults(run=_show)
    for action in (shape, show):
        action.add_argument("--depth", default="kinect1", metavar="SENSOR", help="the depth camera (default: kinect1)")


def _personalise(args: argparse.Namespace) -> int:
    check_new(args.output, overwrite=args.overwrite)
    print(personalise(args.bag, args.depth, args.output))
    print(f"written to {args.output}")
    return 0


def _show(args: argparse.Namespace) -> int:
    row = np.concatenate(pictures(args.bag, args.depth, max(args.images, 1)), axis=1)
    write_picture(args.output, row)
    print(f"picture: {args.output}")
    return 0

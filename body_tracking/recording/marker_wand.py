"""``body_tracking markers wand``: the poses of two or more cameras, by a wand that is waved in front of them.

The lenses come from a ``rig.yaml`` (``markers calibrate``), with their covariance. Cameras around a room that do not
see a board together are calibrated separately, each in its own folder, and combined here.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.linalg import block_diag

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.files import check_new
from body_tracking.core.parameters import check_all
from body_tracking.core.skeleton import NANOSECONDS, FloatArray
from body_tracking.markers import projection, setup
from body_tracking.markers.bundle_points import Sightings
from body_tracking.markers.codecs import Balls
from body_tracking.markers.pairing import FrameSets
from body_tracking.markers.rig import POSE
from body_tracking.markers.rig_storage import load_rig, save_rig
from body_tracking.markers.stages import DetectorStage
from body_tracking.markers.wand import Wand, WandCalibration, calibrate_wand, centred
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.recording.progress import Progress
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE

_TOLERANCE_NS: Final = NANOSECONDS // 500
"""Largest difference of the stamps in one set of images, as in ``marker_triangulation``."""
_VIEWS: Final = 500
"""Most places of the wand that are used, evenly spread over a recording: the adjustment takes 30 MB and 10 ms per
hundred places and camera."""


class WandRecordingError(BodyTrackingError):
    """Raised when a recording, a setup or an option cannot be used to calibrate by a wand."""


@dataclass(frozen=True, slots=True, eq=False)
class WandRecording:
    """Sightings of a wand in a recording.

    Attributes:
        seen: of the wand's balls; a view is a set of images in which two or more cameras see the wand.
        images: (c,) number of images of each camera.
        recognised: (c,) number of images with the wand.
    """

    seen: Sightings
    images: tuple[int, ...]
    recognised: tuple[int, ...]


def read_lenses(folders: Sequence[Path]) -> tuple[tuple[Camera, ...], FloatArray]:
    """Cameras from the ``rig.yaml`` of each folder, and the (p, p) covariance of their parameters, zero for poses.

    Raises:
        SetupError, RigFileError: a folder has none, or it cannot be read.
        WandRecordingError: a camera is in two folders.
    """
    cameras: list[Camera] = []
    parts = []
    for folder in folders:
        rig = load_rig(setup.file_of(folder, setup.RIG, "calibrate"))
        for camera in rig.cameras:
            if camera.frame_id in [each.frame_id for each in cameras]:
                raise WandRecordingError(f"{folder}: camera {camera.frame_id} is in another folder too")
            cameras.append(camera)
        lenses = projection.lenses_of(rig)
        parts.append(np.where(lenses & lenses[:, None], rig.covariance, 0.0))
    return tuple(cameras), np.asarray(block_diag(*parts), dtype=np.float64)


def read_wand(path: Path, cameras: Sequence[Camera], wand: Wand) -> WandRecording:
    """Find the wand in a recording of images or balls.

    Args:
        path: of the recording.
        cameras: that saw the wand, with their frames.
        wand: the wand.

    Raises:
        BagError: the recording cannot be read.
        WandRecordingError: it lacks a camera's images and balls.
        WandError: the distances of the wand's balls do not determine their order.
    """
    frames = [camera.frame_id for camera in cameras]
    images, recognised = np.zeros(len(frames), dtype=int), np.zeros(len(frames), dtype=int)
    sets: FrameSets[FloatArray] = FrameSets(frames, _TOLERANCE_NS, NANOSECONDS)
    found: list[dict[str, FloatArray]] = []

    places = {setup.balls_topic(frame): index for index, frame in enumerate(frames)}

    def take(topic: str, cdr: bytes, at_ns: int) -> None:
        balls, index = Balls().decode(cdr, BAG_WIRE), places[topic]
        images[index] += 1
        order = wand.find(balls.pixels)
        if order is not None:
            recognised[index] += 1
            found.extend(sets.push(frames[index], balls.stamp_ns, balls.pixels[order], balls.stamp_ns))

    with RigReader(path) as bag:
        topics = setup.sources(frames)
        chosen = next((each for each in topics[:2] if all(topic in bag.topics for topic in each)), None)
        if chosen is None:
            missing = [topic for topic in topics[0] if topic not in bag.topics]
            raise WandRecordingError(f"{path}: no topic {', '.join(missing)}; {graph.listed(bag.topics)}")
        names = tuple(setup.camera_name(frame) for frame in frames)
        stage = DetectorStage(check_all(DetectorStage.PARAMETERS, {"cameras": names}))
        runner = OfflineRunner([stage], BAG_WIRE, take)
        progress = Progress(bag.start_ns, bag.end_ns)
        for raw in bag.messages(chosen):
            (runner.push if chosen == topics[0] else take)(raw.topic, raw.cdr, raw.log_time_ns)
            progress.at(raw.log_time_ns)
        progress.end()
    for problem in runner.problems:
        print(f"warning: {problem}", file=sys.stderr)
    found.extend(sets.poll(bag.end_ns + 2 * NANOSECONDS))
    chosen_sets = np.unique(np.linspace(0, len(found) - 1, min(_VIEWS, len(found))).round().astype(int)).tolist()
    rows = [
        (frames.index(frame), view, ball, *pixel)
        for view, number in enumerate(chosen_sets)
        for frame, pixels in found[number].items()
        for ball, pixel in enumerate(pixels.tolist())
    ]
    table = np.array(rows, dtype=np.float64).reshape(-1, 5)
    indices = table[:, :3].astype(np.intp)
    seen = Sightings(indices[:, 0], indices[:, 1], indices[:, 2], table[:, 3:])
    return WandRecording(seen, tuple(images.tolist()), tuple(recognised.tolist()))


def report_of(found: WandCalibration, recording: WandRecording) -> dict[str, Any]:
    """The quality of a calibration, in millimetres, degrees and pixels."""
    rig, cameras = found.rig, {}
    for index, (camera, end) in enumerate(zip(rig.cameras, projection.offsets(rig)[1:], strict=True)):
        rows = recording.seen.cameras == index
        covariance = rig.covariance[end - POSE : end, end - POSE : end]
        turn, shift = covariance[:3, :3], covariance[3:, 3:]
        cameras[setup.camera_name(camera.frame_id)] = {
            "images": recording.images[index],
            "with_wand": recording.recognised[index],
            "sightings": int(rows.sum()),
            "left_out": int((rows & ~found.used).sum()),
            "rms_px": found.adjusted.rms(rows[found.used]) if (rows & found.used).any() else None,
            "position_mm": (-1e3 * rig.rotations[index].T @ rig.translations[index]).tolist(),
            "turn_deg": float(np.degrees(np.linalg.norm(so3.rotation_vectors(rig.rotations[index][None])[0]))),
            "turn_stddev_deg": float(np.degrees(np.sqrt(np.trace(turn)))),
            "translation_stddev_mm": float(1e3 * np.sqrt(np.trace(shift))),
        }
    errors = found.adjusted.length_errors
    return {
        "views": len(np.unique(recording.seen.views)),
        "noise_px": found.adjusted.noise,
        "length_rms_mm": float(1e3 * np.sqrt(np.nanmean(errors**2))),
        "cameras": cameras,
    }


def wand(args: argparse.Namespace) -> int:
    """``markers wand``."""
    try:
        places = tuple(float(part) for part in args.places.split(","))
    except ValueError as error:
        raise WandRecordingError(f"--places {args.places!r}: expected metres along the wand, as 0,0.15,0.45") from error
    path = args.setup / setup.RIG
    # the poses in the rig with the lenses are there to be replaced
    check_new(path, overwrite=args.overwrite or not args.lenses or args.setup in args.lenses)
    held = Wand(places, args.deviation)
    cameras, covariance = read_lenses(args.lenses or [args.setup])
    recording = read_wand(args.bag, cameras, held)
    found = calibrate_wand(cameras, recording.seen, held, covariance)
    if args.diameter:
        found = calibrate_wand(cameras, centred(found, recording.seen, args.diameter), held, covariance)
    args.setup.mkdir(parents=True, exist_ok=True)
    save_rig(found.rig, path)
    report = {"rig": str(path), **report_of(found, recording)}
    if args.json:
        print(json.dumps(report, indent=2))
        return 0
    for name, each in report["cameras"].items():
        x, y, z = each["position_mm"]
        print(
            f"{name}: at {x:.1f} {y:.1f} {z:.1f} mm (± {each['translation_stddev_mm']:.2f}), turned by "
            f"{each['turn_deg']:.3f} deg (± {each['turn_stddev_deg']:.3f}); the wand in {each['with_wand']} of "
            f"{each['images']} images, {each['left_out']} of {each['sightings']} balls left out, RMS "
            f"{each['rms_px'] or float('nan'):.3f} px"
        )
    print(
        f"{report['views']} places of the wand, noise {report['noise_px']:.3f} px per axis, its lengths "
        f"{report['length_rms_mm']:.3f} mm RMS off\nwritten to {path}"
    )
    return 0


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``markers wand``."""
    does = "calibrate the poses of the cameras by a waved wand with three balls in a row; writes rig.yaml"
    parser = commands.add_parser("wand", help=does, description=does)
    parser.add_argument("bag", type=Path, metavar="BAG", help="a recording of the cameras' images, or of the balls")
    parser.add_argument("--setup", type=Path, required=True, metavar="FOLDER", help="the folder of the setup")
    parser.add_argument(
        "--lenses",
        type=Path,
        action="append",
        metavar="FOLDER",
        help="a setup with the lenses of some of the cameras in its rig.yaml, several times where they were calibrated "
        "apart; the first camera is the rig's frame (default: that of --setup)",
    )
    parser.add_argument(
        "--places",
        required=True,
        metavar="M,M,M",
        help="of the balls along the wand, metres from the first: 0,0.15,0.45",
    )
    parser.add_argument(
        "--deviation",
        type=float,
        default=1e-4,
        metavar="METRES",
        help="standard deviation of the wand's length (default: %(default)s)",
    )
    parser.add_argument(
        "--diameter", type=float, default=0.0, metavar="METRES", help="of the balls; 0 takes centroids for centres"
    )
    parser.add_argument(
        "--overwrite", action="store_true", help="with --lenses of other setups: replace an existing rig.yaml"
    )
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    parser.set_defaults(run=wand)

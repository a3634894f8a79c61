"""``body_tracking markers``: the cameras, the targets and the chain of the marker system, and its angles offline.

A folder holds what the nodes need: ``calibrate`` and ``wand`` write its ``rig.yaml``, ``target`` its ``targets.yaml``,
``fit`` its ``chain.yaml``.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core.errors import BodyTrackingError, did_you_mean
from body_tracking.core.files import check_new, natural
from body_tracking.core.parameters import Value, check_all
from body_tracking.core.skeleton import FloatArray
from body_tracking.markers import setup
from body_tracking.markers.boards import Chessboard
from body_tracking.markers.calibration_report import table
from body_tracking.markers.camera_calibration import calibrate_cameras, find_boards
from body_tracking.markers.chain import ChainFit, JointDescription, fit_chain
from body_tracking.markers.chain_files import load_chain, save_chain, to_urdf
from body_tracking.markers.codecs import PoseOfTarget, SpacePoints
from body_tracking.markers.corrections import calibration_effects, shape_effects
from body_tracking.markers.distinct import check_distinct
from body_tracking.markers.joint_model import JointKind
from body_tracking.markers.observations import Points, TargetPose
from body_tracking.markers.pose import FEWEST
from body_tracking.markers.rig_storage import rig_in, save_rig
from body_tracking.markers.stages import DetectorStage, TrackerStage, TriangulationStage
from body_tracking.markers.target_calibration import calibrate_target, ordered_views
from body_tracking.markers.targets_file import load_targets, save_targets
from body_tracking.markers.trajectories import TrajectoryError, is_trajectory_file, labels_in, read_trajectories
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.stage import Stage
from body_tracking.pipeline.system import load
from body_tracking.recording import marker_wand
from body_tracking.recording.progress import Progress
from body_tracking.recording.replay import OFFLINE, ReplaySettings, replay
from body_tracking.recording.rig import RigReader
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader, check_new_bag
from body_tracking.systems import NODES

_VIEWS = 600
"""Approximate number of views of a labelled target: more views hardly add information."""
_RENDER = "body_tracking.simulation.marker_bags"


class MarkerCommandError(BodyTrackingError):
    """Raised when a recording, an image or an option cannot be used."""


# --- recordings


def sources_of(bag: BagReader | RigReader, folder: Path) -> tuple[str, ...]:
    """The source topics of a recording: of images, balls or points.

    Raises:
        MarkerCommandError: the recording has none of them.
    """
    sources = setup.sources_in(folder)
    for topics in sources:
        if all(topic in bag.topics for topic in topics):
            return topics
    wanted = " or ".join(topics[0] for topics in sources)
    rig = "" if len(sources) > 1 else f". Images need {folder / setup.RIG}, which is not there"
    raise MarkerCommandError(f"{bag.path}: no topic {wanted}; {graph.listed(bag.topics)}{rig}")


def track(
    bag_path: Path, folder: Path, stages: Sequence[type[Stage]], values: Mapping[str, Value]
) -> dict[str, list[bytes]]:
    """Messages of points and of the stages, by topic.

    Args:
        bag_path: with images, balls or points.
        folder: of the setup.
        stages: in their order; a recording of points needs no cameras.
        values: parameters, for the stages that have them.

    Raises:
        BodyTrackingError: the recording or the setup cannot be used.
    """
    made: list[Stage] = []
    found: dict[str, list[bytes]] = {}

    def keep(topic: str, cdr: bytes, at_ns: int) -> None:
        found.setdefault(topic, []).append(cdr)

    with RigReader(bag_path) as bag:
        topics = sources_of(bag, folder)
        for stage in stages:
            if topics != (setup.POINTS,) or stage not in (DetectorStage, TriangulationStage):
                known = {item.name for item in stage.PARAMETERS}
                given = {"setup": str(folder), **{name: value for name, value in values.items() if name in known}}
                made.append(stage(check_all(stage.PARAMETERS, given)))
        runner = OfflineRunner(made, BAG_WIRE, keep)
        progress = Progress(bag.start_ns, bag.end_ns)
        runner.start(bag.start_ns)
        for raw in bag.messages(topics):
            if raw.topic == setup.POINTS:
                keep(raw.topic, raw.cdr, raw.log_time_ns)
            runner.push(raw.topic, raw.cdr, raw.log_time_ns)
            progress.at(raw.log_time_ns)
        runner.finish(bag.end_ns)
        progress.end()
    for problem in runner.problems:
        print(f"warning: {problem}", file=sys.stderr)
    return found


def points_of(bag_path: Path, folder: Path, diameter: float) -> list[Points]:
    """The points in a recording, frame by frame; ``diameter`` of the balls in metres, or 0."""
    messages = track(bag_path, folder, (DetectorStage, TriangulationStage), {"diameter": diameter})
    return [SpacePoints().decode(cdr, BAG_WIRE) for cdr in messages.get(setup.POINTS, ())]


def poses_of(bag_path: Path, folder: Path, diameter: float) -> list[list[TargetPose]]:
    """The poses of the targets in a recording, frame by frame; ``diameter`` of the balls in metres, or 0."""
    stages = (DetectorStage, TriangulationStage, TrackerStage)
    messages = track(bag_path, folder, stages, {**OFFLINE, "diameter": diameter})
    frames: dict[int, list[TargetPose]] = {}
    for target in load_targets(setup.file_of(folder, setup.TARGETS, "target")):
        for cdr in messages.get(setup.pose_topic(target.name), ()):
            pose = PoseOfTarget(target.name).decode(cdr, BAG_WIRE)
            frames.setdefault(pose.stamp_ns, []).append(pose)
    return [frames[stamp_ns] for stamp_ns in sorted(frames)]


def fit_recording(bag_path: Path, folder: Path, joints: Sequence[JointDescription], diameter: float) -> ChainFit:
    """Fit the chain to a recording in which every joint moves.

    Args:
        bag_path: with images, balls or points.
        folder: of the setup, with ``targets.yaml``, and ``rig.yaml`` if there is one.
        joints: of the chain.
        diameter: of the balls, metres, or 0.

    Raises:
        BodyTrackingError: the recording or the setup cannot be used, or the joints cannot be fitted.
    """
    rig = rig_in(folder)
    targets = {each.name: each for each in load_targets(setup.file_of(folder, setup.TARGETS, "target"))}
    for joint in joints:
        for name in (joint.parent, joint.child):
            if name not in targets:
                hint = did_you_mean(name, targets) or f"; there are {', '.join(targets)}"
                raise MarkerCommandError(f"joint {joint.name}: no target {name!r} in {folder / setup.TARGETS}{hint}")
    frames = poses_of(bag_path, folder, diameter)
    sensitivities = [effects for poses in frames if (effects := calibration_effects(rig, targets, poses)) is not None]
    shapes = [shape_effects(rig, targets, poses) for poses in frames]
    return fit_chain(frames, joints, sensitivities or None, shapes)


# --- commands


def _image(path: Path) -> NDArray[np.uint8]:
    found = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if found is None:
        raise MarkerCommandError(f"{path}: no image")
    return np.asarray(found, dtype=np.uint8)


def calibrate(args: argparse.Namespace) -> int:
    """``markers calibrate``."""
    names, series = [], []
    for entry in args.camera:
        name, _, folder = entry.partition("=")
        files = [path for path in Path(folder).glob("*") if path.is_file()] if folder else []
        files.sort(key=lambda path: natural(path.name))
        if not name or not folder:
            raise MarkerCommandError(f"camera {entry!r}: expected NAME=FOLDER, a folder with its images")
        if not files:
            raise MarkerCommandError(f"camera {name}: no file in {folder}, or no such folder")
        names.append(name)
        series.append([_image(path) for path in files])
    check_new(args.setup / setup.RIG, overwrite=args.overwrite)
    board = Chessboard(args.columns, args.rows, args.square)
    corners = find_boards(board, series)
    sizes = [(images[0].shape[1], images[0].shape[0]) for images in series]
    found = calibrate_cameras([f"{name}_optical_frame" for name in names], sizes, corners)
    args.setup.mkdir(parents=True, exist_ok=True)
    save_rig(found.rig, args.setup / setup.RIG)
    rms, axes = found.rms(), found.rms_by_axis()
    seen = [len(np.unique(corners.views[corners.cameras == k])) for k in range(len(names))]
    report = {
        "rig": str(args.setup / setup.RIG),
        "cameras": {
            name: {
                "rms_px": float(rms[k]),
                "rms_x_px": float(axes[k, 0]),
                "rms_y_px": float(axes[k, 1]),
                "boards": seen[k],
            }
            for k, name in enumerate(names)
        },
        "left_out": [f"view {each.view}, {each.camera or 'all cameras'}: {each.reason}" for each in found.rejected],
    }
    lines = found_boards(names, seen, len(series[0]))
    return _say(args, report, [*table(found).splitlines(), *lines, f"written to {report['rig']}"])


def found_boards(names: Sequence[str], seen: Sequence[int], images: int) -> list[str]:
    """In how many of a camera's images a board was found; a warning where they are few, as with a miscounted board."""
    lines = [f"boards: {', '.join(f'{name} in {n} of {images} images' for name, n in zip(names, seen, strict=True))}"]
    if 2 * min(seen) <= images:
        lines.append("warning: few boards were found; columns and rows count the inner corners, not the squares")
    return lines


def target(args: argparse.Namespace) -> int:
    """``markers target``."""
    path = args.setup / setup.TARGETS
    others = load_targets(path) if path.exists() else []
    if args.name in [each.name for each in others] and not args.overwrite:
        raise MarkerCommandError(f"{path}: has a target {args.name} already; --overwrite replaces it")
    others = [each for each in others if each.name != args.name]
    views, covariance, whole = _views(args)
    found = calibrate_target(args.name, views, covariance, args.diameter, flexible=bool(args.labels))
    check_distinct([*others, found.target], max(found.noise, 2e-4))
    args.setup.mkdir(parents=True, exist_ok=True)
    save_targets([*others, found.target], path)
    balls = len(found.target.points)
    stddev = float(np.sqrt(np.trace(found.target.covariance) / balls))
    report = {
        "targets": str(path),
        "name": args.name,
        "views": int(found.used.sum()),
        "noise_mm": 1e3 * found.noise,
        "stddev_mm": 1e3 * stddev,
        "reduced_chi_square": found.reduced_chi_square,
    }
    lines = [
        f"{args.name}: {balls} balls from {report['views']} of {whole} frames, noise "
        f"{report['noise_mm']:.3f} mm, each ball known to {report['stddev_mm']:.3f} mm",
        f"written to {path}",
    ]
    return _say(args, report, lines)


def _views(args: argparse.Namespace) -> tuple[FloatArray, FloatArray | None, int]:
    """(f, k, 3) views of a target, their covariance (None for labelled trajectories), and the number of frames."""
    if args.labels:
        if not is_trajectory_file(args.bag):
            raise MarkerCommandError(f"{args.bag}: labels are in C3D files and in exports of Motive only")
        try:
            views = read_trajectories(args.bag).chosen(args.labels)
        except TrajectoryError as error:
            raise MarkerCommandError(f"{args.bag}: {error}") from error
        rows = np.flatnonzero(np.isfinite(views).all(axis=2).sum(axis=1) >= FEWEST)
        return views[rows[:: max(1, len(rows) // _VIEWS)]], None, len(views)
    if args.balls is None:
        raise MarkerCommandError("balls: their number is needed, or the labels of the target in a C3D file")
    frames = points_of(args.bag, args.setup, args.diameter)
    first = next((k for k, points in enumerate(frames) if len(points.positions) == args.balls), None)
    if first is None:
        counts = Counter(len(points.positions) for points in frames)
        seen = ", ".join(f"{count} in {number} frames" for count, number in sorted(counts.items())) or "no frame at all"
        raise MarkerCommandError(f"{args.bag}: no frame with {args.balls} points; {seen}")
    views, covariance = ordered_views(frames, np.arange(args.balls), first)
    return views, covariance, len(frames)


def fit(args: argparse.Namespace) -> int:
    """``markers fit``."""
    joints = []
    for entry in args.joint:
        parts = entry.split(":")
        if len(parts) != 4 or parts[1] not in tuple(JointKind):
            raise MarkerCommandError(f"joint {entry!r}: expected NAME:KIND:PARENT:CHILD, KIND {', '.join(JointKind)}")
        joints.append(JointDescription(parts[0], parts[2], parts[3], JointKind(parts[1])))
    path = args.setup / setup.CHAIN
    check_new(path, overwrite=args.overwrite)
    found = fit_recording(args.bag, args.setup, joints, args.diameter)
    save_chain(found.chain, path)
    path.with_suffix(".urdf").write_text(to_urdf(found.chain, setup.BODY), encoding="utf-8")
    report = {
        "chain": str(path),
        "scale": found.chain.scale,
        "joints": {
            each.joint.name: {
                "frames": each.frames,
                "motion_deg": np.degrees(each.motion).tolist(),
                "gap_mm": 1e3 * each.gap,
                "verdict": str(each.verdict),
            }
            for each in found.joints
        },
        "warnings": list(found.warnings),
    }
    lines = [
        f"{each.joint.name}: {each.frames} frames, turned by {np.degrees(each.motion[0]):.0f} deg RMS about its main "
        f"axis, centres {1e3 * each.gap:.2f} mm apart, {each.verdict.replace('_', ' ')}"
        for each in found.joints
    ]
    lines += [f"warning: {warning}" for warning in found.warnings]
    return _say(args, report, [*lines, f"written to {path} and {path.with_suffix('.urdf')}"])


def angles(args: argparse.Namespace) -> int:
    """``markers angles``."""
    check_new_bag(args.output, overwrite=args.overwrite)
    with RigReader(args.bag) as bag:
        sources_of(bag, args.setup)  # raises with a hint
    settings = ReplaySettings(
        (graph.NO_SENSORS,),
        more={"marker_setup": str(args.setup)},
        parameters={"marker_triangulation": {"diameter": args.diameter}},
    )
    found = replay(args.bag, args.output, settings, overwrite=args.overwrite)
    parts = {name: name.partition(" ") for name in found.counters}
    counters = {text if node in NODES else name: found.counters[name] for name, (node, _, text) in parts.items()}
    listed = ", ".join(f"{name}: {count}" for name, count in sorted(counters.items()))
    report = {"output": str(args.output), "frames": found.frames, "counters": counters}
    return _say(
        args, report, [f"{found.frames} frames of joint angles", f"on the way: {listed}", f"written to {args.output}"]
    )


def check(args: argparse.Namespace) -> int:
    """``markers check``."""
    rig = rig_in(args.setup)
    targets = load_targets(setup.file_of(args.setup, setup.TARGETS, "target"))
    check_distinct(targets, args.noise)
    report = {
        "cameras": [] if rig is None else [camera.frame_id for camera in rig.cameras],
        "targets": {each.name: len(each.points) for each in targets},
    }
    lines = [
        f"cameras: {', '.join(report['cameras']) or 'none, points of another system only'}",
        f"targets: {', '.join(f'{each.name} ({len(each.points)} balls)' for each in targets)}; no two are alike",
    ]
    if (args.setup / setup.CHAIN).exists():
        joints = load_chain(args.setup / setup.CHAIN).joints
        report["joints"] = {each.name: each.kind.value for each in joints}
        lines.append(f"joints: {', '.join(f'{each.name} ({each.kind.value})' for each in joints)}")
        points = " --marker-points TOPIC" if rig is None else ""
        lines.append(f"whole: body_tracking up --sensors none --marker-setup {args.setup}{points}")
    else:
        report["joints"] = {}
        lines.append(
            f"joints: none, the targets have poses but no angles; body_tracking markers fit makes {setup.CHAIN}"
        )
    return _say(args, report, lines)


def _say(args: argparse.Namespace, report: Mapping[str, Any], lines: Iterable[str]) -> int:
    print(json.dumps(report, indent=2) if args.json else "\n".join(lines))
    return 0


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking markers``."""
    top = subparsers.add_parser(
        "markers",
        description="The cameras, the targets and the chain of the marker system, and its angles offline. A folder "
        "has what the nodes need: calibrate and wand write its rig.yaml, target its targets.yaml, fit its chain.yaml.",
    )
    commands = top.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def command(name: str, run: Callable[[argparse.Namespace], int], does: str) -> argparse.ArgumentParser:
        parser: argparse.ArgumentParser = commands.add_parser(name, help=does, description=does)
        parser.add_argument("--setup", type=Path, required=True, metavar="FOLDER", help="the folder of the setup")
        if run in (target, fit, angles):
            text = "of the balls; without it the centroid of a ball's image is taken for its centre"
            parser.add_argument("--diameter", type=float, default=0.0, metavar="METRES", help=text)
        parser.add_argument("--json", action="store_true", help="print the report as JSON")
        parser.set_defaults(run=run)
        return parser

    parser = command("calibrate", calibrate, "calibrate the cameras from images of a chessboard; writes rig.yaml")
    parser.add_argument(
        "--camera",
        action="append",
        required=True,
        metavar="NAME=FOLDER",
        help="a camera and its images, in the order of those of the others; once for each camera",
    )
    parser.add_argument("--columns", type=int, required=True, metavar="N", help="inner corners in a row")
    parser.add_argument("--rows", type=int, required=True, metavar="N", help="rows of inner corners")
    parser.add_argument("--square", type=float, required=True, metavar="METRES", help="width of a square")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing rig.yaml, also one of a wand")

    marker_wand.add_parser(commands)

    parser = command("target", target, "measure a target that is turned before the cameras alone; into targets.yaml")
    parser.add_argument(
        "bag",
        type=Path,
        metavar="BAG",
        help="a recording of the target, or with --labels a C3D file or an export of Motive",
    )
    parser.add_argument("--name", required=True, metavar="NAME", help="of the target")
    parser.add_argument("--balls", type=int, metavar="N", help="number of its balls")
    parser.add_argument(
        "--labels",
        type=labels_in,
        default=(),
        metavar="LABEL,...",
        help="measure it by these trajectories of a file with labels, in which there may be others",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace a target of this name")

    parser = command("fit", fit, "estimate the joints between targets from their motion; writes chain.yaml and a URDF")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a recording in which every joint moves")
    parser.add_argument(
        "--joint",
        action="append",
        required=True,
        metavar="NAME:KIND:PARENT:CHILD",
        help=f"a joint between two targets; KIND is {', '.join(JointKind)}; once for each joint",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace an existing chain.yaml")

    parser = command("angles", angles, "compute the joint angles in a recording; writes them into a new one")
    parser.add_argument("bag", type=Path, metavar="BAG", help="a recording of images, balls or points")
    parser.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="the bag to be written")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUT")

    parser = command("check", check, "read a setup, and check whether its targets can be distinguished")
    parser.add_argument(
        "--noise",
        type=float,
        default=3e-4,
        metavar="METRES",
        help="standard deviation of a point (default: %(default)s)",
    )

    load(f"{_RENDER}:add_parser")(commands)

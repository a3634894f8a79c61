"""``body_tracking calibrate``: the poses and clocks of a recording's sensors."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from body_tracking.calibration.advice import SEVERAL, next_step, quality
from body_tracking.calibration.online import MAX_TRANSLATION_STDDEV, CalibrationParameters, OnlineCalibration
from body_tracking.calibration.rigid import CalibrationError
from body_tracking.calibration.storage import save, to_dict
from body_tracking.core.files import check_new
from body_tracking.core.parameters import fields_of
from body_tracking.core.sensor_poses import CalibrationResult
from body_tracking.messages.node_status import NodeStatus
from body_tracking.node_parameters import parameters_for
from body_tracking.recording.progress import Progress
from body_tracking.recording.replay import sensor_topics, skeletons_of
from body_tracking.recording.rig import RigReader
from body_tracking.systems import all_nodes_for, nodes_for, options_of

HISTORY_S = 600.0
"""Seconds of raw frames kept: a recording up to this length is interpolated again with the final clock."""

_ADVICE = (
    "replay makes skeletons of the images of colour and depth cameras; body_tracking markers calibrates infrared ones"
)


def relative_yaw(result: CalibrationResult, sensor: str) -> float:
    """The rotation about the vertical from a sensor's coordinates to the reference's, in Kinect camera axes.

    Args:
        result: with both sensors.
        sensor: its name.

    Returns:
        atan2(R[0, 2], R[2, 2]) in radians, for R in camera axes (x to the sensor's left, y up, z forward).
    """
    rotation = result.poses[result.reference].rotation.T @ result.poses[sensor].rotation
    # Camera axes are (-x, -y, z) of optical ones.
    return float(np.arctan2(-rotation[0, 2], rotation[2, 2]))


def calibrate(
    bag_path: Path, parameters: CalibrationParameters, sensors: tuple[str, ...] = (), reference: str = ""
) -> tuple[CalibrationResult, list[str], NodeStatus]:
    """Calibrate from a whole bag.

    Args:
        bag_path: a rosbag2 folder or an mcap file.
        parameters: of the calibration.
        sensors: to use; all in the bag when empty.
        reference: the sensor that defines ``world``; the first when empty.

    Returns:
        The result, events, a line each, and the status, as the node ``calibration`` reports it.

    Raises:
        ReplayError: no skeletons in the bag.
        BagError: the bag cannot be read.
        CalibrationError: a sensor could not be calibrated.
    """
    counters: Counter[str] = Counter()
    with RigReader(bag_path) as bag:
        topics = sensor_topics(bag, sensors, _ADVICE)
        names = tuple(topics.values())
        calibration = OnlineCalibration(names, replace(parameters, history=HISTORY_S), reference or None)
        progress = Progress(bag.start_ns, bag.end_ns)
        frames = 0
        for sensor, skeleton, log_time_ns, _ in skeletons_of(bag, topics, counters):
            frames += 1
            calibration.push(sensor, skeleton, log_time_ns)
            progress.at(log_time_ns)
        progress.end()
        events = [*bag.warnings, *(f"{name}: {count}" for name, count in sorted(counters.items()))]
    if len(names) < 2:
        raise CalibrationError(f"{bag_path}: only the sensor {names[0]}: nothing to calibrate it against")
    if not frames:
        raise CalibrationError(f"{bag_path}: no frame can be used ({'; '.join(events) or 'there is none'})")
    result = calibration.finish()
    level, text, values = calibration.status()
    if level and counters["frames with several bodies"]:
        text += f"; {SEVERAL}"
    status = NodeStatus("calibration", level, text, {key: str(value) for key, value in values.items()})
    missing = [name for name in names if name not in result.poses]
    if missing:
        raise CalibrationError(
            f"{bag_path}: {', '.join(missing)} could not be calibrated against {calibration.reference}: {text}; "
            f"record again, and {next_step(status)}"
        )
    return result, [*calibration.events, *events], status


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking calibrate``."""
    command = subparsers.add_parser(
        "calibrate",
        description="Estimates the pose and clock of each sensor of a recording from the skeletons of a person, and "
        "says whether they are good enough.",
    )
    command.add_argument(
        "bag", type=Path, metavar="BAG", help="rosbag2 folder or .mcap file with /<sensor>/skeleton topics"
    )
    command.add_argument(
        "--method",
        choices=("robust", "thesis"),
        help="robust (default): refined while the person moves; thesis: one still pose of 50 frames",
    )
    command.add_argument("--sensors", metavar="A,B", help="the sensors (default: all in the bag)")
    command.add_argument("--reference", metavar="A", help="the sensor that defines world (default: the first)")
    command.add_argument(
        "--params-file", type=Path, metavar="F", help="ROS parameters file, as for the calibration node"
    )
    command.add_argument("-o", "--output", type=Path, metavar="FILE", help="save the calibration (YAML)")
    command.add_argument("--overwrite", action="store_true", help="replace an existing FILE")
    command.add_argument("--json", action="store_true", help="print the result as JSON")
    command.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.output is not None:
        check_new(args.output, overwrite=args.overwrite)
    options = options_of()
    spec = next(spec for spec in nodes_for(options) if spec.name == "calibration")
    values = parameters_for([spec], args.params_file, absent=all_nodes_for(options))["calibration"]
    parameters = CalibrationParameters(**fields_of(CalibrationParameters, values))
    if args.method:
        parameters = replace(parameters, method=args.method)
    sensors = tuple(args.sensors.split(",")) if args.sensors else ()
    result, events, status = calibrate(args.bag, parameters, sensors, args.reference or "")
    if args.output is not None:
        save(result, args.output)
    if args.json:
        data: dict[str, Any] = {"method": parameters.method, "good": not status.level, **to_dict(result)}
        data |= {"events": events}
        for name, entry in data["sensors"].items():
            entry["relative_yaw_deg"] = float(np.degrees(relative_yaw(result, name)))
        print(json.dumps(data, indent=2))
        return 0
    for event in events:
        print(event)
    for name, pose in result.poses.items():
        clock, stated = result.clocks[name], result.quality[name]
        x, y, z = pose.translation
        # without an estimate from movement, which has a deviation, it is that of the still pose
        of_what = "median" if np.isfinite(stated.rotation_stddev) else "mean"
        if name == result.reference:
            print(f"{name}: reference, at ({x:.3f}, {y:.3f}, {z:.3f}) m in world")
            continue
        print(
            f"{name}: at ({x:.3f}, {y:.3f}, {z:.3f}) m in world, yaw {np.degrees(relative_yaw(result, name)):.2f} deg "
            f"(+-{np.degrees(stated.rotation_stddev):.2f}), "
            f"clock {clock.offset:+.4f} s (+-{clock.stddev:.4f}), "
            f"drift {clock.drift_ppm:+.0f} ppm, {of_what} residual {1e3 * stated.residual:.0f} mm"
        )
    limits = f"{np.degrees(parameters.max_rotation_stddev):.1f} degrees and {1e3 * MAX_TRANSLATION_STDDEV:.0f} mm"
    verdict = f"not good enough: {status.text}; " if status.level else "good: "
    print(f"{verdict}{quality(status)} at the person's place (good is below {limits})")
    if status.level:
        print(f"next: record again, and {next_step(status)}")
    print(f"saved to {args.output}" if args.output is not None else "not saved: -o FILE saves it")
    return 0

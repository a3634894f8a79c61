"""``body_tracking evaluate baseline``: a camera's errors on a robot arm's red balls, and a pendulum's frequency.

The tests of chapter 4.1 of Schlagenhauf 2017: table 4.1 and figure 4.10.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from body_tracking.camera.topics import BALLS, DRIVERS, infrared_topic
from body_tracking.core.imu import STANDARD_GRAVITY
from body_tracking.evaluation.baseline_reading import read_arm, read_pendulum
from body_tracking.evaluation.pendulum import (
    Decay,
    PendulumError,
    Swing,
    fit_swing,
    natural_frequency,
    sines,
    vicon_decays,
)
from body_tracking.evaluation.pictures import figure_of, png_of
from body_tracking.evaluation.reading import EvaluationError
from body_tracking.evaluation.report import Column, Report, Table, make_folder, numbered, write
from body_tracking.evaluation.robot_arm import ArmResult, compare

_CSV: Final = (".csv", ".csv.gz")
_AXES: Final = ("X", "Y", "Z")
_GAP: Final = 0.15
"""Seconds without a position above which a curve is interrupted."""


class Pendulum(NamedTuple):
    """A fitted pendulum.

    Attributes:
        name: of its recording.
        length: metres; NaN if not stated.
        theory: theoretical frequency for the length, Hz.
        swing: fitted to the images.
        times: (n,) s.
        measured: (n,) sines of the pendulum's angle.
    """

    name: str
    length: float
    theory: float
    swing: Swing
    times: Any
    measured: Any


# --- reports


def arm_report(result: ArmResult) -> Report:
    """Table 4.1 (Schlagenhauf 2017): errors of the end effector along the robot's axes, and scatter of the trials."""
    names = tuple(f"{trial.name}{' (of the fit)' * (trial is result.trials[0])}" for trial in result.trials)

    def columns(mean: str, largest: str, titles: tuple[str, str]) -> tuple[Column, ...]:
        return tuple(
            Column(f"{key}_{axis.lower()}", f"{title} {axis}", "mm", values[:, number], digits=2)
            for key, title, field in (("mean", titles[0], mean), ("max", titles[1], largest))
            for values in [1e3 * np.array([getattr(each, field) for each in result.errors])]
            for number, axis in enumerate(_AXES)
        )

    errors = Table(
        *("errors", "end effector", names, columns("mae", "largest", ("MAE", "max"))),
        "MAE, max: mean and maximum absolute error along the robot's axes, by the registration and the delay of the "
        "first trial.",
    )
    deviations = Table(
        *("deviations", "repeatability", names, columns("deviation", "largest_deviation", ("MAD", "max"))),
        "MAD, max: mean and maximum absolute deviation from the mean of all trials.",
    )
    delays = [1e3 * each.delay for each in result.errors]
    facts = [
        ("delay", f"{1e3 * result.alignment.delay:.1f} ms: the camera's stamps follow the robot's, by the first trial"),
        ("each", ", ".join(f"{trial.name} {each:.1f} ms" for trial, each in zip(result.trials, delays, strict=True))),
        *((trial.name, f"all balls in {len(trial.times)} of {trial.images} images") for trial in result.trials),
    ]
    content = {
        "delay_ms": numbered(1e3 * result.alignment.delay),
        "delays_ms": {trial.name: numbered(each) for trial, each in zip(result.trials, delays, strict=True)},
        "images": {trial.name: [len(trial.times), trial.images] for trial in result.trials},
    }
    return Report("robot arm", tuple(facts), content, (errors, deviations))


def pendulum_report(pendulums: Sequence[Pendulum]) -> Report:
    """Figure 4.10 (Schlagenhauf 2017) as a table."""
    swings = [each.swing for each in pendulums]
    errors = np.array([each.swing.frequency - each.theory for each in pendulums])
    table = Table(
        "pendulums",
        "pendulum",
        tuple(each.name for each in pendulums),
        (
            Column("length", "length", "m", np.array([each.length for each in pendulums]), digits=3),
            Column("theory", "theory", "Hz", np.array([each.theory for each in pendulums]), digits=4),
            Column("measured", "measured", "Hz", np.array([each.frequency for each in swings]), digits=4),
            Column("error", "error", "mHz", 1e3 * errors, digits=3),
            Column("stddev", "+-", "mHz", 1e3 * np.array([each.stddev for each in swings]), digits=3),
            Column("amplitude", "amplitude", "deg", np.degrees([each.amplitude for each in swings])),
            Column("damping", "damping", "1/s", np.array([each.damping for each in swings]), digits=3),
            Column("residual", "residual", "mm", 1e3 * np.array([e.swing.residual * e.length for e in pendulums])),
            Column("known", "frames", "%", 1e2 * np.array([np.isfinite(each.measured).mean() for each in pendulums])),
        ),
        "theory: of the length. measured: for small amplitudes, without damping; +-: deviation by the scatter alone.\n"
        "frames: share in which one ball without depth was seen.",
    )
    known = np.abs(errors[np.isfinite(errors)])
    mean = float(known.mean()) if len(known) else float("nan")
    facts = [("error", f"{1e3 * mean:.3f} mHz, mean of absolute errors")] if len(known) else []
    return Report("pendulum", tuple(facts), {"mean_absolute_error_hz": numbered(mean)}, (table,))


def vicon_report(links: Sequence[tuple[str, list[Decay]]]) -> Report:
    """Frequencies by Vicon and by the gyroscope on the same link, for each release."""
    rows = [(name, number, decay) for name, decays in links for number, decay in enumerate(decays, 1)]
    decays = [decay for *_, decay in rows]
    vicon, gyroscope = (np.array([getattr(each, by).frequency for each in decays]) for by in ("vicon", "gyroscope"))
    table = Table(
        "decays",
        "release",
        tuple(f"{name} {number}" for name, number, _ in rows),
        (
            Column("start", "start", "s", np.array([each.start for each in decays])),
            Column("vicon", "Vicon", "Hz", vicon, digits=4),
            Column("gyroscope", "gyroscope", "Hz", gyroscope, digits=4),
            Column("difference", "difference", "mHz", 1e3 * (vicon - gyroscope), digits=2),
            Column("amplitude", "amplitude", "deg", np.degrees([each.vicon.amplitude for each in decays])),
            Column("damping", "damping", "1/s", np.array([each.vicon.damping for each in decays]), digits=3),
        ),
        "No length is known: the two sensors are compared. Vicon's frames were laid evenly over rows whose times are "
        "not.",
    )
    facts = []
    for name, own in links:
        both = np.array([[each.vicon.frequency, each.gyroscope.frequency] for each in own])
        spread = both.std(axis=0, ddof=1) if len(both) > 1 else np.full(2, np.nan)
        facts.append(
            (
                name,
                f"Vicon {both[:, 0].mean():.4f} Hz, gyroscope {both[:, 1].mean():.4f} Hz; scatter of {len(both)} "
                f"releases {1e3 * spread[0]:.1f} and {1e3 * spread[1]:.1f} mHz",
            )
        )
    apart = float(np.abs(vicon - gyroscope).mean())
    facts.append(("apart", f"{apart:.4f} Hz, mean of absolute differences"))
    return Report("pendulum", tuple(facts), {"mean_absolute_difference_hz": numbered(apart)}, (table,))


# --- pictures


def _draw_arm(result: ArmResult) -> bytes:
    figure = figure_of(5.0)
    axes = figure.subplots(2, len(_AXES), sharex=True, squeeze=False)
    gaps = [np.flatnonzero(np.diff(each.times) > _GAP) + 1 for each in result.errors]
    for number, axis in enumerate(_AXES):
        above, below = axes[:, number]
        above.plot(result.errors[0].times, 1e3 * result.errors[0].true[:, number], "--", color="black", label="robot")
        for colour, (trial, each, gap) in enumerate(zip(result.trials, result.errors, gaps, strict=True)):
            times = np.insert(each.times, gap, np.nan)
            found, true = (np.insert(1e3 * side[:, number], gap, np.nan) for side in (each.found, each.true))
            above.plot(times, found, color=f"C{colour}", linewidth=1.0, label=trial.name)
            below.plot(times, found - true, color=f"C{colour}", linewidth=0.6)
        above.set_title(f"{axis} of the end effector, mm", fontsize=10)
        below.set_title(f"error of {axis}, mm", fontsize=10)
        below.set_xlabel("s", fontsize=8)
    axes[0, 0].legend(fontsize=8)
    return png_of(figure)


def _draw_pendulums(pendulums: Sequence[Pendulum]) -> bytes:
    figure = figure_of(4.0)
    left, right = figure.subplots(1, 2, width_ratios=(1.0, 2.0))
    lengths = np.array([each.length for each in pendulums])
    if np.isfinite(lengths).any():
        shown = np.linspace(0.8 * np.nanmin(lengths), 1.1 * np.nanmax(lengths), 100)
        left.plot(shown, [natural_frequency(float(each)) for each in shown], color="#9a9a9a", label="theory")
    left.plot(lengths, [each.swing.frequency for each in pendulums], "o", color="C0", label="measured")
    left.set_xlabel("length, m", fontsize=8)
    left.set_title("natural frequency, Hz", fontsize=10)
    left.legend(fontsize=8)
    longest = pendulums[int(np.nanargmax(lengths))] if np.isfinite(lengths).any() else pendulums[0]
    sine = np.degrees(np.arcsin(np.clip(longest.measured, -1.0, 1.0)))
    right.plot(longest.times, sine, ".", color="C0", markersize=2.5, label="ball in the images")
    fitted = np.degrees(np.arcsin(np.clip(longest.swing.fitted, -1.0, 1.0)))
    right.plot(longest.times, fitted, color="black", linewidth=0.6, label="damped oscillation")
    right.set_title(f"{longest.name}: angle, degrees", fontsize=10)
    right.set_xlabel("s", fontsize=8)
    right.legend(fontsize=8, loc="upper right")
    return png_of(figure)


def _draw_decays(links: Sequence[tuple[str, list[Decay]]]) -> bytes:
    figure = figure_of(3.5)
    axis = figure.subplots()
    for colour, (name, decays) in enumerate(links):
        for by, sign in (("vicon", "o"), ("gyroscope", "x")):
            swings = [getattr(each, by) for each in decays]
            axis.errorbar(
                [each.start for each in decays],
                [each.frequency for each in swings],
                [1.96 * each.stddev for each in swings],
                fmt=sign,
                color=f"C{colour}",
                label=f"{name}, {by}",
            )
    axis.set_title("frequency after each release, Hz", fontsize=10)
    axis.set_xlabel("s", fontsize=8)
    axis.legend(fontsize=8)
    return png_of(figure)


# --- the command


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking evaluate baseline``."""
    command = subparsers.add_parser(
        "evaluate baseline",
        description="Tests of a camera by something whose motion is known, as in chapter 4.1 of Schlagenhauf 2017. "
        "`body_tracking simulate baseline` makes such recordings.",
    )
    tests = command.add_subparsers(metavar="TEST", required=True)
    arm = tests.add_parser(
        "arm",
        help="a robot arm with three red balls",
        description="Tracks three red balls on a robot arm in colour and depth images. Delay and rigid registration "
        "are fitted on the first trial; the errors of the others are of data that nothing was fitted to.",
    )
    arm.add_argument("trials", type=Path, nargs="+", metavar="BAG", help="two or more executions of one motion")
    arm.add_argument("--driver", default="plain", choices=tuple(DRIVERS), help="whose topics (default: %(default)s)")
    arm.add_argument(
        "--balls",
        default=BALLS,
        metavar="TOPIC",
        help="geometry_msgs/PoseArray with the balls of base, elbow and end effector in the robot's frame (default: "
        "%(default)s)",
    )
    arm.add_argument(
        "--diameter", type=float, default=0.06, metavar="M", help="of the balls, metres (default: %(default)s)"
    )
    arm.set_defaults(run=_arm)
    pendulum = tests.add_parser(
        "pendulum",
        help="the frequency of a pendulum",
        description="Finds a retro-reflective ball in infrared images, and fits a damped oscillation to its angle. Or "
        "reads files of the pendulum with Vicon of Szczesna et al. (2016).",
    )
    pendulum.add_argument(
        "recordings",
        nargs="+",
        metavar="BAG=LENGTH",
        help="infrared and depth images, and the pendulum's length in metres; or .csv or .csv.gz files",
    )
    pendulum.add_argument("--infrared", metavar="TOPIC", help="infrared images (default: /<camera>/infrared/image_raw)")
    pendulum.add_argument("--depth", metavar="TOPIC", help="depth images (default: /<camera>/depth/image_raw)")
    pendulum.add_argument(
        "--gravity", type=float, default=STANDARD_GRAVITY, metavar="G", help="m/s^2 (default: %(default)s)"
    )
    pendulum.set_defaults(run=_pendulum)
    for parser in (arm, pendulum):
        parser.add_argument("--camera", default="camera1", metavar="NAME", help="its name (default: %(default)s)")
        parser.add_argument("-o", "--output", type=Path, metavar="PNG", help="draw a picture into this file")
        parser.add_argument("--json", action="store_true", help="print all results as JSON instead of tables")


def _arm(args: argparse.Namespace) -> int:
    if not 0.005 <= args.diameter <= 0.5:
        raise EvaluationError(f"--diameter {args.diameter}: expected 0.005 to 0.5 m")
    topics = DRIVERS[args.driver].of(args.camera)
    result = compare([read_arm(path, topics, args.balls, args.diameter) for path in args.trials])
    _show(args, arm_report(result), lambda: _draw_arm(result))
    return 0


def _pendulum(args: argparse.Namespace) -> int:
    if not 1.0 <= args.gravity <= 30.0:
        raise EvaluationError(f"--gravity {args.gravity}: expected 1 to 30 m/s^2")
    files = [each.endswith(_CSV) for each in args.recordings]
    if any(files) and not all(files):
        raise EvaluationError("either bags or .csv files, not both")
    if all(files):
        links = [
            (Path(each).name.removesuffix(".gz").removesuffix(".csv"), vicon_decays(Path(each)))
            for each in args.recordings
        ]
        _show(args, vicon_report(links), lambda: _draw_decays(links))
        return 0
    pendulums = [_fitted(each, args) for each in args.recordings]
    _show(args, pendulum_report(pendulums), lambda: _draw_pendulums(pendulums))
    return 0


def _fitted(recording: str, args: argparse.Namespace) -> Pendulum:
    """The pendulum of ``BAG=LENGTH`` or ``BAG``."""
    name, equals, given = recording.rpartition("=")
    path = Path(name if equals else recording)
    length = float("nan")
    if equals:
        try:
            length = float(given)
        except ValueError:
            length = -1.0
        if not 0.0 < length < 100.0:
            raise EvaluationError(f"{recording}: {given!r} is no length in metres")
    infrared = args.infrared or infrared_topic(args.camera)
    track = read_pendulum(path, infrared, args.depth or DRIVERS["plain"].of(args.camera).depth)
    measured = sines(track.points)
    try:
        swing = fit_swing(track.times, measured, "sine")
    except PendulumError as error:
        raise PendulumError(f"{path}: {error}") from error
    theory = natural_frequency(length, args.gravity)
    return Pendulum(path.name, length, theory, swing, track.times, measured)


def _show(args: argparse.Namespace, report: Report, draw: Any) -> None:
    if args.output is not None:
        make_folder(args.output)
        write(args.output, draw())
    print(report.json() if args.json else f"{report.lines()}\n{report.text()}")
    if args.output is not None and not args.json:
        print(f"\npicture: {args.output}")

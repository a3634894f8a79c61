"""Plots: the person at some instants, angles over time with their uncertainty, and errors over time."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from body_tracking.core.skeleton import BONES, JOINT_NAMES, NANOSECONDS, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.comparison import MAX_GAP, AngleComparison, Evaluation
from body_tracking.evaluation.metrics import angle_errors
from body_tracking.evaluation.reading import AngleSeries, Tracked, nearest, true_at
from body_tracking.evaluation.report import named_are_positional, write
from body_tracking.kinematics.labels import limb_of

_COLOURS = {"left": "#2a86d6", "right": "#e8712f", "": "#7d8793"}
_TRUE_COLOURS = {"left": "#0020a0", "right": "#991500", "": "#000000"}
"""Darker shades of the same colours: the truths of both sides are told apart, and show on the lines that they cover."""
_DASHES = (0.0, (4.0, 3.0))
"""Of truths: with gaps in which the line below shows."""
_TRUNK = "#3a3a3a"
"""Of the person's bones without a side: dark, since the true person is grey."""
_COLUMNS, _INSTANTS = 4, 6
ENOUGH = 0.02
"""Least share of the frames in which an angle is known to be drawn, and to have statistics."""
_POINTS = 1500
"""Largest number of points of a curve; the picture has no more columns."""
_STILL = 30.0
"""Least range of an axis of angles, degrees: a constant angle should look constant."""
_FINE = 0.5
"""Degrees: median standard deviation below which errors have panels of their own."""
_VIEW = np.radians(25.0)
"""Angle of the view from the person's front, which makes depth visible."""


def _legend(names: Iterable[str], dashed: str = ", truth dashed") -> str:
    sides = "left blue, right orange, " if any(map(_side, names)) else ""
    return f"{sides}band 1.96 standard deviations{dashed}; no line where the angle is unknown"


def draw(tracked: Tracked, path: Path) -> None:
    """Draw the person and the angles of a recording (at least one frame) into a PNG file; raises as :func:`write`."""
    angles, known = tracked.angles, tracked.angles.known
    start_ns = int(angles.stamps_ns[0])
    times, true = (angles.stamps_ns - start_ns) / NANOSECONDS, true_at(angles, tracked.true_angles)
    shown = [AngleComparison(angles.names, times, known, true, angles.stddev, angle_errors(known, true, angles.stddev))]
    if are_fine(angles) and np.isfinite(true).any():
        names = tuple(f"error of {name}" for name in angles.names)
        shown.append(
            replace(shown[0], names=names, found=wrapped(known - true), true=np.where(np.isnan(true), true, 0))
        )
    heights = [3.6] * bool(tracked.skeletons) + [_height(each.names) for each in shown]
    figure = figure_of(0.3 + sum(heights))
    parts = figure.subfigures(len(heights), 1, height_ratios=heights) if len(heights) > 1 else (figure,)
    legend = _legend(angles.names) if np.isfinite(true).any() else _legend(angles.names, "")
    figure.suptitle(f"{tracked.bag.name}: {len(known)} frames, {tracked.duration:.1f} s; {legend}", fontsize=11)
    if tracked.skeletons:
        _draw_person(parts[0], tracked, start_ns)
    for part, each in zip(parts[-len(shown) :], shown, strict=True):
        _draw_angles(part, each, _STILL if each is shown[0] else 0.0)
    write(path, png_of(figure))


def are_fine(angles: AngleSeries) -> bool:
    """Whether standard deviations are too small to be visible in a plot of angles."""
    stated = angles.stddev[np.isfinite(angles.stddev)]
    return bool(len(stated)) and float(np.degrees(np.median(stated))) < _FINE


def pictures(result: Evaluation) -> list[tuple[str, str]]:
    """Captions and ``data:`` addresses of the plots in an evaluation's report."""
    first = result.comparisons[0]
    angles = first.named if first.named is not None and not named_are_positional(result) else first.positional
    drawn = [
        (f"Distance of each joint from the truth, mm, {first.name}; white: not known in both", _errors(result)),
        (f"Angles, degrees, {first.name}; {_legend(angles.names)}", _angle_picture(angles)),
    ]
    if result.calibration:
        drawn.append(("Calibration over time against the true one", _calibration(result)))
    return drawn


def reference_pictures(angles: AngleComparison) -> list[tuple[str, str]]:
    """Captions and ``data:`` addresses of the plots in an evaluation by the marker system."""
    return [(f"Angles, degrees; {_legend(angles.names)}", _angle_picture(angles))] if angles.names else []


def _angle_picture(angles: AngleComparison) -> str:
    """``data:`` address of a plot of angles beside true ones; angles that the estimate does not state are left out."""
    stated = np.isfinite(angles.stddev)
    figure = figure_of(_height(angles.names))
    _draw_angles(figure, replace(angles, found=np.where(stated | ~stated.any(), angles.found, np.nan)))
    return _address(figure)


def figure_of(height: float) -> Any:
    from matplotlib.figure import Figure  # slow to import, and not needed for tables

    return Figure(figsize=(15.0, height), dpi=100, layout="constrained")


def png_of(figure: Any) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # as in figure_of

    data = io.BytesIO()
    # savefig draws the figure twice, the first time for its layout
    FigureCanvasAgg(figure).print_png(data)  # type: ignore[no-untyped-call]
    return data.getvalue()


def _address(figure: Any) -> str:
    return f"data:image/png;base64,{base64.b64encode(png_of(figure)).decode()}"


def _thin(count: int) -> slice:
    return slice(None, None, max(1, count // _POINTS))


def _label(axis: Any, title: str) -> None:
    axis.set_title(title, fontsize=10)
    axis.set_xlabel("s", fontsize=8)
    axis.tick_params(labelsize=8, labelbottom=True)
    axis.grid(color="#eeeeee")
    axis.set_axisbelow(True)
    axis.margins(x=0.01)


# --- angles


def _side(name: str) -> str:
    """The side of an angle's limb; empty of the trunk's, whose names may end with a direction."""
    side = limb_of(name).partition(" ")[0]
    return side if side in ("left", "right") else ""


def _panels(names: tuple[str, ...]) -> dict[str, list[int]]:
    """Column indices by title: left and right angles share a panel."""
    panels: dict[str, list[int]] = {}
    for column, name in enumerate(names):
        panels.setdefault(name.removesuffix(f"_{_side(name)}").replace("_", " "), []).append(column)
    return panels


def _height(names: tuple[str, ...]) -> float:
    return 2.5 * -(-len(_panels(names)) // _COLUMNS)


def _unbroken(degrees: FloatArray) -> FloatArray:
    """The curve, interrupted where it wraps between +180 and -180 degrees."""
    curve = degrees.copy()
    curve[1:][np.abs(np.diff(degrees)) > 180.0] = np.nan
    return curve


def _with_gaps(times: FloatArray, *series: FloatArray) -> list[FloatArray]:
    """Times (n,) and series (n, ...) with NaN at both ends of each gap, over which lines and cells would be drawn."""
    if len(times) < 2:
        return [times, *series]
    gap = max(MAX_GAP, 2.0 * float(np.median(np.diff(times))))
    after = np.repeat(np.flatnonzero(np.diff(times) > gap) + 1, 2)
    ends = np.where(np.arange(len(after)) % 2, times[after] - gap / 3.0, times[after - 1] + gap / 3.0)
    return [np.insert(times, after, ends), *(np.insert(each, after, np.nan, axis=0) for each in series)]


def _draw_angles(figure: Any, angles: AngleComparison, still: float = _STILL) -> None:
    panels, shown = _panels(angles.names), _thin(len(angles.times))
    axes = figure.subplots(-(-len(panels) // _COLUMNS), _COLUMNS, sharex=True, squeeze=False)
    series = (angles.found, angles.true, angles.stddev)
    times, found, true, stddev = _with_gaps(angles.times[shown], *(each[shown] for each in series))
    band = 1.96 * np.degrees(np.where(np.isfinite(stddev), stddev, np.nan))
    found, true = np.degrees(found), np.degrees(true)
    found[:, np.isfinite(angles.found).mean(axis=0) < ENOUGH] = np.nan
    for axis, (title, columns) in zip(axes.flat, panels.items(), strict=False):
        for column in columns:
            side, curve = _side(angles.names[column]), _unbroken(found[:, column])
            colour = _COLOURS[side]
            low, high = curve - band[:, column], curve + band[:, column]
            axis.fill_between(times, low, high, color=colour, alpha=0.18, linewidth=0.0)
            axis.plot(times, curve, color=colour, linewidth=1.6)
            # isolated known angles have no line, so draw a dot
            around = np.pad(np.isfinite(curve), 1)
            axis.plot(*np.array([times, curve])[:, around[1:-1] & ~around[:-2] & ~around[2:]], ".", color=colour)
            truth = _unbroken(true[:, column])
            axis.plot(times, truth, linestyle=_DASHES, color=_TRUE_COLOURS[side], linewidth=1.0)
        edge = np.nan_to_num(np.minimum(band[:, columns], 30.0))  # wider bands would flatten the curves
        edges = np.concatenate([found[:, columns] - edge, found[:, columns] + edge, true[:, columns]])
        least, most = (np.nanmin(edges), np.nanmax(edges)) if np.isfinite(edges).any() else (0.0, 0.0)
        margin = max(0.05 * (most - least), 0.5 * (still - (most - least)))
        axis.set_ylim(least - margin, most + margin)
        _label(axis, title)
    for axis in axes[:, 0]:
        axis.set_ylabel("deg", fontsize=8)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)


# --- the person


def _draw_person(figure: Any, tracked: Tracked, start_ns: int) -> None:
    """Stick figures at evenly spaced instants.

    The true figures are moved to the estimate's pelvis and turned by one angle about z, since their world may differ.
    """
    skeletons, truths = tracked.skeletons, tracked.true_skeletons
    chosen = [skeletons[n] for n in np.unique(np.linspace(0, len(skeletons) - 1, _INSTANTS).astype(int))]
    stamps, true = (np.array([each.stamp_ns for each in side], dtype=np.int64) for side in (chosen, truths))
    matches = nearest(true, stamps) if truths else np.full(len(chosen), -1)
    axes = figure.subplots(1, len(chosen), sharex=True, sharey=True, squeeze=False)[0]
    heading = float(np.angle(_left(chosen).sum()))
    view = _view(heading)
    pairs = [(skeleton, truths[match]) for skeleton, match in zip(chosen, matches, strict=True) if match >= 0]
    true_view = _view(heading + _turn(pairs))
    circles = ""
    for axis, skeleton, match in zip(axes, chosen, matches, strict=True):
        base = skeleton.positions[Joint.SPINE_BASE]
        if match >= 0:
            truth = truths[match].positions
            true_base = truth[Joint.SPINE_BASE]
            true_base = true_base if np.isfinite(true_base).all() else base
            _draw_bones(axis, (truth - true_base) @ true_view.T, color="#9a9a9a", linewidth=4.0, alpha=0.45)
        points = (skeleton.positions - base) @ view.T
        _draw_bones(axis, points)
        unseen = points[skeleton.states != TrackingState.TRACKED]
        if np.isfinite(unseen).any():
            axis.plot(*unseen.T, "o", color="white", markeredgecolor="red", markersize=4.5)
            circles = "; circles: not tracked by any sensor"
        axis.set_title(f"{(skeleton.stamp_ns - start_ns) / NANOSECONDS:.1f} s", fontsize=9)
        axis.set_aspect("equal")
        axis.axis("off")
    grey = "truth grey (moved and turned onto the estimate)" if pairs else ""
    figure.supxlabel(f"{grey}{circles}".removeprefix("; "), fontsize=8)


def _draw_bones(axis: Any, points: FloatArray, **style: Any) -> None:
    for bone in BONES:
        side = _side(Joint(bone[1]).name.lower())
        axis.plot(*points[list(bone)].T, **{"color": _COLOURS[side] if side else _TRUNK, "linewidth": 1.6} | style)


def _left(skeletons: Iterable[Skeleton]) -> npt.NDArray[np.complex128]:
    """(n,) x + iy of the vectors from the right hip to the left hip, metres; 0 if unknown."""
    across = np.array([each.positions[Joint.HIP_LEFT] - each.positions[Joint.HIP_RIGHT] for each in skeletons])
    across = np.nan_to_num(across.reshape(-1, 3))
    left: npt.NDArray[np.complex128] = across[:, 0] + 1j * across[:, 1]
    return left


def _turn(pairs: list[tuple[Skeleton, Skeleton]]) -> float:
    """Rotation about z of the second skeletons relative to the first, radians; 0 without common hips."""
    first, second = _left(first for first, _ in pairs), _left(second for _, second in pairs)
    return float(np.angle((second * first.conj()).sum()))


def _view(heading: float) -> FloatArray:
    """(2, 3) projection from world to picture: turned from the person's front by the angle of view, z up."""
    angle = heading + _VIEW  # the person's left is the picture's right
    return np.array([[np.cos(angle), np.sin(angle), 0.0], [0.0, 0.0, 1.0]])


# --- errors


def _errors(result: Evaluation) -> str:
    comparison = result.comparisons[0]
    joints, shown = np.flatnonzero(comparison.joints.frames), _thin(len(comparison.times))
    distances = 1e3 * np.linalg.norm(comparison.found - comparison.true, axis=-1)[shown][:, joints]
    times, distances = _with_gaps(comparison.times[shown], distances)
    figure, rows = figure_of(5.0), range(len(joints))
    axis = figure.subplots()
    highest = max(float(np.nanpercentile(distances, 99.0)), 1.0)
    colours = axis.pcolormesh(times, rows, distances.T, vmin=0.0, vmax=highest, shading="nearest")
    axis.set_yticks(rows, [JOINT_NAMES[joint] for joint in joints], fontsize=8)
    axis.invert_yaxis()
    axis.set_xlabel("s", fontsize=8)
    figure.colorbar(colours, label="mm")
    return _address(figure)


def _calibration(result: Evaluation) -> str:
    figure = figure_of(3.0)
    axes = figure.subplots(1, 3)
    for number, each in enumerate(result.calibration):
        curves = (
            (each.times, np.degrees(each.poses.rotation)),
            (each.times, 1e3 * each.poses.displacement),
            (each.clock_times, 1e3 * each.clock),
        )
        for axis, (times, values) in zip(axes, curves, strict=True):
            if len(times):  # the last one holds until the end
                end = max(result.span[1], times[-1])
                axis.step([*times, end], [*values, values[-1]], where="post", color=f"C{number}", label=each.sensor)
    for axis, title in zip(axes, ("rotation, deg", "at the person, mm", "clock, ms"), strict=True):
        axis.axhline(0.0, color="#9a9a9a", linewidth=0.8)
        _label(axis, title)
    axes[0].legend(fontsize=8)
    return _address(figure)

"""A picture of a recording: the person at some instants, and every joint angle over time with its uncertainty."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from body_tracking.evaluation.summary import AngleSeries, EvaluationError, Tracked, nearest
from body_tracking.skeleton import BONES, NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton, TrackingState

_INSTANTS = 6
_LEFT, _RIGHT, _MIDDLE, _TRUTH = "#1f6fb4", "#d1571b", "#3a3a3a", "#9a9a9a"
_COLUMNS = 4
_VIEW = np.radians(25.0)
"""By which the viewer stands off the person's front, so that depth shows."""


def draw(tracked: Tracked, path: Path) -> None:
    """Draw what was tracked into a PNG file.

    Args:
        tracked: with at least one frame of angles.
        path: of the PNG; its folder is made where it is missing.

    Raises:
        EvaluationError: the file cannot be written.
    """
    # matplotlib is slow to import, and whoever asks for a table alone does not need it
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    panels = _panels(tracked.angles.names)
    rows = -(-len(panels) // _COLUMNS)
    figure = Figure(figsize=(15.0, 3.9 + 2.5 * rows), dpi=100, layout="constrained")
    FigureCanvasAgg(figure)
    parts: Any = figure.subfigures(2, 1, height_ratios=(3.6, 2.5 * rows))
    top, bottom = parts
    start_ns = int(tracked.angles.stamps_ns[0])
    count = len(tracked.angles.stamps_ns)
    figure.suptitle(
        f"{tracked.bag.name}: {count} frames, {tracked.duration:.1f} s; angles with ± 2 standard deviations, "
        "no line where nothing observes the angle",
        fontsize=11,
    )
    instants = _draw_figures(top, tracked, start_ns)
    axes = bottom.subplots(rows, _COLUMNS, sharex=True, squeeze=False)
    for number, (axis, title) in enumerate(zip(axes.flat, panels, strict=False)):
        _draw_panel(axis, tracked, title, panels[title], start_ns)
        for instant in instants:
            axis.axvline(instant, color="#cccccc", linewidth=0.8, zorder=0)
        if number + _COLUMNS >= len(panels):
            axis.set_xlabel("s")
            axis.xaxis.set_tick_params(labelbottom=True)
    for axis in axes.flat[len(panels) :]:
        axis.set_visible(False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png")
    except OSError as error:
        raise EvaluationError(f"{path}: {error.strerror or error}") from error


def _panels(names: tuple[str, ...]) -> dict[str, list[tuple[int, str, str]]]:
    """Title to (column, colour, side) of its curves: left and right of an angle share a panel."""
    panels: dict[str, list[tuple[int, str, str]]] = {}
    for column, name in enumerate(names):
        base, colour, side = name, _MIDDLE, ""
        for ending, side_colour in (("_left", _LEFT), ("_right", _RIGHT)):
            if name.endswith(ending):
                base, colour, side = name.removesuffix(ending), side_colour, ending[1:]
        panels.setdefault(base.replace("_", " "), []).append((column, colour, side))
    return panels


def _unbroken(degrees: FloatArray) -> FloatArray:
    """The curve with a gap where it passes from +180 to -180 or back."""
    curve = degrees.copy()
    curve[1:][np.abs(np.diff(degrees)) > 180.0] = np.nan
    return curve


def _draw_panel(axis: Any, tracked: Tracked, title: str, curves: list[tuple[int, str, str]], start_ns: int) -> None:
    angles, truth = tracked.angles, tracked.true_angles
    time = (angles.stamps_ns - start_ns) / NANOSECONDS
    known = np.degrees(angles.known)
    stddev = np.degrees(np.where(np.isfinite(angles.stddev), angles.stddev, np.nan))
    for column, colour, side in curves:
        if truth is not None and angles.names[column] in truth.names:
            _draw_truth(axis, truth, angles.names[column], start_ns, angles.stamps_ns[-1])
        curve, band = _unbroken(known[:, column]), 2.0 * stddev[:, column]
        axis.fill_between(time, curve - band, curve + band, color=colour, alpha=0.18, linewidth=0.0)
        axis.plot(time, curve, color=colour, linewidth=1.3, label=side or "measured")
    axis.set_title(f"{title} (deg)", fontsize=10)
    axis.grid(color="#eeeeee")
    axis.set_axisbelow(True)
    axis.margins(x=0.01)
    _limit(axis, known, stddev, [column for column, _, _ in curves])
    handles, labels = axis.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if len(unique) > 1:
        axis.legend(unique.values(), unique.keys(), fontsize=7, loc="upper right", framealpha=0.7)
    if not np.isfinite(known[:, [column for column, _, _ in curves]]).any():
        axis.text(0.5, 0.5, "not observed", transform=axis.transAxes, ha="center", va="center", backgroundcolor="white")


def _limit(axis: Any, known: FloatArray, stddev: FloatArray, columns: list[int]) -> None:
    """Show all curves, and bands up to a width that leaves the curves readable; a still angle should look still."""
    band = np.minimum(2.0 * stddev[:, columns], 30.0)
    edges = np.concatenate([known[:, columns] - band, known[:, columns] + band])
    edges = np.append(edges[np.isfinite(edges)], [y for line in axis.lines for y in np.asarray(line.get_ydata())])
    edges = edges[np.isfinite(edges)]
    low, high = (edges.min(), edges.max()) if len(edges) else (0.0, 0.0)
    margin = max(0.05 * (high - low), 0.5 * (30.0 - (high - low)))
    axis.set_ylim(low - margin, high + margin)


def _draw_truth(axis: Any, truth: AngleSeries, name: str, start_ns: int, end_ns: int) -> None:
    shown = (truth.stamps_ns >= start_ns) & (truth.stamps_ns <= end_ns)
    curve = _unbroken(np.degrees(truth.position[shown, truth.names.index(name)]))
    axis.plot(
        (truth.stamps_ns[shown] - start_ns) / NANOSECONDS, curve, "--", color="#111111", linewidth=0.8, label="truth"
    )


def _draw_figures(figure: Any, tracked: Tracked, start_ns: int) -> list[float]:
    """Stick figures at some instants; returns these, in seconds."""
    skeletons = tracked.skeletons
    if not skeletons:
        figure.text(0.5, 0.5, "no skeletons in the recording", ha="center", color=_TRUTH)
        return []
    stamps = np.array([skeleton.stamp_ns for skeleton in skeletons], dtype=np.int64)
    chosen = _instants(skeletons)
    view = _view(skeletons)
    truths = tracked.true_skeletons
    matches = (
        nearest(np.array([truth.stamp_ns for truth in truths], dtype=np.int64), stamps[chosen])
        if truths
        else np.full(len(chosen), -1)
    )
    axes = figure.subplots(1, len(chosen), sharex=True, sharey=True, squeeze=False)[0]
    for axis, index, match in zip(axes, chosen, matches, strict=True):
        centre = _centre(skeletons[index])
        if match >= 0:
            points = (truths[match].positions - centre) @ view.T
            axis.plot(*_lines(points), color=_TRUTH, linewidth=4.0, alpha=0.45, solid_capstyle="round")
        points = (skeletons[index].positions - centre) @ view.T
        for colour, part in ((_MIDDLE, ""), (_RIGHT, "RIGHT"), (_LEFT, "LEFT")):
            axis.plot(*_lines(points, part), color=colour, linewidth=1.6)
        seen: BoolArray = skeletons[index].states == TrackingState.TRACKED
        axis.plot(*points[seen].T, "o", color=_MIDDLE, markersize=2.5)
        axis.plot(*points[~seen].T, "o", color="white", markeredgecolor="red", markersize=4.5)
        axis.set_title(f"{(stamps[index] - start_ns) / NANOSECONDS:.1f} s", fontsize=9)
        axis.set_aspect("equal")
        axis.axis("off")
    legend = (
        f"left blue, right orange{', truth grey' if (matches >= 0).any() else ''}, circles: not tracked by any sensor"
    )
    figure.supxlabel(legend, fontsize=8)
    return [float(stamps[index] - start_ns) / NANOSECONDS for index in chosen]


def _centre(skeleton: Skeleton) -> FloatArray:
    known = skeleton.positions[np.isfinite(skeleton.positions).all(axis=1)]
    base = skeleton.positions[Joint.SPINE_BASE]
    centre: FloatArray = base if np.isfinite(base).all() or not len(known) else known.mean(axis=0)
    return centre


def _instants(skeletons: tuple[Skeleton, ...]) -> list[int]:
    """Frames that differ most from each other and lie apart (farthest-point sampling of the poses), in time order."""
    poses = np.array([skeleton.positions - _centre(skeleton) for skeleton in skeletons]).reshape(len(skeletons), -1)
    poses = np.where(np.isfinite(poses), poses, 0.0)
    chosen = [min(len(poses) - 1, 30)]
    distance = np.full(len(poses), np.inf)
    apart = len(poses) / (2 * _INSTANTS)
    while len(chosen) < min(_INSTANTS, len(poses)):
        distance = np.minimum(distance, np.linalg.norm(poses - poses[chosen[-1]], axis=1))
        distance[np.abs(np.arange(len(poses)) - chosen[-1]) < apart] = 0.0
        if distance.max() <= 0.0:
            break
        chosen.append(int(distance.argmax()))
    return sorted(chosen)


def _view(skeletons: tuple[Skeleton, ...]) -> FloatArray:
    """(2, 3) world to picture: somewhat off the front that the person shows on average, z up."""
    across = np.array(
        [skeleton.positions[Joint.HIP_LEFT] - skeleton.positions[Joint.HIP_RIGHT] for skeleton in skeletons]
    )
    across = across[np.isfinite(across).all(axis=1)]
    left = across.mean(axis=0) if len(across) else np.array([0.0, 1.0, 0.0])
    heading = np.arctan2(left[1], left[0]) + _VIEW  # the person's left is the picture's right
    return np.array([[np.cos(heading), np.sin(heading), 0.0], [0.0, 0.0, 1.0]])


def _lines(points: FloatArray, part: str | None = None) -> tuple[FloatArray, FloatArray]:
    """The bones as one line with gaps; ``part`` LEFT, RIGHT or empty for the middle, None for all."""
    bones = [
        bone
        for bone in BONES
        if part is None
        or (part in Joint(bone[1]).name if part else not {"LEFT", "RIGHT"} & set(Joint(bone[1]).name.split("_")))
    ]
    line = np.full((len(bones), 3, 2), np.nan)
    line[:, :2] = points[np.array(bones)]
    return line[:, :, 0].ravel(), line[:, :, 1].ravel()

"""The pictures of an evaluation's report, each as a ``data:`` address that a page can hold."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from body_tracking.evaluation.comparison import ALIGNED, AngleComparison, Comparison, Evaluation
from body_tracking.evaluation.report import THESIS_JOINTS, named_are_positional
from body_tracking.evaluation.segments import segment_frames
from body_tracking.skeleton import JOINT_NAMES, BoolArray, FloatArray, IntArray

_AXES = ("#c0392b", "#2e8b57", "#1f6fb4")
_SIDES = {"left": "#1f6fb4", "right": "#d1571b", "": "#3a3a3a"}
_TRUTH, _QUIET = "#111111", "#9a9a9a"
_COLOURS = {True: "#d1571b", False: "#1f6fb4"}
_POINTS = 1500
"""No curve needs more of them than the picture has columns."""


def pictures(result: Evaluation, progress: Callable[[float], None] | None = None) -> Iterator[tuple[str, str, str]]:
    """Title, explanation and ``data:`` address of each picture.

    Args:
        result: what was found.
        progress: called after each with the share that is done, from 0 to 1.
    """
    first = result.comparisons[0]
    compared = np.flatnonzero(first.joints.frames)
    ten = np.intersect1d(compared, THESIS_JOINTS)
    drawn: list[tuple[str, str, Callable[[], str]]] = [
        (
            "Errors over time",
            "Distance from the truth, mm: every joint, and the mean over all. White: not known in both.",
            lambda: _errors(result, compared),
        ),
        (
            "Errors of each joint",
            "Boxes: quartiles and median of the distance from the truth; whiskers: 5 % and 95 %.",
            lambda: _boxes(result, compared),
        ),
        (
            f"Trajectories, {first.name}",
            "Position, m: x red, y green, z blue; the truth black and dashed.",
            lambda: _trajectories(first, ten if len(ten) else compared[:10]),
        ),
        (
            f"Angles, {first.name}",
            "Degrees: left blue, right orange, where the estimate states a standard deviation; bands: 1.96 of them to "
            "each side; the truth black and dashed, where its pose determines the angle.",
            lambda: _angles(first.positional),
        ),
        (
            "Coverage of the standard deviations",
            "Share of the frames in which the truth lies in what is stated as the 95 % interval (of an angle) or "
            "ellipsoid (of a joint). Less than 95 %: surer than it may be. The band is 90 to 99 %.",
            lambda: _coverage(result, compared),
        ),
    ]
    named = first.named
    if named is not None and not named_are_positional(result):
        drawn.append(
            (
                f"Angles by name, {first.name}",
                "Those that the estimate states, in the same colours.",
                lambda: _angles(named),
            )
        )
    if result.calibration:
        drawn.append(
            (
                "Calibration found against the true one",
                "Of each sensor over time: error of its rotation, how far off it shows the person, error of its clock.",
                lambda: _calibration(result),
            )
        )
    for number, (title, explanation, draw) in enumerate(drawn):
        yield title, explanation, draw()
        if progress is not None:
            progress((number + 1) / len(drawn))


def _figure(width: float, height: float) -> Any:
    # matplotlib is slow to import, and whoever asks for a table alone does not need it
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100)
    FigureCanvasAgg(figure)
    return figure


def _address(figure: Any, form: str) -> str:
    """PNG for many points, SVG for few."""
    from matplotlib import rc_context

    data = io.BytesIO()
    with rc_context({"svg.hashsalt": "body_tracking"}):
        figure.savefig(data, format=form, metadata={"Date": None} if form == "svg" else None)
    kind = "svg+xml" if form == "svg" else form
    return f"data:image/{kind};base64,{base64.b64encode(data.getvalue()).decode()}"


def _distances(comparison: Comparison) -> FloatArray:
    """(n, 25) mm."""
    distances: FloatArray = 1e3 * np.linalg.norm(comparison.found - comparison.true, axis=-1)
    return distances


def _fixed_distances(comparison: Comparison) -> FloatArray:
    """(n, 25) mm, without each joint's own offset."""
    own = np.einsum("njba,njb->nja", segment_frames(comparison.true), comparison.found - comparison.true)
    distances: FloatArray = 1e3 * np.linalg.norm(own - comparison.joints.offset, axis=-1)
    return distances


def _thin(count: int) -> IntArray:
    return np.arange(0, count, max(1, count // _POINTS))


def _tidy(axis: Any) -> None:
    axis.grid(color="#eeeeee")
    axis.set_axisbelow(True)
    axis.margins(x=0.01)
    axis.tick_params(labelsize=8)


def _errors(result: Evaluation, joints: IntArray) -> str:
    figure = _figure(12.0, 7.2)
    first = result.comparisons[0]
    heat, line = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (2.2, 1.0)})
    rows = _evenly(first.times, _distances(first)[:, joints], result.parameters.max_gap)
    top = float(np.nanpercentile(rows, 99.0))
    picture = heat.imshow(
        rows.T,
        aspect="auto",
        interpolation="nearest",
        extent=(first.times[0], first.times[-1], len(joints) - 0.5, -0.5),
        vmin=0.0,
        vmax=max(top, 1.0),
        cmap="viridis",
    )
    heat.set_yticks(range(len(joints)), [JOINT_NAMES[joint] for joint in joints], fontsize=8)
    heat.set_title(first.name, fontsize=10)
    for comparison in result.comparisons:
        each = _distances(comparison)[:, joints]
        there = np.isfinite(each)
        mean = np.where(there, each, 0.0).sum(axis=1) / np.where(there.any(axis=1), there.sum(axis=1), np.nan)
        aligned = comparison.name == ALIGNED
        line.plot(comparison.times, mean, color=_COLOURS[aligned], linewidth=1.2, label=comparison.name)
    line.set_ylim(bottom=0.0)
    line.set_ylabel("mean, mm", fontsize=9)
    line.set_xlabel("s", fontsize=9)
    line.legend(fontsize=8)
    _tidy(line)
    figure.subplots_adjust(left=0.11, right=0.9, top=0.95, bottom=0.08, hspace=0.08)
    bar = figure.add_axes((0.92, 0.4, 0.015, 0.55))
    figure.colorbar(picture, cax=bar, label="mm")
    return _address(figure, "png")


def _evenly(times: FloatArray, values: FloatArray, max_gap: float) -> FloatArray:
    """(points, ...) the values at the nearest of (n,) times, evenly spaced; NaN in gaps."""
    at = np.linspace(times[0], times[-1], min(_POINTS, len(times)))
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    nearest = np.where(at - times[after - 1] < times[after] - at, after - 1, after)
    even = values[nearest]
    even[np.abs(times[nearest] - at) > 0.5 * max_gap] = np.nan
    return even


def _boxes(result: Evaluation, joints: IntArray) -> str:
    figure = _figure(12.0, 4.6)
    axis = figure.subplots()
    kinds = [(each.name, _distances(each), _COLOURS[each.name == ALIGNED]) for each in result.comparisons]
    last = result.comparisons[-1]
    kinds.append((f"{last.name}, without own offset", _fixed_distances(last), "#2e8b57"))
    width = 0.8 / len(kinds)
    for number, (_, distances, colour) in enumerate(kinds):
        columns = [each[np.isfinite(each)] for each in distances[:, joints].T]
        there = [place for place, each in enumerate(columns) if len(each)]
        low, first, middle, third, high = np.array([np.percentile(columns[n], (5, 25, 50, 75, 95)) for n in there]).T
        stats = [
            {"whislo": a, "q1": b, "med": c, "q3": d, "whishi": e, "fliers": ()}
            for a, b, c, d, e in zip(low, first, middle, third, high, strict=True)
        ]
        axis.bxp(
            stats,
            positions=np.array(there) + (number - 0.5 * (len(kinds) - 1)) * width,
            widths=0.85 * width,
            showfliers=False,
            patch_artist=True,
            boxprops={"facecolor": colour, "alpha": 0.55, "linewidth": 0.5},
            medianprops={"color": "black", "linewidth": 1.0},
            whiskerprops={"linewidth": 0.7},
            capprops={"linewidth": 0.7},
        )
    for name, _, colour in kinds:
        axis.plot([], [], color=colour, alpha=0.55, linewidth=7.0, label=name)
    axis.legend(fontsize=8)
    _tidy(axis)
    axis.set_xticks(range(len(joints)), [JOINT_NAMES[joint] for joint in joints], rotation=55, ha="right", fontsize=8)
    axis.set_ylim(bottom=0.0)
    axis.set_ylabel("mm", fontsize=9)
    figure.subplots_adjust(left=0.06, right=0.99, top=0.97, bottom=0.25)
    return _address(figure, "svg")


def _grid(count: int) -> tuple[Any, list[Any]]:
    """A figure of panels over time in two columns, and its panels."""
    rows = -(-count // 2)
    height = 1.9 * rows + 0.4
    figure = _figure(12.0, height)
    axes = list(figure.subplots(rows, 2, sharex=True, squeeze=False).flat)
    for axis in axes[count:]:
        axis.set_visible(False)
    for axis in axes[max(count - 2, 0) : count]:
        axis.set_xlabel("s", fontsize=9)
        axis.xaxis.set_tick_params(labelbottom=True)
    top, bottom = 1.0 - 0.3 / height, 0.45 / height
    figure.subplots_adjust(left=0.05, right=0.99, top=top, bottom=bottom, hspace=0.3, wspace=0.1)
    return figure, axes[:count]


def _trajectories(comparison: Comparison, joints: IntArray) -> str:
    figure, axes = _grid(len(joints))
    shown = _thin(len(comparison.times))
    times = comparison.times[shown]
    for axis, joint in zip(axes, joints, strict=True):
        for number, colour in enumerate(_AXES):
            axis.plot(times, comparison.found[shown, joint, number], color=colour, linewidth=1.2)
            axis.plot(times, comparison.true[shown, joint, number], "--", color=_TRUTH, linewidth=0.7)
        axis.set_title(JOINT_NAMES[joint], fontsize=9, pad=3)
        _tidy(axis)
    return _address(figure, "png")


def _angles(angles: AngleComparison) -> str:
    panels: dict[str, list[tuple[int, str]]] = {}
    for column, name in enumerate(angles.names):
        side = next((each for each in ("left", "right") if name.endswith(f"_{each}")), "")
        panels.setdefault(name.removesuffix(f"_{side}").replace("_", " "), []).append((column, side))
    figure, axes = _grid(len(panels))
    shown = _thin(len(angles.times))
    times = angles.times[shown]
    found, true, stddev = (np.degrees(each[shown]) for each in (angles.found, angles.true, angles.stddev))
    band = 1.96 * np.where(np.isfinite(stddev), stddev, np.nan)
    if np.isfinite(stddev).any():
        found = np.where(np.isfinite(stddev), found, np.nan)
    for axis, (title, curves) in zip(axes, panels.items(), strict=True):
        for column, side in curves:
            curve = _unbroken(found[:, column])
            low, high = curve - band[:, column], curve + band[:, column]
            axis.fill_between(times, low, high, color=_SIDES[side], alpha=0.18, linewidth=0.0)
            axis.plot(times, curve, color=_SIDES[side], linewidth=1.2)
            axis.plot(times, _unbroken(true[:, column]), "--", color=_TRUTH, linewidth=0.8)
        axis.set_title(title, fontsize=9, pad=3)
        _tidy(axis)
    return _address(figure, "png")


def _unbroken(degrees: FloatArray) -> FloatArray:
    """The curve with a gap where it passes from +180 to -180 or back."""
    curve = degrees.copy()
    curve[1:][np.abs(np.diff(degrees)) > 180.0] = np.nan
    return curve


def _coverage(result: Evaluation, joints: IntArray) -> str:
    first = result.comparisons[0]
    names = [*first.positional.names, *(JOINT_NAMES[joint] for joint in joints)]
    figure = _figure(12.0, 0.9 + 0.2 * len(names))
    axis = figure.subplots()
    places = np.arange(len(names), dtype=np.float64)
    places[len(first.positional.names) :] += 0.8
    thick = 0.8 / len(result.comparisons)
    axis.axvspan(90.0, 99.0, color="#dfeedd", zorder=0)
    axis.axvline(95.0, color=_QUIET, linewidth=1.0)
    for number, comparison in enumerate(result.comparisons):
        shares = 100.0 * np.concatenate([comparison.positional.errors.covered, comparison.joints.covered[joints]])
        where = places + (number - 0.5 * (len(result.comparisons) - 1)) * thick
        colour = _COLOURS[comparison.name == ALIGNED]
        axis.barh(where, np.nan_to_num(shares), height=0.9 * thick, color=colour, alpha=0.75, label=comparison.name)
        unstated: BoolArray = np.isnan(shares)
        axis.plot(np.full(unstated.sum(), 1.0), where[unstated], "x", color=_QUIET, markersize=4)
    axis.set_yticks(places, names, fontsize=8)
    axis.invert_yaxis()
    axis.set_xlim(0.0, 100.0)
    axis.set_xlabel("%  (x: none stated, or not to be told)", fontsize=9)
    axis.legend(fontsize=8, loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=2, frameon=False)
    axis.tick_params(labelsize=8)
    axis.margins(y=0.01)
    height = 0.9 + 0.2 * len(names)
    figure.subplots_adjust(left=0.16, right=0.98, top=1.0 - 0.3 / height, bottom=0.55 / height)
    return _address(figure, "svg")


def _calibration(result: Evaluation) -> str:
    figure = _figure(12.0, 3.0)
    axes = figure.subplots(1, 3)
    end = result.span[1]
    for number, each in enumerate(result.calibration):
        colour = f"C{number}"
        curves = (
            (each.times, np.degrees(each.poses.rotation)),
            (each.times, 1e3 * each.poses.displacement),
            (each.clock_times, 1e3 * each.clock),
        )
        for axis, (times, values) in zip(axes, curves, strict=True):
            if len(times):
                held = np.append(times, max(end, times[-1])), np.append(values, values[-1])
                axis.step(*held, where="post", color=colour, linewidth=1.3, label=each.sensor)
    for axis, title in zip(axes, ("rotation, deg", "at the person, mm", "clock, ms"), strict=True):
        axis.set_title(title, fontsize=9)
        axis.set_xlabel("s", fontsize=9)
        _tidy(axis)
    for axis in axes[:2]:
        axis.set_ylim(bottom=0.0)
    axes[2].axhline(0.0, color=_QUIET, linewidth=0.8)
    axes[0].legend(fontsize=8)
    figure.subplots_adjust(left=0.05, right=0.99, top=0.9, bottom=0.17)
    return _address(figure, "svg")

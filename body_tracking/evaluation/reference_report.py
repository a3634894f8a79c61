"""Reports of evaluations by an imperfect reference: the marker system, or another estimate."""

from __future__ import annotations

import numpy as np

from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.evaluation.mutual_comparison import MutualComparison
from body_tracking.evaluation.overview import coverage_in_words, errors_in_words
from body_tracking.evaluation.reference_comparison import ReferenceEvaluation
from body_tracking.evaluation.reference_error import Judged
from body_tracking.evaluation.report import Column, Report, Table, numbered

_NOTE = (
    "difference: RMS of estimate minus reference. reference: its own RMS deviation (poses, calibration, clock, "
    "mountings).\nerror: the difference without that, in quadrature, and its 95 % interval; - where the reference is "
    "too poor."
)
_OFFSET = "offset: mean difference, and its deviation. change: of the offset from the first half to the second."
_COVERED = "in 95%: share of differences within 1.96 of the deviation that estimate and reference state."


_COLUMNS = {"difference": "measured", "reference": "reference", "error": "error", "from": "low", "to": "high"}
_OFFSETS = {"offset": "offset", "+-": "offset_stddev"}
"""Fields of :class:`Judged` by their columns' titles; ``_OFFSETS`` only if the mountings are known."""


def _judged_table(key: str, title: str, rows: tuple[Judged, ...], known: bool, note: str) -> Table:
    shown = _COLUMNS | (_OFFSETS if known else {}) | {"change": "change"}
    columns = [
        Column(
            "difference" if name == "measured" else name,
            heading,
            "deg",
            np.degrees([getattr(row, name) for row in rows]),
        )
        for heading, name in shown.items()
    ]
    if key == "reference_angles":
        columns += [Column("covered", "in 95%", "%", 1e2 * np.array([row.covered for row in rows]))]
    return Table(key, title, tuple(row.name for row in rows), tuple(columns), note)


def tables(result: ReferenceEvaluation) -> tuple[Table, ...]:
    """All results as tables."""
    known = bool(result.mountings_known)
    made = []
    if result.angles:
        title = f"angles ({result.estimate.convention})"
        note = f"{_NOTE}\n{_OFFSET}\n{_COVERED}"
        made.append(_judged_table("reference_angles", title, result.angles, known, note))
    note = f"{_NOTE}\n{_OFFSET if not made else 'Rotations in space: lengths of rotation vectors.'}"
    made.append(_judged_table("reference_orientations", "segment orientations", result.orientations, known, note))
    residuals, count = result.fit.residuals, len(result.targets)
    columns = (
        Column("residual", "residual", "deg", np.degrees(np.sqrt(np.nanmean((residuals**2).sum(axis=-1), axis=0)))),
        Column("mounting_stddev", "mounting", "deg", np.degrees([result.fit.mounting_stddev(k) for k in range(count)])),
        Column("known", "frames", "%", 1e2 * np.isfinite(residuals[..., 0]).mean(axis=0)),
    )
    rows = tuple(f"{target} on {result.reference.segments[target]}" for target in result.targets)
    made.append(
        Table(
            "reference_targets",
            "targets",
            rows,
            columns,
            "residual: RMS of the fit to the whole recording. mounting: deviation per axis of the target on its "
            "segment.\nframes: share in which both are known.",
        )
    )
    return tuple(made)


def _in_words(name: str, rows: tuple[Judged, ...]) -> list[tuple[str, str]]:
    """Summary lines: errors of the rows with a good enough reference, and coverage of the stated deviations."""
    known = [row for row in rows if not row.too_poor]
    lines = [
        f"{len(known)} of {len(rows)} for which the reference is good enough",
        errors_in_words([row.name for row in known], np.degrees([row.error for row in known]), "deg"),
    ]
    covered = np.array([row.covered for row in rows])
    if np.isfinite(covered).any():
        samples = np.array([row.samples for row in rows], dtype=np.float64)
        lines.append(coverage_in_words("differences within 1.96 standard deviations of both", covered, samples))
    return [("" if number else name, line) for number, line in enumerate(lines)]


def mutual_report_of(result: MutualComparison) -> Report:
    """The report of an evaluation by another estimate."""
    estimate, reference = result.estimate, result.reference
    known = not np.isnan(result.clock_stddev)
    clock = f"{1e3 * result.offset_s:+.1f} +- {1e3 * result.clock_stddev:.1f} ms" if known else "as the stamps are"
    facts = (
        ("estimate", f"{estimate.source} {estimate.topic}: {len(estimate.stamps_ns)} frames"),
        ("reference", f"{reference.source} {reference.topic}: {len(reference.stamps_ns)} frames, another estimate"),
        ("compared", f"{result.seconds:.2f} s"),
        ("clock", f"the reference's minus the estimate's {clock}"),
        *_in_words("angles", result.angles),
        ("", f"RMS difference of all {np.degrees(result.measured):.1f} deg"),
        *(("note", note) for note in result.notes),
    )
    content = {
        "estimate": str(estimate.source),
        "reference": str(reference.source),
        "convention": estimate.convention,
        "compared_s": numbered(result.seconds),
        "clock": {"offset_ms": numbered(1e3 * result.offset_s), "stddev_ms": numbered(1e3 * result.clock_stddev)},
        "difference_deg": numbered(float(np.degrees(result.measured))),
        "covered": numbered(result.covered),
        "too_poor": [each.name for each in result.angles if each.too_poor],
        "notes": list(result.notes),
    }
    note = f"{_MUTUAL}\n{_OFFSET}\n{_COVERED}"
    table = _judged_table("reference_angles", f"angles ({estimate.convention})", result.angles, True, note)
    return Report(f"{estimate.source.name}: accuracy by {reference.source.name}", facts, content, (table,))


_MUTUAL = (
    "difference: RMS of estimate minus reference. reference: RMS deviation that the reference states of itself.\n"
    "error: the difference without that, in quadrature, and its 95 % interval; - where the reference is too poor."
)


def report_of(result: ReferenceEvaluation) -> Report:
    """The report of an evaluation by the marker system."""
    estimate, reference, fit = result.estimate, result.reference, result.fit
    seconds = float(estimate.stamps_ns[-1] - estimate.stamps_ns[0]) / NANOSECONDS
    drift, drift_stddev = 1e6 * fit.clock[1], 1e6 * float(np.sqrt(fit.covariance[-1, -1]))
    first, second, _ = np.degrees(fit.motion)
    rows = [
        ("estimate", f"{estimate.source} {estimate.topic}: {len(estimate.stamps_ns)} frames, {seconds:.2f} s"),
        ("reference", f"{reference.source}: targets {', '.join(result.targets)}"),
        ("compared", f"{result.seconds:.2f} s; each half by mountings that were fitted to the other"),
        (
            "clock",
            f"the reference's minus the estimate's {result.offset_s:+.4f} s, +- {1e3 * result.clock_stddev:.1f} ms "
            f"(less any constant delay of the estimate), drift {drift:+.0f} +- {drift_stddev:.0f} ppm",
        ),
        ("world", f"rig to world known to {np.degrees(fit.world_stddev):.2f} deg per axis"),
        ("motion", f"of the targets {first:.0f} deg RMS about one axis, {second:.0f} about a second"),
        *(_in_words("angles", result.angles) if result.angles else ()),
        *_in_words("segments", result.orientations),
    ]
    content = {
        "estimate": str(result.estimate.source),
        "topic": result.estimate.topic,
        "reference": str(result.reference.source),
        "convention": result.estimate.convention,
        "compared_s": numbered(result.seconds),
        "clock": {
            "offset_ms": numbered(1e3 * result.offset_s),
            "stddev_ms": numbered(1e3 * result.clock_stddev),
            "drift_ppm": numbered(drift),
            "drift_stddev_ppm": numbered(drift_stddev),
        },
        "world_stddev_deg": numbered(float(np.degrees(fit.world_stddev))),
        "too_poor": [each.name for each in (*result.angles, *result.orientations) if each.too_poor],
        "notes": list(result.notes),
    }
    facts = (*rows, *(("note", note) for note in result.notes))
    return Report(f"{estimate.source.name}: accuracy by markers", facts, content, tables(result))

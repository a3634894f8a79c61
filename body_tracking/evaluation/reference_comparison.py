"""Evaluates an estimated person by a recording of the marker system, which has its own clock, frame and targets.

The clock is initialised from the angular speeds of the segments, which need neither frame nor mounting; then mountings,
world and clock are fitted together (:mod:`body_tracking.evaluation.hand_eye`). The fit of each half of the recording
serves to compare the other half (cross-validation), so that no error is fitted away.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from body_tracking.calibration.clock_correlation import MIN_STDDEV
from body_tracking.core import so3
from body_tracking.core.body_model import SEGMENTS
from body_tracking.core.clocks import ClockModel
from body_tracking.core.orientation import SEGMENT_NUMBER
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray
from body_tracking.core.so3 import wrapped
from body_tracking.evaluation.comparison import AngleComparison
from body_tracking.evaluation.estimated_segments import EstimatedSegments, joint_chains, split_near
from body_tracking.evaluation.hand_eye import HandEye, HandEyeError, Mounting, fit_hand_eye
from body_tracking.evaluation.marker_reference import MarkerReference
from body_tracking.evaluation.metrics import angle_errors
from body_tracking.evaluation.reading import EvaluationError, nearest
from body_tracking.evaluation.reference_error import Differences, Judged, judge, notes_of
from body_tracking.evaluation.start_clock import STAMPS_AS_THEY_ARE, start_clock
from body_tracking.kinematics.conventions import Chain
from body_tracking.kinematics.upper_body import PARENTS, UpperBody

LEAST_OVERLAP: Final = 10.0
"""Least overlap of both recordings, seconds."""
_AMPLIFIED: Final = 10.0
"""Radians of angle per radian of rotation above which an angle is not compared: the pose is nearly singular."""
_WORLD: Final = "world"


@dataclass(frozen=True, slots=True, eq=False)
class ReferenceEvaluation:
    """An estimate against the marker system.

    Attributes:
        estimate: evaluated segments and angles.
        reference: recording of the marker system.
        targets: names of the compared targets, in the order of ``fit``.
        fit: mountings, world and clock from the whole recording.
        offset_s: targets' clock minus the estimate's at the middle, by the stamps of both.
        clock_stddev: s, of ``offset_s``.
        seconds: covered by both.
        mountings_known: by target, mountings known beforehand.
        orientations: of each mounted segment in its nearest mounted ancestor, or in world if it has none.
        angles: of the estimate's convention.
        curves: angles of both over time, by the mountings of the other half.
        notes: one per line.
    """

    estimate: EstimatedSegments
    reference: MarkerReference
    targets: tuple[str, ...]
    fit: HandEye
    offset_s: float
    clock_stddev: float
    seconds: float
    mountings_known: Mapping[str, Mounting]
    orientations: tuple[Judged, ...]
    angles: tuple[Judged, ...]
    curves: AngleComparison
    notes: tuple[str, ...]

    @property
    def mountings(self) -> dict[str, Mounting]:
        """The fitted mountings by target."""
        return {
            target: Mounting(
                self.fit.mountings[k], self.fit.covariance[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] + 1e-12 * np.eye(3)
            )
            for k, target in enumerate(self.targets)
        }


def evaluate_by_markers(
    estimate: EstimatedSegments,
    reference: MarkerReference,
    known_mountings: Mapping[str, Mounting] | None = None,
    *,
    one_clock: bool = False,
) -> ReferenceEvaluation:
    """Evaluate an estimate by the marker system.

    Args:
        estimate: of one person.
        reference: targets on the same person.
        known_mountings: by target, from another recording of these targets on this person.
        one_clock: use the stamps unchanged if the motion does not determine the offset of the clocks.

    Raises:
        EvaluationError: the angular speeds determine no clock, too little overlap, or a motion that determines neither
            mountings nor world.
    """
    known = dict(known_mountings or {})
    targets = tuple(reference.tracks)
    tracks = [reference.tracks[target] for target in targets]
    columns = [SEGMENT_NUMBER[reference.segments[target]] for target in targets]
    times, rotations = estimate.seconds, estimate.rotations[:, columns]
    where = f"{estimate.source} and {reference.source}"
    clock, notes = _start_clock(estimate, reference, rotations, targets, one_clock)
    begin, end = (each + clock.offset for each in (times[0], times[-1]))
    begin, end = max(begin, min(t.times[0] for t in tracks)), min(end, max(t.times[-1] for t in tracks))
    if end - begin < LEAST_OVERLAP:
        raise EvaluationError(f"{where}: {max(end - begin, 0.0):.1f} s in common, {LEAST_OVERLAP:g} s are needed")
    inside = (times + clock.offset >= begin) & (times + clock.offset <= end)
    times, rotations, stamps = times[inside], rotations[inside], estimate.stamps_ns[inside]
    middle = float(times.mean())
    start = np.array([clock.offset_ns_at(round(middle * NANOSECONDS)) / NANOSECONDS, 1e-6 * clock.drift_ppm])
    halves = times < middle, times >= middle
    try:
        fit = fit_hand_eye(times, rotations, tracks, targets, start, middle=middle, known_mountings=known)
        parts = [
            fit_hand_eye(
                *(times[half], rotations[half], tracks, targets, fit.clock),
                fit_clock=False,
                middle=middle,
                known_mountings=known,
            )
            for half in halves
        ]
    except HandEyeError as error:
        raise EvaluationError(f"{where}: {error}") from error
    compared = [
        _Compared(times[half], rotations[half], stamps[half], reference, targets, parts[1 - number], fit)
        for number, half in enumerate(halves)
    ]
    orientations = [
        judge(
            f"{child} in {parent or _WORLD}",
            [each.orientation(parent, child) for each in compared],
            mountings_known=bool(known),
        )
        for child, parent in _pairs(reference.segments.values())
    ]
    angles, curves = _angles(estimate, reference, compared, bool(known))
    if not known:
        notes.append(
            "constant offsets of the estimate do not show: mountings are fitted to it and absorb them. They show with "
            "--mountings from another recording"
        )
    notes += notes_of(orientations + angles)
    return ReferenceEvaluation(
        estimate,
        reference,
        targets,
        fit,
        float(fit.clock[0]) + (reference.first_ns - int(estimate.stamps_ns[0])) / NANOSECONDS,
        float(np.hypot(np.sqrt(fit.covariance[-2, -2]), MIN_STDDEV)),
        float(end - begin),
        known,
        tuple(each for each in orientations if each is not None),
        tuple(each for each in angles if each is not None),
        curves,
        (*estimate.warnings, *reference.warnings, *notes),
    )


# --- the clock


def _start_clock(
    estimate: EstimatedSegments,
    reference: MarkerReference,
    rotations: FloatArray,
    targets: Sequence[str],
    one_clock: bool,
) -> tuple[ClockModel, list[str]]:
    """The targets' clock relative to the estimate's, each from its first stamp, from angular speeds; and notes."""
    own = {target: estimate.track(rotations[:, number]) for number, target in enumerate(targets)}
    apart = (int(estimate.stamps_ns[0]) - reference.first_ns) / NANOSECONDS
    length, other = float(estimate.seconds[-1]), max(float(track.times[-1]) for track in reference.tracks.values())
    sources = f"{estimate.source} ({length:.1f} s) and {reference.source} ({other:.1f} s)"
    try:
        return start_clock(own, reference.tracks, apart, sources, reference.segments)
    except EvaluationError:
        if not one_clock:
            raise
        return ClockModel(round(apart * NANOSECONDS)), [STAMPS_AS_THEY_ARE]


# --- differences


def _pairs(mounted: Iterable[str]) -> list[tuple[str, str | None]]:
    """Each mounted segment with its nearest mounted ancestor; None for world."""
    there = set(mounted)
    pairs: list[tuple[str, str | None]] = []
    for child in (segment for segment in SEGMENTS if segment in there):
        parent = PARENTS[SEGMENTS.index(child)]
        while parent >= 0 and SEGMENTS[parent] not in there:
            parent = PARENTS[parent]
        pairs.append((child, SEGMENTS[parent] if parent >= 0 else None))
    return pairs


class _Compared:
    """One half of the recording with the mountings fitted to the other."""

    def __init__(
        self,
        times: FloatArray,
        rotations: FloatArray,
        stamps_ns: IntArray,
        reference: MarkerReference,
        targets: Sequence[str],
        fit: HandEye,
        whole: HandEye,
    ) -> None:
        self.times, self.stamps_ns, self.fit = times, stamps_ns, fit
        self.step = float(np.median(np.diff(times)))
        self.number = {reference.segments[target]: k for k, target in enumerate(targets)}
        self.estimated = rotations
        at = whole.to_reference(times)
        sampled = [reference.tracks[target].at(at) for target in targets]
        self.targets, noise, known = (np.stack(each, axis=1) for each in zip(*sampled, strict=True))
        rates = np.stack([reference.tracks[target].rates(at) for target in targets], axis=1)
        self.known: BoolArray = known & np.isfinite(rotations).all(axis=(-1, -2)) & np.isfinite(rates).all(axis=-1)
        self.segments = fit.world @ self.targets @ fit.mountings.swapaxes(-1, -2)
        self.rates = (fit.mountings @ np.nan_to_num(rates)[..., None])[..., 0]
        to_segment = fit.mountings @ self.targets.swapaxes(-1, -2)
        self.noise = to_segment @ noise @ to_segment.swapaxes(-1, -2)
        stated = reference.angle_stddev
        self.stated = 0.0 if np.isnan(stated) else stated**2
        from_middle = times - whole.middle
        basis = np.stack([np.ones_like(times), from_middle], axis=1)
        self.clock = np.einsum("ni,ij,nj->n", basis, whole.covariance[-2:, -2:], basis) + MIN_STDDEV**2

    def relative(self, parent: str | None, child: str) -> tuple[FloatArray, FloatArray, BoolArray]:
        """(n, 3, 3) child in parent by the reference and by the estimate, and (n,) whether both are known."""
        c = self.number[child]
        if parent is None:
            return self.segments[:, c], self.estimated[:, c], self.known[:, c]
        p = self.number[parent]
        true = self.segments[:, p].swapaxes(-1, -2) @ self.segments[:, c]
        found = self.estimated[:, p].swapaxes(-1, -2) @ self.estimated[:, c]
        return true, found, self.known[:, c] & self.known[:, p]

    def uncertainty(self, parent: str | None, child: str) -> tuple[FloatArray, FloatArray]:
        """(n, 3, 3) covariances in the child's frame, square radians: by noise and clock, and by the mountings."""
        c, size = self.number[child], len(self.fit.covariance)
        back = self.relative(parent, child)[0].swapaxes(-1, -2)
        derivative = np.zeros((len(self.times), 3, size))
        derivative[..., 3 * c : 3 * c + 3] = np.eye(3)
        noise, rates = self.noise[:, c], self.rates[:, c]
        if parent is None:
            derivative[..., -5:-2] = -back
        else:
            p = self.number[parent]
            derivative[..., 3 * p : 3 * p + 3] = -back
            noise = noise + back @ self.noise[:, p] @ back.swapaxes(-1, -2)
            rates = rates - (back @ self.rates[:, p, :, None])[..., 0]
        # the stated deviation of the marker system's angles includes the calibration of the cameras
        more = np.maximum(self.stated - np.trace(noise, axis1=-2, axis2=-1) / 3.0, 0.0)
        own = noise + more[:, None, None] * np.eye(3)
        own = own + self.clock[:, None, None] * rates[..., :, None] * rates[..., None, :]
        return own, derivative @ self.fit.covariance @ derivative.swapaxes(-1, -2)

    def orientation(self, parent: str | None, child: str) -> Differences:
        """Differences of an orientation, in the child's frame."""
        true, found, known = self.relative(parent, child)
        own, mounting = self.uncertainty(parent, child)
        errors = so3.rotation_vectors(true.swapaxes(-1, -2) @ found)
        return Differences(self.step, errors[known], np.trace(own, axis1=-2, axis2=-1)[known], mounting[known])

    def angle(
        self, chain: Chain, near: FloatArray, column: int, stated: FloatArray
    ) -> tuple[Differences, FloatArray, BoolArray]:
        """Differences of an angle, the reference's angle (n,), and (n,) mask of the compared instants.

        Args:
            chain: of the angle.
            near: (n, 3) radians of the estimate, NaN where unknown.
            column: index of the angle in the chain.
            stated: (n,) the estimate's standard deviation, radians.
        """
        true, _, known = self.relative(chain.parent, chain.child)
        known = known & np.isfinite(near).all(axis=1)
        angles, gradients = split_near(chain, true, np.nan_to_num(near))
        gradient = gradients[:, column]
        known = known & (np.linalg.norm(gradient, axis=1) < _AMPLIFIED)
        in_child = (gradient[:, None, :] @ true)[:, 0]
        own, mounting = (
            np.einsum("ni,nij,nj->n", in_child, each, in_child) for each in self.uncertainty(chain.parent, chain.child)
        )
        errors = wrapped(near[:, column] - angles[:, column])
        differences = Differences(
            self.step, errors[known, None], own[known], mounting[known, None, None], stated[known]
        )
        return differences, np.where(known, near[:, column] - errors, np.nan), known


def _angles(
    estimate: EstimatedSegments, reference: MarkerReference, compared: Sequence[_Compared], known: bool
) -> tuple[list[Judged | None], AngleComparison]:
    """All angles that the mounted targets determine, and their curves."""
    series = estimate.angles
    chains = joint_chains(estimate.convention, frozenset(reference.segments.values()), UpperBody())
    rows = [nearest(series.stamps_ns, each.stamps_ns, 0) for each in compared]
    judged: list[Judged | None] = []
    names, found, true, stddev = [], [], [], []
    for chain in chains:
        columns = [series.names.index(name) if name in series.names else None for name in chain.names]
        near = [
            np.stack(
                [
                    np.zeros(len(row)) if column is None else np.where(row >= 0, series.position[row, column], np.nan)
                    for column in columns
                ],
                axis=1,
            )
            for row in rows
        ]
        for place, column in enumerate(columns):
            if column is None:
                continue
            stated = [np.where(row >= 0, series.stddev[row, column], np.inf) for row in rows]
            results = [
                each.angle(chain, close, place, claim)
                for each, close, claim in zip(compared, near, stated, strict=True)
            ]
            judged.append(judge(series.names[column], [result[0] for result in results], mountings_known=known))
            names.append(series.names[column])
            found.append(np.concatenate([close[:, place] for close in near]))
            true.append(np.concatenate([result[1] for result in results]))
            stddev.append(np.concatenate(stated))
    times = np.concatenate([each.times for each in compared])
    shape = (len(times), len(names))
    a, b, c = (np.stack(each, axis=1) if each else np.empty(shape) for each in (found, true, stddev))
    return judged, AngleComparison(tuple(names), times, a, b, c, angle_errors(a, b, c))

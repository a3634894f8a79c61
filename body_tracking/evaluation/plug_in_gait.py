"""Joint centres from C3D files with Vicon's Plug-in Gait markers, as ground truth.

Source: Vicon, "Plug-in Gait Reference Guide" (marker placement, joint centres by the chord function);
Davis, Ounpuu, Tyburski and Gage, Human Movement Science 10 (1991), for the hip. Gaps shorter than 0.2 s are filled by
splines, and the trajectories are smoothed by splines with generalised cross-validation (Woltring 1986), as in
Schlagenhauf (2017, section 5.6.3).

Joint centres. With the same markers and measurements, unsmoothed, shoulder, elbow, wrist, hand and hip agree with
Vicon's within a micrometre. With ``r`` the marker's radius and :func:`chord` the chord function:

- thorax: z from the midpoint of T10 and STRN to that of C7 and CLAV; x from the midpoint of C7 and T10 to that of CLAV
  and STRN, perpendicular to z; y to the left; origin ``r`` behind CLAV.
- shoulder: chord from the thorax's origin and SHO, downwards perpendicular to x, by shoulder offset + r.
- elbow: chord from the shoulder and ELB, medially along the normal of the plane of shoulder, ELB and the midpoint of
  WRA and WRB, by half the elbow's width + r.
- wrist: from the midpoint of WRA and WRB, perpendicular to the wrist bar and to the line to the elbow, towards the
  palm, by half the wrist's width + r.
- hand: chord from the wrist and FIN, towards the palm in the plane of wrist, FIN and the midpoint of WRA and WRB, by
  half the hand's thickness + r.
- hips: regression on leg length and pelvis (Davis 1991); without a leg length that of Harrington et al., J. Biomech. 40
  (2007), on the pelvis alone.

Assignment to the Kinect's joints: Shoulder, Elbow, Wrist, Hand and Hip are these centres; SpineBase is the midpoint of
the hips. Approximations, because Plug-in Gait has no such points: SpineShoulder is the midpoint of C7 and CLAV,
SpineMid that of T10 and STRN, Head the mean of the four head markers. Neck, thumbs, hand tips and legs stay unknown.

Other approximations. Unknown measurements are estimated: the shoulder lies 12 % of the distance between the acromia
from its marker and the elbow 40 mm from its own (both as in ``benchmarks/kinect_vs_vicon.py``); the wrist is 40 mm wide
and the hand 30 mm thick, Vicon's values before they are measured, as is a shoulder offset of 50 mm if one acromion is
not seen. The splines are cubic, Vicon's quintic.

Limits of validity. The elbow is offset from ELB perpendicular to the plane of shoulder, ELB and wrist, which is the
flexion axis only while the elbow is bent. For a straight arm in a T-pose, palm down and the markers well placed,
Plug-in Gait gives a flexion of 27 degrees and an elbow that is off by 64 mm; for a true flexion of 30 degrees 37 (16
mm), of 60 degrees 63 (7 mm), of 90 degrees 91 (3 mm). This is true of Vicon's output, too.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np

from body_tracking.core.c3d import MarkerError, Trial, listed, read_trial
from body_tracking.core.files import open_regular
from body_tracking.core.skeleton import N_JOINTS, FloatArray, Joint
from body_tracking.evaluation.smoothing import LONGEST_GAP, fill_gaps, runs, smooth

THORAX_MARKERS = ("C7", "T10", "CLAV", "STRN")
ARM_MARKERS = ("SHO", "ELB", "WRA", "WRB")
"""Names without the prefix L or R."""
MARKERS: tuple[str, ...] = (
    *("LFHD", "RFHD", "LBHD", "RBHD"),
    *THORAX_MARKERS,
    *(side + name for side in "LR" for name in (*ARM_MARKERS, "FIN")),
    *("LASI", "RASI", "LPSI", "RPSI"),
)
"""The markers used; SACR replaces LPSI and RPSI. Schlagenhauf 2017, figures 5.4-5.6, table C.1."""

ACROMION_TO_SHOULDER = 0.12
"""Distance of the shoulder centre from the acromion marker, as a share of the distance between the acromia."""
HALF_ELBOW = 0.040
"""Distance of the elbow centre from the middle of its marker, m."""
SHOULDER_OFFSET, WRIST_WIDTH, HAND_THICKNESS = 0.050, 0.040, 0.030
"""Vicon's values before measurement, m."""
MARKER_DIAMETER = 0.014
"""Vicon's default, m."""

_SIDE = np.array([1.0, -1.0])
"""Left and right."""
_SHOULDERS = (Joint.SHOULDER_LEFT, Joint.SHOULDER_RIGHT)
_ELBOWS = (Joint.ELBOW_LEFT, Joint.ELBOW_RIGHT)
_WRISTS = (Joint.WRIST_LEFT, Joint.WRIST_RIGHT)
_HANDS = (Joint.HAND_LEFT, Joint.HAND_RIGHT)
_HIPS = (Joint.HIP_LEFT, Joint.HIP_RIGHT)


@dataclass(frozen=True, slots=True, eq=False)
class Measurements:
    """Measurements of a subject, metres, NaN where unknown. Arrays are (2,): left, right.

    Attributes:
        shoulder_offset: from the acromion (without its marker) to the shoulder's centre.
        elbow_width: between the epicondyles.
        wrist_width: thickness of the wrist under the bar.
        hand_thickness: at the knuckles.
        leg_length: spine of the ilium to the medial malleolus.
        asis_distance: between the anterior superior spines of the ilium.
        marker_diameter: of all markers.
    """

    shoulder_offset: FloatArray
    elbow_width: FloatArray
    wrist_width: FloatArray
    hand_thickness: FloatArray
    leg_length: FloatArray
    asis_distance: float
    marker_diameter: float = MARKER_DIAMETER

    @classmethod
    def from_parameters(cls, values: Mapping[str, float]) -> Measurements:
        """From Vicon's names (``LShoulderOffset`` or ``LeftShoulderOffset`` ...), in millimetres; 0 means unknown."""

        def value(*names: str) -> float:
            return next((1e-3 * values[name] for name in names if values.get(name, 0.0) > 0.0), np.nan)

        def both(name: str) -> FloatArray:
            return np.array([value(short + name, long + name) for short, long in (("L", "Left"), ("R", "Right"))])

        diameter = value("MarkerDiameter")
        return cls(
            both("ShoulderOffset"),
            both("ElbowWidth"),
            both("WristWidth"),
            both("HandThickness"),
            both("LegLength"),
            value("InterAsisDistance"),
            diameter if diameter > 0.0 else MARKER_DIAMETER,
        )

    def completed(self, markers: Mapping[str, FloatArray]) -> tuple[Measurements, tuple[str, ...]]:
        """The measurements with estimates (module docstring) of unknown ones, and the names of the estimated ones.

        Leg lengths are not estimated.

        Args:
            markers: (n, 3) metres each; all of :data:`MARKERS`, NaN where unknown.
        """

        def median_distance(a: str, b: str) -> float:
            distance = np.linalg.norm(markers[a] - markers[b], axis=1)
            distance = distance[np.isfinite(distance)]
            return float(np.median(distance)) if distance.size else np.nan

        radius = 0.5 * self.marker_diameter
        offset = ACROMION_TO_SHOULDER * median_distance("LSHO", "RSHO") - radius
        estimates = {
            "shoulder_offset": offset if offset > 0.0 else SHOULDER_OFFSET,
            "elbow_width": 2.0 * (HALF_ELBOW - radius),
            "wrist_width": WRIST_WIDTH,
            "hand_thickness": HAND_THICKNESS,
            "asis_distance": median_distance("LASI", "RASI"),
        }
        used: dict[str, Any] = {
            name: np.where(np.isnan(getattr(self, name)), estimate, getattr(self, name))
            for name, estimate in estimates.items()
        }
        estimated = tuple(name for name in used if not np.array_equal(used[name], getattr(self, name), equal_nan=True))
        width = float(used.pop("asis_distance"))
        return replace(self, **used, asis_distance=width), estimated


@dataclass(frozen=True, slots=True)
class Gap:
    """A gap of a marker that is too long to be filled; ends are stamps of the first and last unseen frame, s."""

    marker: str
    first: float
    last: float

    def __str__(self) -> str:
        return f"{self.marker} from {self.first:.2f} s to {self.last:.2f} s"


@dataclass(frozen=True, slots=True, eq=False)
class MarkerTruth:
    """Joint centres of one subject from markers.

    Attributes:
        stamps: (n,) s since the start of the trial; the file may contain a part of it.
        positions: (n, 25, 3) metres, z up, in the axes of the marker system; NaN where unknown.
        missing: names of :data:`MARKERS` that the file does not contain or that are never seen.
        gaps: gaps that were not filled.
        measurements: used for the centres.
        estimated: names of the estimated measurements.
    """

    stamps: FloatArray
    positions: FloatArray
    missing: tuple[str, ...]
    gaps: tuple[Gap, ...]
    measurements: Measurements
    estimated: tuple[str, ...]


def read_plug_in_gait(
    path: Path | str,
    *,
    subject: str | None = None,
    measurements: Measurements | None = None,
    smoothing: bool = True,
) -> MarkerTruth:
    """Joint centres from a C3D file.

    Args:
        path: of the file.
        subject: prefix of the markers' names (``subject:LSHO``); needed if the file contains several subjects.
        measurements: replace those in the file, e.g. from :func:`read_measurements`.
        smoothing: whether to smooth the trajectories; gaps are always filled.

    Raises:
        MarkerError: not a C3D file, a truncated one, no markers of the thorax and of an arm, several subjects and none
            chosen, nothing but gaps, or ezc3d is not installed.
    """
    path = Path(path)
    trial = read_trial(path, subject, MARKERS)
    points = trial.points
    if "SACR" in points:
        points = {"LPSI": points["SACR"], "RPSI": points["SACR"]} | points
    missing = tuple(name for name in MARKERS if name not in points or np.isnan(points[name]).all())
    _require(path, trial, missing)
    unseen = np.full((trial.frames, 3), np.nan)
    markers = {name: fill_gaps(points.get(name, unseen), trial.rate) for name in MARKERS}
    gaps = tuple(
        Gap(name, float(trial.stamps[first]), float(trial.stamps[end - 1]))
        for name in MARKERS
        if name not in missing
        for first, end in runs(np.isnan(markers[name][:, 0]))
    )
    if smoothing:
        markers = {name: smooth(each) for name, each in markers.items()}
    used, estimated = (measurements or Measurements.from_parameters(trial.processing)).completed(markers)
    positions = joint_centres(markers, used)
    if not np.isfinite(positions[:, _WRISTS]).any():
        raise MarkerError(
            f"{path}: no arm can be placed in any of {trial.frames} frames"
            + (f"; markers not seen for {LONGEST_GAP} s or longer: {'; '.join(map(str, gaps))}" if gaps else "")
        )
    return MarkerTruth(trial.stamps, positions, missing, gaps, used, estimated)


def read_measurements(path: Path | str) -> Measurements:
    """Read the subject file (.vsk) that Vicon stores beside its recordings.

    Raises:
        MarkerError: no such file, not XML, or no measurements in it.
    """
    try:
        with open_regular(Path(path)) as stream:
            root = ElementTree.parse(stream).getroot()
    except OSError as error:
        raise MarkerError(f"{path}: {error.strerror or error}") from error
    except ElementTree.ParseError as error:
        raise MarkerError(f"{path}: not a subject file of Vicon's (.vsk): {error}") from error
    values = {}
    for each in root.iter("StaticParameter"):
        try:
            values[each.get("NAME", "")] = float(each.get("VALUE", ""))
        except ValueError:
            continue  # a parameter with a formula in place of a value
    found = Measurements.from_parameters(values)
    if all(np.isnan(getattr(found, each.name)).all() for each in fields(found) if each.name != "marker_diameter"):
        raise MarkerError(f"{path}: no measurements among its {len(values)} parameters (LeftElbowWidth, ...)")
    return found


def chord(distance: FloatArray | float, joint: FloatArray, marker: FloatArray, towards: FloatArray) -> FloatArray:
    """Plug-in Gait's chord function: the joint centre next to a marker.

    The centre lies ``distance`` from the marker, the angle there between the other joint and the marker is a right
    angle, and the centre is in the plane of ``joint``, ``marker`` and ``towards``, on the side of ``towards``.

    Args:
        distance: (...) m, marker to centre.
        joint: (..., 3) centre of the joint at the other end of the segment.
        marker: (..., 3).
        towards: (..., 3) point that selects the side.

    Returns:
        (..., 3) centre; NaN where the joint is nearer to the marker than ``distance``.
    """
    span = joint - marker
    length = np.linalg.norm(span, axis=-1, keepdims=True)
    along = span / length
    across = _rejected(towards - marker, along)
    with np.errstate(invalid="ignore"):
        sine = np.asarray(distance)[..., None] / length
        centre: FloatArray = marker + sine * length * (sine * along + np.sqrt(1.0 - sine**2) * across)
    return centre


def joint_centres(markers: Mapping[str, FloatArray], measurements: Measurements) -> FloatArray:
    """Joint centres by the module's docstring; the truth of Jatesiktat et al. (2018), section IV-A.

    Args:
        markers: (n, 3) metres each; all of :data:`MARKERS`, NaN where unknown.
        measurements: NaN where unknown; joints that depend on them are then unknown, except the hips.

    Returns:
        (n, 25, 3) metres, NaN where unknown.
    """
    positions = np.full((len(markers["CLAV"]), N_JOINTS, 3), np.nan)
    radius = 0.5 * measurements.marker_diameter

    def both(name: str) -> FloatArray:
        return np.stack([markers["L" + name], markers["R" + name]], axis=1)

    side = _SIDE[:, None]
    up, down = markers["C7"] + markers["CLAV"], markers["T10"] + markers["STRN"]
    z = _unit(up - down)
    x = _rejected(markers["CLAV"] + markers["STRN"] - markers["C7"] - markers["T10"], z)
    origin = (markers["CLAV"] - radius * x)[:, None]

    acromion, lateral = both("SHO"), both("ELB")
    shoulder = chord(
        measurements.shoulder_offset + radius,
        origin,
        acromion,
        acromion + side * np.cross(acromion - origin, x[:, None]),
    )
    bar = both("WRB") - both("WRA")
    dorsal = 0.5 * (both("WRA") + both("WRB"))
    elbow = chord(
        0.5 * measurements.elbow_width + radius,
        shoulder,
        lateral,
        lateral - side * np.cross(shoulder - lateral, dorsal - lateral),
    )
    palm = side * _unit(np.cross(bar, dorsal - elbow))
    wrist = dorsal + (0.5 * measurements.wrist_width + radius)[:, None] * palm
    finger = both("FIN")
    hand = chord(0.5 * measurements.hand_thickness + radius, wrist, finger, 2.0 * finger - dorsal)
    hips = _hips(both("ASI"), both("PSI"), measurements)

    for joints, centres in ((_SHOULDERS, shoulder), (_ELBOWS, elbow), (_WRISTS, wrist), (_HANDS, hand), (_HIPS, hips)):
        positions[:, joints] = centres
    positions[:, Joint.SPINE_BASE] = hips.mean(axis=1)
    positions[:, Joint.SPINE_SHOULDER] = 0.5 * up
    positions[:, Joint.SPINE_MID] = 0.5 * down
    positions[:, Joint.HEAD] = 0.5 * (both("FHD") + both("BHD")).mean(axis=1)
    return positions


def _hips(anterior: FloatArray, posterior: FloatArray, measurements: Measurements) -> FloatArray:
    """(n, 2, 3) hip centres in m from the (n, 2, 3) markers of the iliac spines."""
    y = _unit(anterior[:, 0] - anterior[:, 1])
    middle = anterior.mean(axis=1)
    x = _rejected(middle - posterior.mean(axis=1), y)
    axes = np.stack([x, y, np.cross(x, y)], axis=-1)
    width, leg = measurements.asis_distance, measurements.leg_length
    if np.isfinite(leg).all():
        # Davis 1991, in metres, angles in radians
        c = 0.115 * leg.mean() - 0.0153
        theta, beta = 0.5, 0.314
        behind = 0.1288 * leg - 0.04856 + 0.5 * measurements.marker_diameter
        forward = c * math.cos(theta) * math.sin(beta) - behind * math.cos(beta)
        upward = -c * math.cos(theta) * math.cos(beta) - behind * math.sin(beta)
        outward = np.full(2, 0.5 * width - c * math.sin(theta))
        place = np.broadcast_to(np.stack([forward, _SIDE * outward, upward], axis=-1), (len(x), 2, 3))
    else:
        # Harrington 2007
        depth = np.linalg.norm(middle - posterior.mean(axis=1), axis=-1)[:, None] + 0.0 * _SIDE
        forward = -0.24 * depth - 0.0099
        upward = np.full_like(depth, -0.30 * width - 0.0109)
        outward = np.full_like(depth, 0.33 * width + 0.0073)
        place = np.stack([forward, _SIDE * outward, upward], axis=-1)
    hips: FloatArray = middle[:, None] + np.einsum("nij,nsj->nsi", axes, place)
    return hips


def _require(path: Path, trial: Trial, missing: tuple[str, ...]) -> None:
    lacking = [name for name in THORAX_MARKERS if name in missing]
    arms = [[side + name for name in ARM_MARKERS if side + name in missing] for side in "LR"]
    if all(arms):
        lacking += [*arms[0], *arms[1]]
    if not lacking:
        return
    never = [name for name in lacking if name in trial.points]
    found = [name for name in MARKERS if name not in missing]
    others = [name for name in trial.points if name not in MARKERS and not name.startswith("*")]
    text = f"{path}: without the markers {listed(lacking)}"
    if never:
        text += f" ({listed(never)}: named but never seen)"
    raise MarkerError(
        f"{text}; needed are {listed(THORAX_MARKERS)} and of one side {listed(ARM_MARKERS)}; found "
        f"{listed(found)} of Plug-in Gait's and {len(others)} other points ({listed(others, 10)})"
    )


def _unit(vectors: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        unit: FloatArray = vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
    return unit


def _rejected(vectors: FloatArray, axis: FloatArray) -> FloatArray:
    """Unit vectors of the components perpendicular to a unit axis."""
    return _unit(vectors - (vectors * axis).sum(axis=-1, keepdims=True) * axis)

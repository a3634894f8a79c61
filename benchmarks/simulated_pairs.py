"""Real pairs of Kinect v2 sensors beside simulated ones: the same statistics of both.

The nine recordings of ``kinect_pairs`` show three people in front of two sensors in three layouts; they stand still,
step to and fro, and walk about. For each recording a simulated person (the same three in all layouts) moves similarly
for as long, in front of sensors at the real poses, by the recording's own calibration: ``standing_still``, then twice
``walking_and_turning``. The real people face kinect1 all the time, also when they step sideways or back (nine tenths of
the frames are within 15 degrees of it while they step, within 55 while they walk). So the simulated ones are turned
towards it as they walk: people in ``scene.simulate`` turn to where they walk, which would compare other views rather
than other errors. The real recordings have no tracking states, so those of the simulated ones are removed: all joints
with a position count as Tracked. Both are calibrated by the package's robust method, without any filter. Figures are
medians over the three recordings of a layout, with their range.

disagreement   distance of a joint between the two sensors after calibration; mean and median over joints and frames
... facing     the same in frames in which kinect1, the front sensor, sees the body within 30 degrees of its front and
               no sensor has it turned round: it depends less on how much people turn. The 95th percentile is the tail
length         standard deviation of the distance between two joints; left and right averaged. The trunk's is from
               SpineBase to SpineShoulder
turned round   share of the frames in which the two sensors agree better (shoulders, elbows, hips, knees) when left and
               right are exchanged in one of them: in the one whose left-right axis is opposite to that of the nearest
               frame in which they agree. If both have the body turned round, it is not detected
gaps           share of a sensor's frames that come more than 50 ms after the previous one
white noise    standard deviation per axis, from third differences over four consecutive frames: their standard
               deviation is sqrt(20) times larger, and their median length, which is robust to outliers, is 1.538 times
               that. For people who stand still, and for people who move; the latter includes their jerk
turn           angle between the views of the two sensors, about the vertical through the person: by the shoulders in
               each sensor's skeleton, while kinect1 sees the body within 20 degrees of its front; and by the
               calibration
slow errors    correlation of the disagreement (less its median, at most 100 mm per axis, nobody turned round) with
               itself one second later, while people move
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import common
import numpy as np
from calibrate_simulator import PAGE, PAIRS
from real_pairs import NOMINAL, PEOPLE, paired
from scipy.spatial.transform import Rotation

from body_tracking.calibration.online import CalibrationParameters, OnlineCalibration
from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import body_heading, left_right_axes, viewing_angle
from body_tracking.core.sensor_poses import CalibrationResult
from body_tracking.core.skeleton import MIRROR, NANOSECONDS, BoolArray, FloatArray, Joint, Skeleton, TrackingState
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect.csv_recording import CsvRecording
from body_tracking.kinect.simulated_sensor import Misreading, SimulatedKinect
from body_tracking.recording.calibrate import HISTORY_S
from body_tracking.simulation.layouts import Layout, around
from body_tracking.simulation.people import Person, joints
from body_tracking.simulation.repertoire import make_movement
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, draw_clock

SENSORS = ("kinect1", "kinect2")
PLACES = ("front", "other")
"""Places of the sensors: people face the first sensor most of the time."""
MOTIONS = (
    ("standing_still", None),
    ("walking_and_turning", np.radians(12.0)),
    ("walking_and_turning", np.radians(55.0)),
)
"""Motions of simulated people in the three parts of a recording, and their largest turn from the first sensor, rad."""
STANDING, STEPS = 0, 1
"""Parts of a recording, indices of ``MOTIONS``."""
PAUSE = 2.0
"""Seconds without frames between two parts of a recording."""
DIFFERENT = 0.5
"""Difference between simulated and real figure, as a share of the real one, above which a row is marked."""

FACING, FRONT = np.radians(30.0), np.radians(20.0)
GAP = 0.05
PERIOD, JITTER = 1.0 / 30.0, 0.006
LAG, LAG_TOLERANCE, CLIP = 1.0, 0.02, 0.1
"""Lag of the slow errors and its tolerance, seconds; largest disagreement per axis, metres."""
THIRD_DIFFERENCE = np.sqrt(20.0) * 1.538
"""Ratio of the median length of a vector's third differences to the standard deviation per axis."""


def _joints(*names: str) -> list[Joint]:
    return [joint for joint in Joint if joint.name.removesuffix("_LEFT").removesuffix("_RIGHT") in names]


TRUNK = _joints("SPINE_BASE", "SPINE_MID", "SPINE_SHOULDER", "NECK")
ARMS = _joints("ELBOW", "WRIST")
LEGS = _joints("KNEE", "ANKLE")
SIDED = _joints("SHOULDER", "ELBOW", "HIP", "KNEE")
GROUPS = {"trunk": TRUNK, "arms": ARMS, "legs": LEGS}
NOISY = {"trunk": TRUNK, "wrist": _joints("WRIST"), "hand tip": _joints("HAND_TIP")}
LIMBS = {
    "upper arm": (_joints("SHOULDER"), _joints("ELBOW")),
    "forearm": (_joints("ELBOW"), _joints("WRIST")),
    "thigh": (_joints("HIP"), _joints("KNEE")),
    "shank": (_joints("KNEE"), _joints("ANKLE")),
    "trunk": ([Joint.SPINE_BASE], [Joint.SPINE_SHOULDER]),
}


@dataclass(frozen=True)
class Quantity:
    """A statistic.

    Attributes:
        name: in the table.
        unit: of the figures.
        digits: after the point.
        least: largest difference that is never marked.
    """

    name: str
    unit: str
    digits: int
    least: float


@dataclass(frozen=True)
class Row:
    """A statistic of a layout's recordings.

    Attributes:
        layout: parallel, 45deg or 90deg.
        quantity: the statistic.
        real, simulated: a figure per recording.
    """

    layout: str
    quantity: Quantity
    real: tuple[float, ...]
    simulated: tuple[float, ...]

    @property
    def medians(self) -> tuple[float, float]:
        """Medians over the recordings, real and simulated."""
        return float(np.median(self.real)), float(np.median(self.simulated))

    @property
    def differs(self) -> bool:
        """Whether the simulated figure differs by more than a half of the real one."""
        real, simulated = self.medians
        return abs(simulated - real) > max(DIFFERENT * abs(real), self.quantity.least)

    def cells(self) -> tuple[str, str, str]:
        """Real and simulated medians with ranges, and the mark."""
        digits = self.quantity.digits
        real, simulated = (
            f"{np.median(values):.{digits}f} ({min(values):.{digits}f}-{max(values):.{digits}f})"
            for values in (self.real, self.simulated)
        )
        return real, simulated, "differs" if self.differs else ""


@dataclass(frozen=True, slots=True, eq=False)
class Pair:
    """A calibrated recording of two sensors.

    Attributes:
        frames: of each sensor, in the order of their stamps.
        result: of the calibration.
    """

    frames: tuple[tuple[Skeleton, ...], tuple[Skeleton, ...]]
    result: CalibrationResult


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Skeletons of one sensor.

    Attributes:
        times: (n,) seconds of its clock.
        positions: (n, 25, 3) metres in its optical frame; NaN where unknown.
        part: (n,) part of the recording.
    """

    times: FloatArray
    positions: FloatArray
    part: np.ndarray

    @classmethod
    def of(cls, frames: Sequence[Skeleton]) -> View:
        times = np.array([each.stamp_ns for each in frames]) / NANOSECONDS
        return cls(times, np.stack([each.positions for each in frames]), parts(times))


def parts(times: FloatArray) -> np.ndarray:
    """(n,) part of a recording at each of (n,) seconds: the number of pauses before."""
    return np.cumsum(np.diff(times, prepend=times[0]) > PAUSE)


# --- recordings


def calibrated(frames: Sequence[tuple[str, int, Skeleton]]) -> Pair:
    """Frames by sensor, and the calibration from all frames (sensor, receipt in ns, skeleton) in order of receipt."""
    calibration = OnlineCalibration(SENSORS, replace(CalibrationParameters(), history=HISTORY_S))
    for sensor, received_ns, skeleton in frames:
        calibration.push(sensor, skeleton, received_ns)
    first, second = (
        tuple(sorted((each for name, _, each in frames if name == sensor), key=lambda each: each.stamp_ns))
        for sensor in SENSORS
    )
    return Pair((first, second), calibration.finish())


def real_pair(file: Path) -> Pair:
    """A recording of ``kinect_pairs``."""
    return calibrated([(frame.sensor, frame.received_ns, frame.skeletons[0]) for frame in CsvRecording(file)])


def simulated_pair(pair: Pair, seed: int) -> Pair:
    """Simulated sensors at the same poses, with a person who moves similarly."""
    rng = np.random.default_rng(seed)
    person, misreading = Person.draw(rng), Misreading.draw(rng)
    place, view = stand(pair), View.of(pair.frames[0])
    clocks = ClockModel(anchor_ns=START_NS), draw_clock(rng)
    phases = rng.uniform(0.0, PERIOD, len(SENSORS)).tolist()
    sensors = [SimulatedKinect(*each) for each in zip(place.poses, clocks, phases, strict=True)]
    frames: list[RecordedFrame] = []
    for part, (motion, turn) in enumerate(MOTIONS):
        during = view.times[view.part == part]
        movement = make_movement(motion, person, rng, float(during[-1] - during[0]))
        elapsed_ns = round((during[0] - view.times[0]) * NANOSECONDS)
        started = START_NS + elapsed_ns, RECEIVED_FROM_NS + elapsed_ns
        for sensor in sensors:
            times = sensor.capture_times(movement.duration, rng)
            course = movement.course(times.clip(0.0, movement.duration)).placed(place.position, place.yaw)
            truth = kept_in_front(joints(person, course), place.yaw, turn)
            seen = sensor.see(times, truth, person.capsules(), rng, misreading)
            frames += sensor.deliver(times, {0: seen}, *started, rng)
    frames.sort(key=lambda frame: frame.received_ns)
    return calibrated([(frame.sensor, frame.received_ns, all_tracked(frame.skeletons[0])) for frame in frames])


def kept_in_front(positions: FloatArray, yaw: float, turn: float | None) -> FloatArray:
    """(n, 25, 3) joints in ``world`` of a person who turns away from ``yaw`` by at most ``turn`` radians, if given.

    A turn by an angle a becomes ``turn`` sin(a)^3: small for half turns and for small turns.
    """
    if turn is None:
        return positions
    left = left_right_axes(positions)[:, 1]
    heading = np.arctan2(-left[:, 0], left[:, 1]) - yaw
    change = turn * np.sin(heading) ** 3 - heading
    turned = Rotation.from_euler("z", change[:, None]).as_matrix()
    centre = positions[:, [Joint.SPINE_BASE]]
    moved: FloatArray = np.einsum("nij,nkj->nki", turned, positions - centre) + centre
    return moved


def all_tracked(skeleton: Skeleton) -> Skeleton:
    """The skeleton with all known joints Tracked."""
    known = skeleton.states != TrackingState.NOT_TRACKED
    return replace(skeleton, states=np.where(known, TrackingState.TRACKED, TrackingState.NOT_TRACKED).astype(np.uint8))


def stand(pair: Pair) -> Layout:
    """Layout of the sensors round the person, who faces as in the second part of the recording."""
    view = View.of(pair.frames[0])
    first = pair.result.poses[SENSORS[0]]
    here = np.median(first.apply(view.positions[view.part == STANDING, Joint.SPINE_MID]), axis=0)
    left = np.median(body_heading(view.positions[view.part == STEPS]), axis=0) @ first.rotation.T
    towards = np.array([pair.result.poses[sensor].translation - here for sensor in SENSORS])
    azimuths = np.arctan2(towards[:, 1], towards[:, 0]) - np.arctan2(-left[0], left[1])
    azimuths = (azimuths + np.pi) % (2.0 * np.pi) - np.pi
    return around(azimuths.tolist(), np.hypot(towards[:, 0], towards[:, 1]).tolist())


# --- statistics


@dataclass(frozen=True, slots=True, eq=False)
class Agreement:
    """Positions by both sensors at the same times.

    Attributes:
        times: (n,) seconds of kinect1's clock.
        ours, theirs: (n, 25, 3) metres in ``world``.
        turned: (2, n) whether the first or the second sensor has left and right exchanged.
        yaw: (n,) angle between the body's front and kinect1, by kinect1, radians.
    """

    times: FloatArray
    ours: FloatArray
    theirs: FloatArray
    turned: BoolArray
    yaw: FloatArray

    @classmethod
    def of(cls, pair: Pair) -> Agreement:
        stamps, ours, theirs = paired(*pair.frames, pair.result)
        pose = pair.result.poses[SENSORS[0]]
        yaw = viewing_angle((ours - pose.translation) @ pose.rotation)
        return cls(stamps / NANOSECONDS, ours, theirs, turned_round(stamps / NANOSECONDS, ours, theirs), yaw)

    @property
    def usual(self) -> BoolArray:
        """(n,) whether neither sensor has the body turned round."""
        right: BoolArray = ~(self.turned[0] | self.turned[1])
        return right


def turned_round(times: FloatArray, ours: FloatArray, theirs: FloatArray) -> BoolArray:
    """(2, n) whether the first or the second sensor has left and right exchanged; arguments as in `Agreement`."""
    straight = np.linalg.norm(ours - theirs, axis=2)[:, SIDED]
    crossed = np.linalg.norm(ours - theirs[:, MIRROR], axis=2)[:, SIDED]
    differ = np.nansum(straight - crossed, axis=1) > 0.0
    axes = np.stack([body_heading(ours), body_heading(theirs)])
    agreed = np.flatnonzero(~differ & np.isfinite(axes).all(axis=(0, 2)))
    if not len(agreed):
        return np.stack([differ, differ])
    after = np.searchsorted(times[agreed], times).clip(1, max(len(agreed) - 1, 1))
    before = agreed[after - 1]
    after = agreed[np.minimum(after, len(agreed) - 1)]
    nearest = np.where(times - times[before] <= times[after] - times, before, after)
    # a sensor without a shoulder or a hip has no axis: 0, and the other sensor decides
    along = np.nan_to_num(np.einsum("sni,ni->sn", axes, axes.sum(axis=0)[nearest]))
    second = along[1] < along[0]
    return np.stack([differ & ~second, differ & second])


def disagreements(agreement: Agreement) -> list[tuple[Quantity, float]]:
    """Disagreements over all joints and over groups, millimetres."""
    apart = 1e3 * np.linalg.norm(agreement.ours - agreement.theirs, axis=2)
    facing = apart[agreement.usual & (agreement.yaw < FACING)]
    figures = {"mean": np.nanmean(apart), "median": np.nanmedian(apart)}
    for name, group in GROUPS.items():
        figures[f"of {name}, facing, median"] = np.nanmedian(facing[:, group])
        figures[f"of {name}, facing, 95th percentile"] = np.nanpercentile(facing[:, group], 95.0)
    return [(Quantity(f"disagreement {name}", "mm", 0, 1.0), float(figure)) for name, figure in figures.items()]


def lengths(view: View, place: str) -> list[tuple[Quantity, float]]:
    """Standard deviations of the lengths of limbs, millimetres."""
    found = []
    for name, (inner, outer) in LIMBS.items():
        length = np.linalg.norm(view.positions[:, inner] - view.positions[:, outer], axis=2)
        figure = 1e3 * float(np.nanstd(length, axis=0).mean())
        found.append((Quantity(f"spread of length of {name}, {place} sensor", "mm", 0, 1.0), figure))
    return found


def white_noise(view: View, place: str) -> list[tuple[Quantity, float]]:
    """White noise per axis, millimetres."""
    regular = np.abs(np.diff(view.times) - PERIOD) < JITTER
    runs = regular[:-2] & regular[1:-1] & regular[2:]
    third = 1e3 * np.linalg.norm(np.diff(view.positions, 3, axis=0), axis=2) / THIRD_DIFFERENCE
    still = view.part[3:] == STANDING
    found = []
    for when, during in (("still", still), ("moving", ~still)):
        for name, group in NOISY.items():
            figure = float(np.nanmedian(third[runs & during][:, group]))
            found.append((Quantity(f"white noise of {name}, {when}, {place} sensor", "mm", 2, 0.02), figure))
    return found


def gaps(views: Sequence[View]) -> list[tuple[Quantity, float]]:
    """Share of gaps, percent."""
    steps = np.concatenate([np.diff(view.times) for view in views])
    return [(Quantity("gaps longer than 50 ms", "%", 1, 1.0), 100.0 * float((steps[steps < PAUSE] > GAP).mean()))]


def turns(agreement: Agreement, result: CalibrationResult) -> list[tuple[Quantity, float]]:
    """Angles between the views of both sensors, degrees."""
    seen = agreement.usual & (agreement.yaw < FRONT)
    shoulders = np.stack([left_right_axes(positions)[seen, 0] for positions in (agreement.ours, agreement.theirs)])
    to = np.stack([result.poses[sensor].translation - agreement.ours[seen, Joint.SPINE_SHOULDER] for sensor in SENSORS])
    facing, bearing = np.arctan2(-shoulders[..., 0], shoulders[..., 1]), np.arctan2(to[..., 1], to[..., 0])
    apparent, true = (
        np.degrees(np.abs((angle[1] - angle[0] + np.pi) % (2.0 * np.pi) - np.pi))
        for angle in (bearing - facing, bearing)
    )
    return [
        (Quantity("turn between the views, by the shoulders", "deg", 0, 1.0), float(np.nanmedian(apparent))),
        (Quantity("turn between the views, by the calibration", "deg", 0, 1.0), float(np.median(true))),
    ]


def persistence(agreement: Agreement) -> list[tuple[Quantity, float]]:
    """Correlations of the slow errors with themselves a second later."""
    usable = agreement.usual & (parts(agreement.times) != STANDING)
    times, errors = agreement.times[usable], (agreement.ours - agreement.theirs)[usable]
    errors = np.clip(errors - np.nanmedian(errors, axis=0), -CLIP, CLIP)
    later = np.searchsorted(times, times + LAG - LAG_TOLERANCE).clip(max=len(times) - 1)
    close = np.abs(times[later] - times - LAG) < LAG_TOLERANCE
    now, then = errors[close], errors[later[close]]
    found = []
    for name, group in (("trunk", TRUNK), ("wrists", NOISY["wrist"])):
        product, power = np.nansum(now[:, group] * then[:, group]), np.nansum(now[:, group] ** 2)
        correlation = float(product / np.sqrt(power * np.nansum(then[:, group] ** 2)))
        found.append((Quantity(f"correlation of slow errors after 1 s, {name}", "1", 2, 0.1), correlation))
    return found


def statistics(pair: Pair) -> list[tuple[Quantity, float]]:
    """All statistics of a recording."""
    agreement = Agreement.of(pair)
    views = [View.of(frames) for frames in pair.frames]
    found = disagreements(agreement)
    for place, view in zip(PLACES, views, strict=True):
        found += lengths(view, place)
    for place, turned in zip(PLACES, agreement.turned, strict=True):
        found.append((Quantity(f"turned round, {place} sensor", "%", 1, 1.0), 100.0 * float(turned.mean())))
    found += gaps(views)
    for place, view in zip(PLACES, views, strict=True):
        found += white_noise(view, place)
    return found + turns(agreement, pair.result) + persistence(agreement)


# --- tables


def rows_of(
    layout: str, real: Sequence[list[tuple[Quantity, float]]], simulated: Sequence[list[tuple[Quantity, float]]]
) -> list[Row]:
    """A row per statistic, from the recordings of a layout."""
    quantities = [quantity for quantity, _ in real[0]]
    figures = (zip(*([figure for _, figure in each] for each in kind), strict=True) for kind in (real, simulated))
    return [Row(layout, *each) for each in zip(quantities, *figures, strict=True)]


def section(rows: Sequence[Row]) -> str:
    """The rows as a section in Markdown, with a table per layout."""
    marked = sum(row.differs for row in rows)
    lines = [
        PAIRS,
        "",
        "Three people stand still, step back and forth and walk about in front of two Kinect v2 sensors in each of",
        "three layouts. As many simulated people move similarly in front of simulated sensors at the same places; both",
        "are calibrated by the same method. Values are medians over the three recordings of a layout, with their range",
        "in brackets. `differs` marks rows in which the simulated value differs by more than half of the real one:",
        f"{marked} of {len(rows)}. Rare events, such as bodies with front and back swapped, differ between three",
        "people by chance. `benchmarks/simulated_pairs.py` defines each statistic and writes this section.",
    ]
    for layout in dict.fromkeys(row.layout for row in rows):
        lines += ["", f"### {layout}", "", "| statistic | unit | real | simulated | |", "|---|---|---:|---:|---|"]
        for row in rows:
            if row.layout == layout:
                real, simulated, mark = row.cells()
                lines.append(f"| {row.quantity.name} | {row.quantity.unit} | {real} | {simulated} | {mark} |")
    return "\n".join(lines) + "\n"


def main() -> int:
    """The benchmark; it has no bar, the rows show where real and simulated figures differ."""
    parser = common.parser(__doc__, data=True)
    parser.add_argument("--write", action="store_true", help="write the table into docs/simulator.md")
    args = parser.parse_args()
    rows: list[Row] = []
    for layout in NOMINAL:
        real, simulated = [], []
        files = common.recordings(args.data / "kinect_pairs", [f"{who}_{layout}.csv.gz" for who in PEOPLE])
        for seed, file in enumerate(files):
            common.progress(f"{layout}: {seed + 1}/{len(files)} {file.name}")
            pair = real_pair(file)
            real.append(statistics(pair))
            simulated.append(statistics(simulated_pair(pair, seed)))
        rows += rows_of(layout, real, simulated)
    if args.write:
        PAGE.write_text(PAGE.read_text().partition(PAIRS)[0] + section(rows))
    common.report(args, [{**asdict(row), "differs": row.differs} for row in rows], lambda: print(section(rows)))
    return 0


if __name__ == "__main__":
    sys.exit(main())

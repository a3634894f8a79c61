"""All ``/<sensor>/skeleton`` to the poses and clocks of the sensors: the stage of the node ``calibration``."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from body_tracking.calibration.advice import SEVERAL
from body_tracking.calibration.online import CalibrationParameters, CalibrationUpdate, OnlineCalibration
from body_tracking.calibration.storage import load, save
from body_tracking.core.names import TF_STATIC
from body_tracking.core.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.core.qos import LATCHED, Qos
from body_tracking.core.repeats import Repeats
from body_tracking.core.sensor_poses import CalibrationResult
from body_tracking.core.skeleton import NANOSECONDS, Joint, Skeleton
from body_tracking.core.sources import optical_frame
from body_tracking.messages.codecs import Clock, Pose, Poses, SensorClock
from body_tracking.pipeline import graph
from body_tracking.pipeline.people import SubjectSelector
from body_tracking.pipeline.shared import REFERENCE, RELIABLE, SENSORS, WORLD_FRAME, sensors_of, skeleton_input
from body_tracking.pipeline.stage import Now, Output, Port, Stage

_TRUNKS: Final = (0.1, 1.0)
"""Metres: least and greatest distance of SPINE_BASE and SPINE_SHOULDER, 0.5 in an adult."""
_ODD_FRAMES: Final = 30
"""Frames in a row with another distance from which on it is reported: an outlier lasts less."""
_LIVE_S: Final = 10.0
"""Seconds between the stamp of a sensor's frame and the wall clock: of sensors less, of a recording more."""
_LEVEL = "world would tilt or move under everyone who uses it"
_FIXED = {
    "method": "what one method has estimated is no start for the other",
    **dict.fromkeys(("reference_height", "reference_pitch", "reference_roll"), _LEVEL),
    "activation_delay": "by it a recording gives offline what it gave live",
}


class CalibrationStage(Stage):
    """Estimates poses and clocks of the sensors from a moving person."""

    NAME = "calibration"
    PARAMETERS = (
        SENSORS,
        REFERENCE,
        Parameter(
            "calibration_file",
            "",
            "YAML file: loaded at the start if it exists, saved when the result changes; or empty",
            fixed="it is loaded at the start",
        ),
        Parameter(
            "save",
            True,
            "whether calibration_file is written; never where it existed and stamps are more than 10 s from the wall "
            "clock, as those of a recording",
        ),
        WORLD_FRAME,
        *parameters_from(
            CalibrationParameters,
            only=(
                "method",
                "reference_height",
                "reference_pitch",
                "reference_roll",
                "activation_delay",
                "max_rotation_stddev",
            ),
            live=True,
            fixed=_FIXED,
        ),
        RELIABLE,
    )

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        sensors = sensors_of(values)
        parameters = CalibrationParameters(**fields_of(CalibrationParameters, values))
        self.calibration = OnlineCalibration(sensors, parameters, str(values["reference"]) or None)
        self._file = Path(str(values["calibration_file"])).expanduser() if values["calibration_file"] else None
        self._exists = False
        """Whether there was a file at the start, which a recording must not change."""
        if self._file is not None and self._file.exists():
            loaded = load(self._file)
            self.calibration.load(loaded)
            note = "" if values["save"] else ", not to be written"
            self.events.append(f"{self._file}: loaded{note}{lacking(loaded, sensors)}")
            self._exists = True
            self._take_events()
        self._recorded, self._recorded_s = 0, 0.0
        """Frames in a row with stamps as in a recording, and seconds from the last one to the wall clock."""
        self._unsaved = self._saved = False
        self._subjects = {sensor: SubjectSelector() for sensor in sensors}
        self._repeats = {sensor: Repeats() for sensor in sensors}
        self._odd: dict[str, tuple[int, float]] = {}
        """Frames in a row with an impossible trunk, and its last length, metres."""
        self._frames: dict[str, str] = {}
        """The frame of each sensor's last skeletons."""
        self._people: dict[str, int] = {}
        """The number of people in each sensor's last frame."""
        self._sensors = {graph.skeleton_topic(sensor): sensor for sensor in sensors}
        self.inputs = tuple(skeleton_input(topic, values) for topic in self._sensors)
        world = str(values["world_frame"])
        # Two batches: a late subscriber needs the one in force until the latest one comes into force.
        kept = Qos(LATCHED.reliability, LATCHED.durability, 2 * max(1, len(sensors)))
        self.outputs = (
            Port(graph.CALIBRATION_CLOCK, Clock(), kept),
            Port(graph.CALIBRATION, Pose(world), kept, measured=True),
            Port(TF_STATIC, Poses(world), LATCHED, optional=True),
        )
        self.services = {graph.START_SERVICE: self.calibration.start, graph.RESET_SERVICE: self.calibration.reset}

    def change(self, values: Mapping[str, Value]) -> None:
        """Apply from the next frame on; the estimate is kept."""
        self.calibration.parameters = CalibrationParameters(**fields_of(CalibrationParameters, values))
        self.values = values

    def start(self, now: Now) -> Iterable[Output]:
        update = self.calibration.current_update()
        # Valid for all times, so stamped 0 and without drift: from an earlier session to 1970 it would make minutes.
        clocks = {sensor: replace(clock, drift_ppm=0.0) for sensor, clock in update.result.clocks.items()}
        return self._published([replace(update, result=replace(update.result, clocks=clocks))])

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        sensor = self._sensors[topic]
        for skeleton in payload[:1]:
            self._check_size(sensor, skeleton)
            self._frames[sensor] = skeleton.frame_id
            self._check_time(skeleton)
        self._people[sensor] = len(payload)
        subject = self._subjects[sensor].pick(payload)
        if subject is None or self._repeats[sensor].add(subject.stamp_ns, subject.positions):
            return ()
        if self._exists and len(payload) > 1:
            # Two sensors may follow different people, whose motions would replace a good calibration. A frame without
            # points still says that the sensor sends, and how late.
            subject = replace(subject, positions=np.full_like(subject.positions, np.nan))
        updates = self.calibration.push(sensor, subject, now.ros_ns)
        self._unsaved |= bool(updates)
        self._take_events()
        return self._published(updates)

    def _take_events(self) -> None:
        self.events += self.calibration.events
        self.calibration.events.clear()

    def _published(self, updates: Iterable[CalibrationUpdate]) -> Iterator[Output]:
        for update in updates:
            result = update.result
            # Clocks first: a subscriber uses a sensor as soon as it has the pose.
            for sensor, clock in result.clocks.items():
                if sensor != result.reference:
                    yield Output(graph.CALIBRATION_CLOCK, SensorClock(sensor, update.valid_from_ns, clock))
            for pose in result.poses.values():
                yield Output(graph.CALIBRATION, pose)
            yield Output(TF_STATIC, tuple(result.poses.values()))

    def reset(self, topic: str) -> None:
        """Forget the subjects; the calibration itself detects the jump in the stamps."""
        for subject in self._subjects.values():
            subject.reset()

    def restart(self) -> None:
        super().restart()
        self.calibration.restart("errors in a row: starting again from the calibration so far")

    def _check_size(self, sensor: str, skeleton: Skeleton) -> None:
        """Count the frames in a row in which a person has an impossible size."""
        upper, lower = skeleton.positions[[Joint.SPINE_SHOULDER, Joint.SPINE_BASE]]
        length = math.dist(upper, lower)
        if _TRUNKS[0] < length < _TRUNKS[1]:
            self._odd.pop(sensor, None)
        elif 0.0 < length < math.inf:  # nor NaN, nor zeros in place of joints
            self._odd[sensor] = self._odd.get(sensor, (0, 0.0))[0] + 1, length

    def _check_time(self, skeleton: Skeleton) -> None:
        """Count the frames in a row that come from a recording, whoever plays it, and in whatever time.

        Not for good before many: after a standstill of the process those that have waited are old, too.
        """
        seconds = abs(time.time_ns() - skeleton.stamp_ns) / NANOSECONDS
        if seconds > _LIVE_S:
            self._recorded, self._recorded_s = self._recorded + 1, seconds
        elif self._recorded < _ODD_FRAMES:
            self._recorded = 0

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        level, text, values = self.calibration.status()
        several = [sensor for sensor, people in self._people.items() if people > 1]
        if level and several:
            text += f"; {SEVERAL} of {', '.join(sorted(several))}"
        if self._exists and self.values["save"] and self._recorded >= _ODD_FRAMES:
            text += (
                f"; {self._file} is not written, as the stamps are those of a recording: {self._recorded_s:.0f} s "
                "from the time of this computer"
            )
        odd = [
            f"{sensor}: a trunk of {length:.3g} m, coordinates must be metres"
            for sensor, (count, length) in self._odd.items()
            if count >= _ODD_FRAMES
        ]
        # any other frame may be the name that a driver gives to its own
        others = {optical_frame(sensor): sensor for sensor in self._sensors.values()}
        odd += [
            f"{sensor}: its skeletons are in {frame}, of another sensor"
            for sensor, frame in self._frames.items()
            if others.get(frame, sensor) != sensor
        ]
        return (1, "; ".join((*odd, text)), values) if odd else (level, text, values)

    def save(self) -> None:
        """Write the file, if anything changed."""
        if self._exists and self._recorded:
            return  # the people and clocks of a recording may not be those of the file
        if self._file is not None and self._unsaved and self.values["save"]:
            # The published poses, not the estimates toward which they still slew: a restart must not jump.
            save(self.calibration.current_update().result, self._file)
            if not self._saved:  # not each time: it is every few seconds at first
                self.events.append(f"{self._file}: written, and again whenever the estimate changes")
            self._saved, self._unsaved = True, False


def lacking(saved: CalibrationResult, sensors: Sequence[str]) -> str:
    """What a saved calibration lacks, for a message; empty if it has all sensors."""
    missing = [sensor for sensor in sensors if sensor not in saved.poses]
    if not missing:
        return ""
    return f"; it has {', '.join(saved.poses)}, but not {', '.join(missing)}, to be estimated from movement"

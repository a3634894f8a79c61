"""Four sensors of 30 Hz live through the graph: lost frames, processor time of each node, and delay of its output.

A simulated person twists the trunk as in a shipped bag. Four Kinects see it; they run on their own clocks and deliver
with different delays, so that many frames arrive after later ones of other sensors. ``body_tracking up`` plays them in
real time through four sensor nodes; the filter ``ekf`` takes each frame by itself, best effort as by default.

All figures are measured from outside: frames by the recording and by ``/diagnostics``, processor time of each process
over the steady part, delays from the capture stamps to the receipt in this process, since capture and since delivery. A
frame that arrives after a later one has no output of its own: the filter takes it and then the later ones again. The
filter's processor time is scaled as if it had an output for every frame. The bars assume a machine that does nothing
else.
"""

from __future__ import annotations

import contextlib
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import common
import live
import numpy as np

from body_tracking.core.clocks import ClockModel
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.core.sources import RecordedFrame
from body_tracking.kinect.simulated import KinectErrors
from body_tracking.pipeline import graph
from body_tracking.simulation import scene
from body_tracking.simulation.bags import write_bag
from body_tracking.simulation.layouts import around
from body_tracking.simulation.scene import RECEIVED_FROM_NS, START_NS, Setup, SimulatedRecording

FILTER = "ekf"
LIMIT = 0.30
"""Largest share of one core for the filter node."""

SETTLE, TAIL = 7.0, 2.5
"""Seconds before the steady part, for initialisation of person and sensors, and after it."""

START_AFTER = 12.0
"""Seconds until the sensors deliver; every node is up by then."""

SEED = 4
_LAYOUT = around(np.radians([45.0, -45.0, 0.0, -80.0]).tolist(), (2.0, 2.0, 2.4, 2.2), (1.0, 1.0, 1.25, 0.9))
"""The two sensors of the shipped bags, one in front of the person and one far to the right."""
_DELAYS = ((0.022, 0.003), (0.034, 0.004), (0.028, 0.003), (0.045, 0.006))
"""Delivery delay of each sensor, seconds: the least, and the mean of the random rest."""

_SAME_FRAME_NS = 2_000_000
"""Largest difference between an output's stamp and the capture of its frame: the sensors' clocks are estimated."""

# The filter's counters of rejected frames.
_REFUSED = ("too_late", "repeated_stamps", "alignment uncalibrated", "alignment other_clock", "malformed", "refused")


# --- the recording


def simulate(duration: float) -> SimulatedRecording:
    """The recording; the same at each call."""
    setup = Setup("torso_twist", _LAYOUT, seconds=duration, seed=SEED, standard=True)
    frames: list[RecordedFrame] = []
    for pose, (least, more) in zip(_LAYOUT.poses, _DELAYS, strict=True):
        # one sensor's errors do not change the others: take from each recording the sensor with these errors
        errors = KinectErrors(delay=least, delay_jitter=more)
        recording = scene.simulate(replace(setup, errors=errors))
        frames += [frame for frame in recording.frames if frame.sensor == pose.sensor]
    frames.sort(key=lambda frame: (frame.received_ns, frame.sensor))
    return replace(recording, frames=tuple(frames))


def captures(recording: SimulatedRecording) -> list[int]:
    """Capture time of each frame, nanoseconds after the start."""
    clocks = {sensor.pose.sensor: sensor.clock for sensor in recording.sensors}
    return [clocks[each.sensor].to_reference(each.skeletons[0].stamp_ns) - START_NS for each in recording.frames]


def disorder(taken: Sequence[int]) -> int:
    """Number of frames delivered after later ones."""
    return sum(any(other > each for other in taken[max(0, k - 40) : k]) for k, each in enumerate(taken))


# --- the measurement


def up_command(folder: Path, recording: SimulatedRecording, start: float) -> list[str]:
    """Command line of ``body_tracking up`` with four sensor nodes that begin to play at this wall time, seconds."""
    bag = folder / "bag"
    write_bag(recording, bag)
    poses = {sensor.pose.sensor: sensor.pose for sensor in recording.sensors}
    # stamps are in ROS time, as if the fastest frame of each sensor came without delay
    offsets = [least - _DELAYS[0][0] for least, _ in _DELAYS]
    clocks = {name: ClockModel(round(offset * NANOSECONDS)) for name, offset in zip(poses, offsets, strict=True)}
    calibration = live.calibrated(folder / "calibration.yaml", poses, clocks, 1.0)
    values = {f"{name}_skeleton": {"file": str(bag), "start_time": start} for name in poses}
    parameters = live.parameters_file(folder / "parameters.yaml", values)
    words = ["--filter", FILTER, "--sensors", ",".join(poses), "--params-file", parameters]
    return live.up_command(*words, "--calibration", calibration, "--log-dir", folder)


def listen(ear: live.Ear, wall: float, alive: Callable[[], bool]) -> None:
    """Spin until this wall time, seconds."""
    while time.time() < wall:
        if not alive():
            raise SystemExit("four_sensors: the graph ended too early")
        ear.executor.spin_once(timeout_sec=min(0.2, max(0.0, wall - time.time())))


def measure(seconds: float) -> dict[str, Any]:
    """Run the graph once."""
    recording = simulate(SETTLE + seconds + TAIL)
    taken = captures(recording)
    start = time.time() + START_AFTER
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        command = up_command(folder, recording, start)
        (up,) = stack.enter_context(live.processes([command], folder / "up.log"))
        ear = live.Ear("four_sensors_bench", time.time_ns)
        stack.callback(ear.close)
        ear.hear_diagnostics()
        ear.time("model_state", graph.MODEL_STATE, qos=graph.SKELETON)
        ear.time("joint_states", graph.joint_states_topic(graph.DEFAULT_BODY))

        def alive() -> bool:
            return up.poll() is None

        listen(ear, start + SETTLE, alive)
        processes = live.nodes_of(up.pid)
        before = {name: live.cpu_seconds(process) for name, process in processes.items()}
        begin = time.monotonic()
        listen(ear, start + SETTLE + seconds, alive)
        elapsed = time.monotonic() - begin
        share = {name: (live.cpu_seconds(process) - before[name]) / elapsed for name, process in processes.items()}
        # the last frame is through, and all nodes have published diagnostics once more
        listen(ear, start + max(_delivered(frame) for frame in recording.frames) / NANOSECONDS + 2.5, alive)
    if "skeleton_filter" not in share or "skeleton_filter" not in ear.statuses:
        raise SystemExit("four_sensors: the filter node was not there")
    outputs = _delays(recording, taken, ear, start, SETTLE, SETTLE + seconds)
    due = sum(SETTLE * NANOSECONDS <= each < (SETTLE + seconds) * NANOSECONDS for each in taken)
    share_of_outputs = min(1.0, outputs["model_state"]["count"] / due)
    return {
        "seconds": round(elapsed, 1),
        "filter": FILTER,
        "sensors": _sensor_rows(recording, taken, ear),
        "refused": {name: int(ear.number("skeleton_filter", name)) for name in _REFUSED},
        "late": {
            "delivered": disorder(taken),
            **{name: int(ear.number("skeleton_filter", name)) for name in ("frames", "late_frames", "taken_again")},
        },
        "outputs": outputs,
        "filter_percent_of_all": round(100.0 * share["skeleton_filter"] / share_of_outputs, 1),
        "cpu_percent": {name: round(100.0 * value, 1) for name, value in sorted(share.items(), key=lambda i: -i[1])},
    }


def _sensor_rows(recording: SimulatedRecording, taken: list[int], ear: live.Ear) -> dict[str, dict[str, float]]:
    """Frames and delays per sensor."""
    rows = {}
    for sensor in recording.sensors:
        name = sensor.pose.sensor
        own = [k for k, frame in enumerate(recording.frames) if frame.sensor == name]
        delays = [(_delivered(recording.frames[k]) - taken[k]) / 1e6 for k in own]
        rows[name] = {
            "recorded": len(own),
            "sent": int(ear.number(f"{name}_skeleton", "published")),
            "taken": int(ear.number("skeleton_filter", f"frames of {name}")),
            "delay_median_ms": round(float(np.median(delays)), 1),
            "delay_max_ms": round(max(delays), 1),
        }
    return rows


def _delivered(frame: RecordedFrame) -> int:
    """Receipt time, nanoseconds after the start."""
    return frame.received_ns - RECEIVED_FROM_NS


def _delays(
    recording: SimulatedRecording, taken: list[int], ear: live.Ear, start: float, begin: float, end: float
) -> dict[str, dict[str, float]]:
    """Per output, in the steady part: number of messages, and their delays since capture and since delivery."""
    order = np.argsort(taken)
    times = np.array(taken)[order]
    delivered = np.array([_delivered(frame) for frame in recording.frames])[order]
    # the sensors play from the receipt of the first frame
    start_ns = round(start * NANOSECONDS) - int(delivered.min())
    result = {}
    for name, received in ear.received.items():
        stamps = np.array(sorted(received)) - start_ns - round(_DELAYS[0][0] * NANOSECONDS)
        arrived = np.array([received[stamp] for stamp in sorted(received)]) - start_ns
        steady = (stamps >= begin * NANOSECONDS) & (stamps < end * NANOSECONDS)
        stamps, arrived = stamps[steady], arrived[steady]
        if not len(stamps):
            raise SystemExit(f"four_sensors: no {name} came")
        nearest = np.clip(np.searchsorted(times, stamps), 1, len(times) - 1)
        nearest -= stamps - times[nearest - 1] < times[nearest] - stamps
        # outputs without a frame are predicted, or the calibration has moved a clock
        known = np.abs(times[nearest] - stamps) < _SAME_FRAME_NS
        row: dict[str, float] = {"count": len(stamps), "matched": int(known.sum())}
        for since, values in (("capture", arrived - stamps), ("delivery", (arrived - delivered[nearest])[known])):
            for key, percent in (("median", 50), ("p99", 99)):
                row[f"{since}_{key}_ms"] = round(float(np.percentile(values, percent)) / 1e6, 2)
        result[name] = row
    return result


def main() -> int:
    """The command: 0, or 1 when a bar is missed."""
    parser = common.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=30.0, help="steady seconds to measure (default: %(default)g)")
    args = parser.parse_args()
    if not 1.0 <= args.seconds <= 600.0:
        parser.error(f"--seconds {args.seconds:g}: expected 1 to 600")
    result = measure(args.seconds)
    common.report(args, result)
    rows = result["sensors"].values()
    whole = all(row["recorded"] == row["sent"] == row["taken"] for row in rows) and not any(result["refused"].values())
    share = result["filter_percent_of_all"]
    met = {"no frame lost": whole, f"filter {share} %, at most {100 * LIMIT:.0f}": share < 100.0 * LIMIT}
    return common.verdicts(args, met)


if __name__ == "__main__":
    sys.exit(main())

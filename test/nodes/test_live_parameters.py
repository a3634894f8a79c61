"""The parameter services of every node as a process: live parameters take effect, the others are refused by reason."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

pytest.importorskip("rclpy")

from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import GetParameters, SetParameters
from running import BAG, Running
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from body_tracking import systems
from body_tracking.core.parameters import ParameterError
from body_tracking.kinematics.conventions import angle_names
from body_tracking.pipeline import graph

PARAMETERS: dict[str, dict[str, object]] = {
    "joint_angles": {},
    "skeleton_filter": {},
    "fusion": {"reliable": True},
    "calibration": {},
    "imu_skeleton": {"segments": "[forearm_left]"},
    "bag_recorder": {"start_recording": False},
    "kinect_skeleton": {"sensor": "kinect9", "file": BAG, "recorded_sensor": "kinect1", "loop": True},
    "bag_player": {"bag": BAG, "loop": True, "reliable": True, "topics": "[/kinect1/skeleton, /kinect2/skeleton]"},
}


class Graph(Running):
    """The nodes, over a bag that begins again and again."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        for name, parameters in PARAMETERS.items():
            more = {"folder": folder / "first"} if name == "bag_recorder" else {}
            self.start(name, **parameters, **more)
        self.angles = self.collect(JointState, graph.joint_states_topic("body1"))

    def set(self, node: str, **values: object) -> list[tuple[bool, str]]:
        """Whether each was set, and the reason if not."""
        parameters = [Parameter(name=name, value=_value(value)) for name, value in values.items()]
        answer = self.call(SetParameters, f"/{node}/set_parameters", SetParameters.Request(parameters=parameters))
        return [(result.successful, result.reason) for result in answer.results]

    def get(self, node: str, names: Sequence[str]) -> list[ParameterValue]:
        answer = self.call(GetParameters, f"/{node}/get_parameters", GetParameters.Request(names=names))
        return list(answer.values)


def _value(value: object) -> ParameterValue:
    if isinstance(value, ParameterValue):
        return value
    if isinstance(value, bool):
        return ParameterValue(type=ParameterType.PARAMETER_BOOL, bool_value=value)
    if isinstance(value, int):
        return ParameterValue(type=ParameterType.PARAMETER_INTEGER, integer_value=value)
    if isinstance(value, float):
        return ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=value)
    return ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=str(value))


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    with Graph(tmp_path_factory.mktemp("graph")) as graph_:
        assert graph_.until(lambda: PARAMETERS.keys() <= graph_.diagnostics.keys(), 240.0), graph_.diagnostics.keys()
        assert graph_.until(lambda: graph_.angles, 120.0)
        yield graph_


# --- /diagnostics


def test_every_node_reports_rates_of_inputs_and_outputs(running: Graph) -> None:
    flows = {
        "bag_player": f"rate out {graph.skeleton_topic('kinect1')}",
        "kinect_skeleton": f"rate out {graph.skeleton_topic('kinect9')}",
        "calibration": f"rate in {graph.skeleton_topic('kinect2')}",
        "fusion": f"rate out {graph.FUSED}",
        "skeleton_filter": f"rate in {graph.FUSED}",
        "joint_angles": f"rate in {graph.FILTERED}",
        "imu_skeleton": f"rate in {graph.FUSED}",
    }
    assert running.until(lambda: all(running.number(node, key) > 5.0 for node, key in flows.items())), (
        running.diagnostics
    )
    assert running.number("joint_angles", "delay median ms") > 0.0


# --- parameters


@pytest.mark.parametrize("executable", systems.EXECUTABLES)
def test_every_parameter_is_live_or_has_a_reason(executable: str) -> None:
    for item in systems.parameters_of(executable):
        if item.live:
            assert item.check_change(item.default) == item.default
            assert not item.fixed, item.name
        else:
            with pytest.raises(ParameterError, match=r"cannot change while the node runs: .+ Restart it"):
                item.check_change(item.default)


@pytest.mark.parametrize("node", sorted(PARAMETERS))
def test_live_parameters_change_and_others_state_reason_and_remedy(running: Graph, node: str) -> None:
    table = systems.parameters_of(node)
    names = [item.name for item in table]
    values = dict(zip(names, running.get(node, names), strict=True))
    answers = running.set(node, **values)
    for item, (done, reason) in zip(table, answers, strict=True):
        assert done == item.live, (item.name, reason)
        if not item.live:
            assert reason == (
                f"{node}: parameter {item.name!r} cannot change while the node runs: "
                f"{item.fixed or 'it is read at the start'}. Restart it with the value in --params-file, or with "
                f"-p {item.name}:=VALUE"
            )


def test_wrong_name_or_value_is_refused_with_our_reason(running: Graph) -> None:
    refused = {
        "silense": (0.2, "fusion: unknown parameter 'silense'; did you mean 'silence'?"),
        "silence": (99.0, "fusion: parameter 'silence': 99.0, expected 0.02 to 5"),
        "method": ("mean", "fusion: parameter 'method': 'mean', expected one of covariance, thesis_text"),
        "max_wait": ("wide", "fusion: parameter 'max_wait': 'wide', expected a number"),
    }
    before = running.get("fusion", ["silence", "method", "max_wait"])
    answers = running.set("fusion", **{name: value for name, (value, _) in refused.items()})
    for (done, reason), (_, expected) in zip(answers, refused.values(), strict=True):
        assert not done
        assert reason.startswith(expected)
    assert running.get("fusion", ["silence", "method", "max_wait"]) == before


@pytest.mark.parametrize("node", ["fusion", "bag_recorder"])
def test_the_clock_of_a_running_node_cannot_change(running: Graph, node: str) -> None:
    for value in (True, False):
        [(done, reason)] = running.set(node, use_sim_time=value)
        assert not done
        assert reason.startswith(f"{node}: parameter 'use_sim_time' cannot change while the node runs")
    assert not running.get(node, ["use_sim_time"])[0].bool_value


def test_integer_is_accepted_for_a_float(running: Graph) -> None:
    assert running.set("fusion", max_wait=1) == [(True, "")]
    [wait] = running.get("fusion", ["max_wait"])
    assert wait.type == ParameterType.PARAMETER_DOUBLE
    assert wait.double_value == 1.0


def test_the_fusion_drops_a_sensor_sooner_and_keeps_its_poses(running: Graph) -> None:
    assert running.until(lambda: running.said("calibration").get("", "") == "calibrated", 60.0)
    before = running.number("fusion", "silent")
    assert running.set("fusion", silence=0.02) == [(True, "")]
    # of two sensors at 30 Hz the other's newest frame is often older than that; one without a pose is not counted
    assert running.until(lambda: running.number("fusion", "silent") > before + 30), running.diagnostics
    assert running.set("fusion", silence=0.1) == [(True, "")]


def test_the_calibration_warns_by_another_limit(running: Graph) -> None:
    assert running.until(lambda: running.said("calibration").get("", "") == "calibrated", 60.0)
    assert running.set("calibration", max_rotation_stddev=0.001) == [(True, "")]
    assert running.until(lambda: "roughly calibrated" in running.said("calibration").get("", ""))
    assert running.set("calibration", max_rotation_stddev=0.05) == [(True, "")]
    assert running.until(lambda: running.said("calibration").get("", "") == "calibrated")


def test_the_angles_follow_the_filter(running: Graph) -> None:
    """To the state of a model where the filter has one, and back to skeletons."""
    for name, convention in (("ekf", "model"), ("lkf_zero_velocity", "positional"), ("ekf", "model")):
        first = f"{angle_names(convention)[1]}_body1"
        assert running.set("skeleton_filter", filter=name) == [(True, "")]
        assert running.until(lambda first=first: running.angles and first in running.angles[-1].name, 60.0), (
            name,
            running.diagnostics,
        )


def test_another_convention_holds_for_every_filter(running: Graph) -> None:
    assert running.set("joint_angles", convention="isb") == [(True, "")]
    for name, source in (("lkf_constant_velocity", "skeleton"), ("ekf", "model_state")):
        assert running.set("skeleton_filter", filter=name) == [(True, "")]
        assert running.until(lambda s=source: running.said("joint_angles").get("", "") == f"isb angles of {s}", 60.0)
        running.angles.clear()
        assert running.until(lambda: running.angles and "thorax_extension_body1" in running.angles[-1].name, 60.0)
    assert running.set("joint_angles", convention="auto") == [(True, "")]


def test_an_input_that_the_filter_does_not_publish_is_reported(running: Graph) -> None:
    assert running.set("skeleton_filter", filter="lkf_zero_velocity") == [(True, "")]
    assert running.set("joint_angles", input="model_state") == [(True, "")]
    assert running.until(
        lambda: "no filter publishes /filtered/model_covariance" in running.said("joint_angles").get("", "")
    )
    assert running.set("joint_angles", input="auto") == [(True, "")]
    running.angles.clear()
    assert running.until(lambda: running.angles, 60.0)


def test_the_player_plays_faster(running: Graph) -> None:
    assert running.set("bag_player", rate=3) == [(True, "")]
    reports: list[tuple[float, float]] = []

    def sent_per_second() -> float:
        sent = running.number("bag_player", "sent")
        if not reports or sent != reports[-1][1]:
            reports.append((time.monotonic(), sent))
        (before, sent_before), (now, sent) = reports[max(0, len(reports) - 4)], reports[-1]
        return (sent - sent_before) / (now - before) if now > before else 0.0

    assert running.until(lambda: sent_per_second() > 90.0)  # 60 frames of two sensors in a second of the bag
    rate = f"rate out {graph.skeleton_topic('kinect1')}"
    assert running.until(lambda: 25.0 < running.number("bag_player", rate) < 35.0)  # of the bag's time
    assert running.set("bag_player", rate=1.0) == [(True, "")]


def test_what_is_no_topic_is_refused_by_name_and_nothing_changes(running: Graph) -> None:
    before = running.get("bag_recorder", ["folder", "topics", "exclude"])
    for name in ("topics", "exclude"):
        value = ParameterValue(type=ParameterType.PARAMETER_STRING_ARRAY, string_array_value=["/a b"])
        [(done, reason)] = running.set("bag_recorder", **{name: value})
        assert not done
        assert reason.startswith(f"bag_recorder: parameter {name!r}: '/a b' is no topic (")
    assert running.get("bag_recorder", ["folder", "topics", "exclude"]) == before


def test_a_place_beyond_all_recordings_is_refused_by_name(running: Graph) -> None:
    [(done, reason)] = running.set("bag_player", position=1e308)
    assert not done
    assert reason.startswith("bag_player: parameter 'position': 1e+308, expected 0 to 1e+09")


def test_a_reset_of_the_calibration_is_reported_at_once(running: Graph) -> None:
    """``robot_commands`` follows until it is; just after a regular report the next one is due in a second."""
    delays = []
    for _ in range(2):
        assert running.until(lambda: running.said("calibration").get("", "") == "calibrated", 60.0)
        before = running.said("calibration")
        assert running.until(lambda before=before: running.said("calibration") is not before)
        begin = time.monotonic()
        assert running.call(Trigger, "/calibration/reset", Trigger.Request()).success
        assert running.until(lambda: "waiting for a still pose" in running.said("calibration").get("", ""))
        delays.append(time.monotonic() - begin)
    assert min(delays) < 0.5, delays


def test_the_recorder_changes_its_bag_between_two_recordings_only(running: Graph) -> None:
    first, second = running.folder / "first", running.folder / "second"
    assert running.call(Trigger, "/recorder/start", Trigger.Request()).success
    [(done, reason)] = running.set("bag_recorder", folder=second)
    assert not done
    assert "call recorder/stop first" in reason
    assert running.until(lambda: running.number("bag_recorder", f"rate in {graph.FUSED}") > 5.0)
    assert running.call(Trigger, "/recorder/stop", Trigger.Request()).success
    assert running.set("bag_recorder", folder=second) == [(True, "")]
    assert running.call(Trigger, "/recorder/start", Trigger.Request()).success
    assert running.until(lambda: running.said("bag_recorder").get("bag") == str(second))
    assert running.call(Trigger, "/recorder/stop", Trigger.Request()).success
    assert {path.suffix for folder in (first, second) for path in folder.iterdir()} == {".mcap", ".yaml"}

"""``body_tracking call`` on real nodes, and on a service that does not answer."""

from __future__ import annotations

import contextlib
import io
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from unittest.mock import patch

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS is not installed")

from running import Running  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from body_tracking import cli  # noqa: E402
from body_tracking.pipeline import graph  # noqa: E402
from body_tracking.ros import triggers  # noqa: E402
from body_tracking.ros.call import CallError  # noqa: E402
from body_tracking.ros.triggers import Triggers  # noqa: E402


class Rigs(Running):
    """A calibration in the root namespace and one in ``/lab``, and a recorder that can write nothing."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.start("calibration")
        (folder / "file").touch()
        self.start("bag_recorder", start_recording=False, folder=folder / "file" / "bag")
        self.start_module("lab", "body_tracking.nodes", "calibration", "--ros-args", "-r", "__ns:=/lab")
        for name in (graph.START_SERVICE, f"lab/{graph.START_SERVICE}", "recorder/stop"):
            client = self.node.create_client(Trigger, f"/{name}")  # is kept, like those of the viewer
            assert client.wait_for_service(60.0), name
        self.start("mesh_tracker", camera="side")
        self.node.create_client(Trigger, f"/{graph.ALIGN_SERVICE}")

    def say(self, *words: str) -> tuple[int, str, str]:
        """Exit code, output and error output of ``body_tracking call``, in this process."""
        with (
            patch.dict(os.environ, self.environment),
            contextlib.redirect_stdout(io.StringIO()) as out,
            contextlib.redirect_stderr(io.StringIO()) as err,
        ):
            code = cli.main(["call", *words])
        return code, out.getvalue(), err.getvalue()


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rigs]:
    with Rigs(tmp_path_factory.mktemp("call")) as running:
        yield running


def test_services_are_listed_with_what_they_do(rigs: Rigs) -> None:
    """A node may be discovered only after the others' list has settled: the list is asked for until all are in it."""

    def listed(*words: str) -> dict[str, str]:
        code, printed, error = rigs.say(*words)
        assert code == 0 and not error
        return dict(line.split(maxsplit=1) for line in printed.splitlines())

    wanted = {"calibration/start", "lab/calibration/start", "recorder/stop", "side_mesh/personalise"}
    lists: list[dict[str, str]] = []
    assert rigs.until(lambda: lists.append(listed()) or wanted <= lists[-1].keys())
    services = lists[-1]
    assert services["calibration/start"].startswith("estimate the poses anew")
    assert services["lab/calibration/start"] == services["calibration/start"]
    assert services["recorder/stop"] == "stop recording and close the bag"
    assert graph.ALIGN_SERVICE not in services, "no node offers it"
    assert services["side_mesh/personalise"].startswith("estimate the shape")
    assert rigs.until(lambda: list(listed("--namespace", "lab")) == ["calibration/reset", "calibration/start"])


@pytest.mark.parametrize("words", [["/calibration/start"], ["--namespace", "/lab", "calibration/start"]])
def test_a_node_answers(rigs: Rigs, words: list[str]) -> None:
    code, printed, error = rigs.say(*words)
    assert code == 0 and printed.startswith("calibrating: ") and not error


def test_the_command_as_a_process(rigs: Rigs) -> None:
    command = [sys.executable, "-m", "body_tracking.cli", "call", "calibration/start"]
    done = subprocess.run(command, env=rigs.environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0 and done.stdout.startswith("calibrating: ") and not done.stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["recorder/start"], "/recorder/start: "),
        (["calibration/strt"], "no service /calibration/strt in ROS domain "),
        (["--namespace", "attic", "calibration/start"], "no service /attic/calibration/start in namespace /attic"),
        (["--namespace", "attic"], "no service in namespace /attic, in ROS domain "),
        (["calibration/set_parameters"], "/calibration/set_parameters is a service of type rcl_interfaces/srv/SetPara"),
        (["start again"], "'start again' is no name of a service"),
        (["--namespace", "a b"], "namespace 'a b'"),
    ],
)
def test_errors_are_reported_in_one_line(rigs: Rigs, words: list[str], message: str) -> None:
    code, printed, error = rigs.say(*words)
    assert code == 2 and not printed
    assert error.startswith(f"body_tracking: {message}") and error.count("\n") == 1, error
    if words == ["calibration/strt"]:
        assert "there: calibration/reset, calibration/start, lab/calibration/reset" in error


def test_a_node_that_hangs_does_not_hang_the_caller(rigs: Rigs, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bench offers a service, and is not spun."""
    for name, value in rigs.environment.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setattr(triggers, "ANSWER_S", 1.0)
    service = rigs.node.create_service(Trigger, "hung/do", lambda request, response: response)
    began = time.monotonic()
    with Triggers("/") as open_triggers, pytest.raises(CallError, match=r"^/hung/do: no answer within 1 s$"):
        open_triggers.call("hung/do")
    assert time.monotonic() - began < 15.0
    rigs.node.destroy_service(service)

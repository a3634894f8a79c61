"""The ``body_tracking`` command: help, version, and one line for everything that is wrong outside the program."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest

from body_tracking import cli
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import JOINT_STATE
from body_tracking.recording.rosbag2 import BagWriter
from body_tracking.ros import advice
from body_tracking.systems import options_from

ROOT = Path(__file__).resolve().parent.parent
COMMANDS = ("import", "bag info", "replay", "calibrate", "up", "doctor", "call", "show", "evaluate", "make-bags")


@pytest.mark.parametrize("command", ["", *COMMANDS])
def test_every_command_has_a_help_and_is_listed(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main([*command.split(), "--help"])
    assert ended.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: body_tracking {command}" in text
    assert command or all(each.split()[0] in text for each in COMMANDS)


def _parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    below = [each for each in parser._actions if isinstance(each, argparse._SubParsersAction)]
    yield from (found for each in below for verb in each.choices.values() for found in _parsers(verb))
    if not below:
        yield parser


def test_each_help_says_what_its_command_does_in_lines_that_a_terminal_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "100")
    for name in cli.subcommands():
        for found in _parsers(cli.parser(name)):
            assert found.description, found.prog
            assert max(map(len, found.format_help().splitlines())) <= 100, found.prog


@pytest.fixture
def nobody(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Path]:
    """An empty folder, and a ROS domain without anybody."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(advice, "_domain", lambda page: [("No sensor publishes.", (f"body_tracking up{page}",))])
    yield tmp_path


def test_without_a_command_it_says_what_to_do_next(nobody: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def said() -> str:
        assert cli.main([]) == 0
        return capsys.readouterr().out

    assert "Recordings that come with the package: tpose_" in said() and "  body_tracking view\n" in said()
    (nobody / "bags").mkdir()
    (nobody / "bags" / "mine").symlink_to(ROOT / "bags" / "tpose_wave")
    text = said()
    assert "Recordings in this folder: bags/mine." in text
    assert "  body_tracking up --bag bags/mine" in text and "  body_tracking replay bags/mine -o mine_angles" in text
    with BagWriter(nobody / "session") as writer:
        writer.add_topic("/lab/humans/bodies/body1/joint_states", JOINT_STATE)  # of a graph in a namespace
    assert "Recordings in this folder: session, bags/mine." in (text := said())
    assert "  body_tracking show session\n  body_tracking up --bag session" in text and "replay" not in text
    (nobody / "lab.yaml").write_text("kinect1_skeleton: {ros__parameters: {backend: network}}")
    assert "  body_tracking up --params-file lab.yaml" in said()


def test_without_ros_it_says_how_to_install_it(
    nobody: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(advice, "find_spec", lambda name: None)
    assert cli.main([]) == 0
    text = capsys.readouterr().out
    assert "pip install 'ros-jazzy-rclpy==" in text and "body_tracking replay" in text
    assert "body_tracking up" not in text


def test_the_version_is_the_manifests(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["--version"])
    version = ElementTree.parse(ROOT / "package.xml").getroot().findtext("version")
    assert capsys.readouterr().out.strip() == f"body_tracking {version}"


@pytest.mark.parametrize(
    "command",
    [
        "import nowhere.csv -o bag",
        "bag info nowhere",
        "replay nowhere -o out",
        "calibrate nowhere",
        "show nowhere",
        "evaluate nowhere",
    ],
)
def test_missing_files_are_reported_in_one_line(
    command: str, capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(command.split()) == 2
    captured = capsys.readouterr()
    assert len(captured.err.strip().splitlines()) == 1
    assert captured.err.startswith("body_tracking: ") and "nowhere" in captured.err
    assert not captured.out
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "said", "command"),
    [
        (
            "replay bag -o out --filtre ekf",
            "unrecognized arguments: --filtre ekf; did you mean '--filter'?",
            "body_tracking replay",
        ),
        ("up bags/wave", "unrecognized arguments: bags/wave; did you mean '--bag bags/wave'?", "body_tracking up"),
        ("up --rate fast", "argument --rate: invalid float value: 'fast'", "body_tracking up"),
        ("replay bag", "the following arguments are required: -o/--output", "body_tracking replay"),
        ("camera show image.png -o out.png --large", "unrecognized arguments: --large", "body_tracking camera show"),
        ("view --port 8081", "unrecognized arguments: --port 8081 (see ", "body_tracking view"),
        ("replya bag", "argument COMMAND: invalid choice: 'replya'; did you mean 'replay'?", "body_tracking"),
        ("up --filter efk", "argument --filter: invalid choice: 'efk'; did you mean 'ekf'?", "body_tracking up"),
        ("up --filter EKF", "argument --filter: invalid choice: 'EKF'; did you mean 'ekf'?", "body_tracking up"),
        (
            "view --bag bags/wave",
            "unrecognized arguments: --bag bags/wave; the page lists the recordings; `body_tracking up --bag BAG "
            "--viewer` shows one at once",
            "body_tracking view",
        ),
        ("view --bag=wave", "unrecognized arguments: --bag=wave; the page lists", "body_tracking view"),
        ("view bags/wave", "unrecognized arguments: bags/wave; the page lists", "body_tracking view"),
        (
            "replay --bag bags/wave -o out",
            "unrecognized arguments: --bag; the recording stands here without '--bag'",
            "body_tracking replay",
        ),
        ("play bags/wave", "argument COMMAND: invalid choice: 'play'; did you mean 'up --bag BAG'?", "body_tracking"),
        ("record", "argument COMMAND: invalid choice: 'record'; did you mean 'up --record NEW_BAG'?", "body_tracking"),
        ("bag bags/wave", "argument VERB: invalid choice: 'bags/wave'; 'bag info BAG' lists", "body_tracking bag"),
        ("bag inf bags/wave", "argument VERB: invalid choice: 'inf'; did you mean 'info'?", "body_tracking bag"),
        ("--filter ekf replay bag -o out", "--filter: options come after the command", "body_tracking"),
        (
            "simulate --around -40,40 -o out",
            "argument --around: expected one argument; write --around=-40,40",
            "body_tracking simulate",
        ),
        ("up --bag bags/a --bag=bags/b", "argument --bag: given twice: bags/a and bags/b", "body_tracking up"),
        ("up --filter xyz", "argument --filter: invalid choice: 'xyz' (choose from ", "body_tracking up"),
    ],
)
def test_a_wrong_argument_is_one_line_that_names_the_help_of_its_command(
    words: str, said: str, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(words.split())
    assert ended.value.code == 2
    captured = capsys.readouterr()
    assert captured.err.startswith(f"body_tracking: {said}") and captured.err.endswith(f" (see {command} --help)\n")
    assert captured.err.count("\n") == 1 and not captured.out


def test_a_folder_is_not_an_image(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["camera", "show", str(tmp_path), "-o", str(tmp_path / "people.png")]) == 2
    assert capsys.readouterr().err == f"body_tracking: {tmp_path}: not an image\n"


@pytest.mark.parametrize("given", ["tpose_wav", "tpose_wave", "bags/tpose_wvae", "bags/tpose_wave.bag"])
def test_a_mistyped_recording_is_answered_by_the_one_that_is_meant(
    given: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(ROOT)
    assert cli.main(["bag", "info", given]) == 2
    assert capsys.readouterr().err.endswith(f"{given}: no such recording; did you mean 'bags/tpose_wave'?\n")


def test_a_recording_of_quite_another_name_is_not_proposed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("looped").mkdir()
    Path("looped/looped_0.mcap").touch()
    assert cli.main(["bag", "info", "nope"]) == 2
    assert capsys.readouterr().err.endswith("nope: no such recording\n")


def test_a_recording_to_play_is_the_first_option_of_up(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["up", "--help"])
    usage = capsys.readouterr().out
    assert usage.index("[--bag BAG]") < usage.index("[--sensors")
    assert usage.index("playing and recording:") < usage.index("skeletons, calibration and people:")


@pytest.mark.parametrize(
    ("words", "sensors"),
    [
        (["--sensors", "kinect1", "--sensors", "kinect2,kinect3"], ("kinect1", "kinect2", "kinect3")),
        (["--sensors", "none"], ()),
        ([], None),
    ],
)
def test_sensors_may_be_a_list_or_repeated(words: list[str], sensors: tuple[str, ...] | None) -> None:
    assert options_from(cli.parser("up").parse_args(["up", *words])).get("sensors") == sensors


@pytest.mark.parametrize("command", ["up", "replay"])
def test_no_people_are_refused(command: str) -> None:
    """They are the option's default, which stands for the largest number."""
    words = [command, *(["bag", "-o", "out"] if command == "replay" else []), "--subject", "all"]
    assert "people" not in options_from(cli.parser(command).parse_args(words))
    words.append("--people")
    assert options_from(cli.parser(command).parse_args([*words, "2"]))["people"] == 2
    with pytest.raises(BodyTrackingError, match="people: 0, expected 1 or more"):
        options_from(cli.parser(command).parse_args([*words, "0"]))


TAKEN = (
    ("calibrate nowhere -o taken.yaml", "taken.yaml"),
    ("evaluate nowhere --save-mountings taken.yaml", "taken.yaml"),
    ("import nowhere.csv -o taken", "taken"),
    ("markers angles nowhere --setup nowhere -o taken", "taken"),
    ("markers render -o taken --setup setup", "taken"),
    ("markers render -o new --setup setup", "setup/rig.yaml"),
    ("mesh personalise nowhere -o taken.yaml", "taken.yaml"),
    ("replay nowhere -o taken", "taken"),
    ("simulate -o taken", "taken"),
    ("simulate baseline arm -o .", "trial1"),
)
"""Commands that write data, and an output that exists already."""


@pytest.mark.parametrize(("words", "output"), TAKEN, ids=[words.partition(" -")[0] for words, _ in TAKEN])
def test_data_are_replaced_only_where_the_command_says_so(
    words: str, output: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / output
    path.parent.mkdir(exist_ok=True)
    if path.suffix:
        path.write_text("mine", encoding="utf-8")
    else:
        BagWriter(path).close()
    before = {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()}
    assert cli.main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and said.endswith(f"{output}: exists already; --overwrite replaces it\n")
    assert {each: each.read_bytes() for each in tmp_path.rglob("*") if each.is_file()} == before
    with pytest.raises(SystemExit):
        cli.main([*words.partition(" -")[0].split(), "--help"])
    assert "--overwrite" in capsys.readouterr().out


@pytest.mark.parametrize("there", [False, True])
def test_ctrl_c_says_what_became_of_the_output(
    there: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "parser", lambda command: Interrupted())
    if there:
        (tmp_path / "out").mkdir()
    assert cli.main(["replay", "bag", "-o", "out"]) == 130
    left = "" if there else "; out was not written"
    assert capsys.readouterr().err == f"body_tracking: interrupted{left}\n"


class Interrupted:
    """A parser of a command that ends with Ctrl-C."""

    def parse_args(self, arguments: list[str]) -> argparse.Namespace:
        return argparse.Namespace(output=Path("out"), run=self.run)

    def run(self, args: argparse.Namespace) -> int:
        raise KeyboardInterrupt


def test_closed_stdout_is_no_error() -> None:
    command = [sys.executable, "-m", "body_tracking.cli", "bag", "info", "--json", str(ROOT / "bags" / "tpose_wave")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.wait(30.0) in (0, 141)
        assert process.stderr.read() == b""


def test_python_runs_the_package_as_the_command() -> None:
    found = [
        subprocess.run(
            [sys.executable, "-m", module, "bag", "info", "nowhere"], capture_output=True, text=True, timeout=60
        )
        for module in ("body_tracking", "body_tracking.cli")
    ]
    assert found[0].returncode == found[1].returncode == 2
    assert found[0].stderr == found[1].stderr != ""


@pytest.mark.parametrize("command", ["call", "doctor"])
def test_help_loads_neither_numpy_nor_the_client_library(command: str) -> None:
    code = f"""
import sys
from body_tracking import cli
try:
    cli.main([{command!r}, "--help"])
except SystemExit:
    print(sorted({{"numpy", "rclpy", "scipy"}} & sys.modules.keys()))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


NUMERIC_THREADS = """
import os, sys
from body_tracking import cli
sys.argv = ["body_tracking", "--version"]
try:
    cli.main()
except SystemExit:
    print(os.environ["OPENBLAS_NUM_THREADS"], len(os.listdir("/proc/self/task")))
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="the system does not list threads")
def test_command_computes_in_one_thread_by_default() -> None:
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    said = [
        subprocess.run(
            [sys.executable, "-c", NUMERIC_THREADS], env=env, capture_output=True, text=True, timeout=60, check=True
        ).stdout.split()[-2:]
        for env in (environment, environment | {"OPENBLAS_NUM_THREADS": "2"})
    ]
    assert said[0] == ["1", "1"]
    assert said[1][0] == "2"

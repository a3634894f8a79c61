"""README.md and the pages in ``docs/``: every command in them runs, or states why not.

The rule: blocks fenced as ``sh`` of a page are run one after the other, by bash, in a folder that has everything of
the repository (and nothing of the page before; of one recording, its first 4 s), and must all end with exit code 0. A
block that needs a device, ROS's own ``ros2``, or more time than a test has begins with the line ``# needs hardware:
...``, ``# needs ROS: ...`` or ``# takes long: ...``. A block of another language that begins with ``# name.ext`` is
written to that file first, so that commands can use it.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from domains import domain
from draws import ALL

pytest.importorskip("rclpy", reason="ROS is not installed")

ROOT = Path(__file__).resolve().parent.parent
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
MARK = re.compile(r"# (needs hardware|needs ROS|takes long): \S")
FILE = re.compile(r"# ([\w-]+\.\w+)\n")
TIMEOUT = 300.0
"""Seconds for a page on a busy machine; they take some ten together on an idle one."""


def blocks(page: Path) -> list[tuple[str, str]]:
    """(language, text) of each fenced block."""
    return FENCE.findall(page.read_text(encoding="utf-8"))


def commands(page: Path) -> list[str]:
    """The commands of a page that are to be run."""
    return [text for language, text in blocks(page) if language == "sh" and not MARK.match(text)]


ALONE = {"troubleshooting": pytest.mark.alone}
"""doctor reports problems on a machine with other load."""
SLOW = dict.fromkeys(("reading_uncertainty", "recordings", "choosing_a_filter", "markers"), pytest.mark.slow)
"""Most of their commands are also those of the README, or they compute on images for long."""


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.stem, marks=[marks[page.stem] for marks in (ALONE, SLOW) if page.stem in marks])
        for page in PAGES
        if commands(page)
    ],
)
def test_commands_of_the_documentation_work(page: Path, tmp_path: Path, t_pose: Path) -> None:
    for item in ROOT.iterdir():
        if not item.name.startswith(".") and item.name != "bags":
            (tmp_path / item.name).symlink_to(item)
    (tmp_path / "bags").mkdir()
    for bag in (ROOT / "bags").iterdir():
        short = bag.name == "tpose_wave" and not ALL
        (tmp_path / "bags" / bag.name).symlink_to(t_pose if short else bag)
    for language, text in blocks(page):
        name = FILE.match(text)
        if language != "sh" and name:
            (tmp_path / name[1]).write_text(text, encoding="utf-8")
    # `body_tracking` and `python` are this Python's, whatever is installed
    tools = tmp_path / ".bin"
    tools.mkdir()
    for tool, arguments in (("body_tracking", "-m body_tracking.cli"), ("python", "")):
        (tools / tool).write_text(f'#!/bin/sh\nexec "{sys.executable}" {arguments} "$@"\n', encoding="utf-8")
        (tools / tool).chmod(0o755)
    environment = {
        **os.environ,
        "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
        "PYTHONPATH": str(ROOT),
        "ROS_DOMAIN_ID": str(domain()),
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        "ROS_LOG_DIR": str(tmp_path / "log"),
        "MPLBACKEND": "Agg",
    }
    output = tmp_path / "output.txt"
    for text in commands(page):
        with output.open("wb") as file:
            process = subprocess.Popen(
                ["bash", "-euo", "pipefail", "-c", text],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=tmp_path,
                env=environment,
                process_group=0,
            )
            try:
                code = process.wait(TIMEOUT)
            finally:
                # with background processes of the page
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
        assert code == 0, f"{page.name}: exit code {code} of\n{text}\n{output.read_text(errors='replace')}"


def test_commands_are_listed_in_one_style() -> None:
    text = (ROOT / "docs" / "reference.md").read_text()
    said = re.findall(r"^\| `body_tracking [^`]+` \| (.*) \|$", text, re.MULTILINE)
    assert len(said) > 20 and not [line for line in said if not line[0].islower() or line.endswith(".")]


def test_skipped_commands_state_a_reason() -> None:
    """Otherwise a misspelt mark would skip a block."""
    for page in PAGES:
        for language, text in blocks(page):
            first = text.partition("\n")[0]
            assert language != "sh" or MARK.match(text) or not first.startswith(("# need", "# take")), (
                page.name,
                first,
            )
            assert language not in ("bash", "shell", "console"), f"{page.name}: fence commands as sh"

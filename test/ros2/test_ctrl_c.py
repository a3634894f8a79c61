"""Ctrl-C in the terminal in which ``ros2 launch`` runs: nothing of Python is printed, nothing runs on."""

from __future__ import annotations

import os
import pty
import select
import subprocess
import time
from pathlib import Path

import pytest
from tools import kill, members

from body_tracking.recording.rosbag2 import BagReader
from domains import domain
from draws import some

CTRL_C = b"\x03"
IN_TERMINAL = (
    "import fcntl, os, sys, termios; fcntl.ioctl(0, termios.TIOCSCTTY, 0); os.execvp(sys.argv[1], sys.argv[1:])"
)
"""Makes the standard input the controlling terminal of the session, as a shell does."""
MOMENTS = (0.3, 0.5, 0.8, 1.1, 1.4, 1.8, 2.4, 3.5, 5.0, 8.0)
"""Seconds from the start of the last process, while nodes import, find each other and work.

Earlier, launch itself has a defect: a process that a signal ends before launch has noted its start leaves launch
waiting for ever, whatever process that is (osrf_pycommon is told of the end before the beginning).
"""
STARTED = b"[bag_player-7]: process started"


def until(terminal: int, printed: list[bytes], seconds: float, text: bytes | None = None) -> bool:
    """Read the output for some seconds or until a text comes; returns whether the terminal is still open."""
    end = time.monotonic() + seconds
    while (text is None or text not in b"".join(printed)) and (left := end - time.monotonic()) > 0.0:
        if select.select([terminal], [], [], left)[0]:
            try:
                printed.append(os.read(terminal, 65536))
            except OSError:  # nobody has it open any more
                return False
    return True


@pytest.mark.parametrize("moment", some(MOMENTS[5:] + MOMENTS[:5]))
def test_ctrl_c_ends_the_launch(workspace: dict[str, str], tmp_path: Path, moment: float) -> None:
    environment = {**workspace, "ROS_DOMAIN_ID": str(domain()), "ROS_LOG_DIR": str(tmp_path / "log")}
    share = Path(workspace["AMENT_PREFIX_PATH"].split(":")[0]) / "share" / "body_tracking"
    arguments = [f"bag:={share / 'bags' / 'tpose_torso_twist'}", "record:=live", "filter:=ekf", "viewer:=true"]
    launch = ["ros2", "launch", "body_tracking", "two_kinects.launch.py", *arguments]
    terminal, theirs = pty.openpty()
    process = subprocess.Popen(
        ["python3", "-S", "-c", IN_TERMINAL, *launch],
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env=environment,
        cwd=tmp_path,
        start_new_session=True,
    )
    os.close(theirs)
    printed: list[bytes] = []
    try:
        assert until(terminal, printed, 60.0, STARTED), printed
        assert until(terminal, printed, moment), printed
        os.write(terminal, CTRL_C)
        assert not until(terminal, printed, 30.0), b"".join(printed).decode()
        code = process.wait(10.0)
        left = members(process.pid)
    finally:
        kill(process.pid)
        process.wait()
        os.close(terminal)
    text = b"".join(printed).decode()
    assert not left and code in (0, 1, 130), (left, code, text)
    for word in ("Traceback", "KeyboardInterrupt", "[ERROR]", "SIGTERM"):
        assert word not in text
    if (tmp_path / "live").exists():
        with BagReader(tmp_path / "live") as bag:
            assert bag.whole

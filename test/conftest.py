"""What all tests share: the real recordings, where they are present, and which of them start processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

# As the commands and nodes have it, before numpy is imported: BLAS adds up in another order with more threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from xdist.scheduler import LoadScopeScheduling

from body_tracking import dds

ROOT = Path(__file__).resolve().parent.parent
dds.prepare()  # what tests send is sent again as soon as what nodes send
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # so a shell without job control starts what it runs in the background, and every process would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
PROCESSES = ("nodes", "ros2", "test_cli.py", "test_docs.py", "test_package.py", "test_up.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes, which run in a phase of their own."""
    for item in items:
        if item.path.relative_to(ROOT / "test").parts[0] in PROCESSES:
            item.add_marker(pytest.mark.processes)
        if item.path.parent.name == "ros2":
            item.add_marker(pytest.mark.ros2)


class SharedNodes(LoadScopeScheduling):
    """Tests that share a module's running nodes stay together and in order on one worker, all others go anywhere."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        return file if 'scope="module"' in (ROOT / file).read_text(encoding="utf-8") else nodeid


def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> SharedNodes | None:
    """For ``--dist loadscope``."""
    return SharedNodes(config, log) if config.getvalue("dist") == "loadscope" else None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("BODY_TRACKING_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real recordings are absent ({folder}): set BODY_TRACKING_DATA to their folder")
    return folder

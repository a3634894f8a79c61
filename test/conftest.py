"""What all tests share: the real recordings, where they are present, and which of them start processes."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from body_tracking import dds

ROOT = Path(__file__).resolve().parent.parent
dds.prepare()  # what tests send is sent again as soon as what nodes send
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # so a shell without job control starts what it runs in the background, and every process would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
PROCESSES = ("nodes", "test_cli.py", "test_docs.py", "test_package.py", "test_up.py")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes and wait for them: beside those that compute they would be late."""
    for item in items:
        if item.path.relative_to(ROOT / "test").parts[0] in PROCESSES:
            item.add_marker(pytest.mark.processes)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("BODY_TRACKING_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real recordings are absent ({folder}): set BODY_TRACKING_DATA to their folder")
    return folder

"""Fixtures of all tests, such as the real recordings where present, and the marks of tests that start processes."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

# As in the commands and nodes, before numpy is imported: BLAS sums in another order with more threads.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from xdist.scheduler import LoadScopeScheduling

from body_tracking.ros import dds
from draws import ALL, draws

if TYPE_CHECKING:
    from body_tracking.messages.base import MessageTypes

ROOT = Path(__file__).resolve().parent.parent
dds.prepare()  # lost messages of tests are resent as soon as those of nodes
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # a shell without job control ignores SIGINT in background jobs, and every process would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)
PROCESSES = (
    *("nodes", "ros2", "test_cli.py", "test_docs.py", "test_fifth_system.py", "test_live_equals_offline.py"),
    *("test_examples.py", "test_package.py", "test_up.py"),
)

ONE_AT_A_TIME = {
    "ros2": ("ros2/",),
    "up": ("test_up.py", "work[README]"),
    "systems": ("test_live_equals_offline.py", "test_fifth_system.py"),
}
"""Tests that start a dozen processes each, of which one of each kind runs at a time, before all others: several would
starve each other while their nodes start."""


def _heavy(nodeid: str) -> str | None:
    return next((kind for kind, names in ONE_AT_A_TIME.items() if any(name in nodeid for name in names)), None)


def _starts_processes(path: Path) -> bool:
    return path.relative_to(ROOT / "test").parts[0] in PROCESSES


def _only_processes(config: pytest.Config) -> bool:
    expression = _expression(config)
    return "processes" in expression and "not processes" not in expression


def _expression(config: pytest.Config) -> str:
    return str(config.getoption("markexpr")).replace("slow or not slow", "")  # of test-all


def pytest_configure(config: pytest.Config) -> None:
    """Examples: one set in `make test`, so that a change is to blame when it fails; others each time in the longer one.

    Tests that start processes draw none, and each of their workers would take a third of a second to import hypothesis.
    """
    if not _only_processes(config):
        from hypothesis import settings

        settings.register_profile("busy machine", deadline=None, derandomize=not ALL, max_examples=draws(15, 100))
        settings.load_profile("busy machine")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no file that the marker expression of a phase leaves out as a whole: all of them take 8 s to import."""
    expression = _expression(config)
    if "processes" not in expression or collection_path == ROOT / "test":
        return None
    if collection_path.is_dir():  # with its conftest.py
        return True if _starts_processes(collection_path) == ("not processes" in expression) else None
    if collection_path.suffix != ".py":
        return None
    if _starts_processes(collection_path) == ("not processes" in expression):
        return True
    text = collection_path.read_text(encoding="utf-8")
    marks = next((line for line in text.splitlines() if line.startswith("pytestmark = ")), "")
    if any(f"not {name}" in expression and f"mark.{name}" in marks for name in ("alone", "slow")):
        return True
    return True if "alone" in expression and "not alone" not in expression and "mark.alone" not in text else None


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the tests that start processes, which run in a phase of their own, those that take longest first."""
    items.sort(key=lambda item: _heavy(item.nodeid) is None)
    for item in items:
        if _starts_processes(item.path):
            item.add_marker(pytest.mark.processes)
        if item.path.parent.name == "ros2":
            item.add_marker(pytest.mark.ros2)


def pytest_collection_finish() -> None:
    """Look for garbage neither in what imports have made nor often: that took 6 to 10 % of some tests' time."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000)


class SharedNodes(LoadScopeScheduling):
    """Tests that share a module's running nodes, or are heavy, stay in order on one worker; all others go anywhere."""

    def _split_scope(self, nodeid: str) -> str:
        file = nodeid.partition("::")[0]
        if heavy := _heavy(nodeid):
            return heavy
        return file if 'scope="module"' in (ROOT / file).read_text(encoding="utf-8") else nodeid


@pytest.hookimpl(optionalhook=True)  # without xdist, nobody asks
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> SharedNodes | None:
    """For ``--dist loadscope``."""
    return SharedNodes(config, log) if config.getvalue("dist") == "loadscope" else None


@pytest.fixture(autouse=True)
def own_context() -> Iterator[None]:
    """End the ROS context of a test that failed before it did: the next one could not begin its own."""

    def there() -> bool:
        rclpy = sys.modules.get("rclpy")
        return rclpy is not None and bool(rclpy.ok())

    before = there()
    yield
    if not before and there():
        sys.modules["rclpy"].try_shutdown()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings; the test is skipped where it is absent."""
    folder = Path(os.environ.get("BODY_TRACKING_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"real recordings are absent ({folder}): set BODY_TRACKING_DATA to their folder")
    return folder


@pytest.fixture(scope="module", params=["bag", "ros"])
def types(request: pytest.FixtureRequest) -> MessageTypes:
    """The message types of bags, and those of ROS where it is installed."""
    from body_tracking.messages.base import RosMessages
    from body_tracking.recording.rosbag2 import BAG_MESSAGES

    if request.param == "bag":
        return BAG_MESSAGES
    pytest.importorskip("rclpy", reason="ROS is not installed")
    return RosMessages()


def _made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], object]) -> Path:
    """A bag ``wave`` that the first worker of xdist makes, in a folder of this name, and all others read."""
    base = factory.getbasetemp()
    shared = base.parent if "PYTEST_XDIST_WORKER" in os.environ else base
    folder, partial = shared / name, shared / f"{name}.partial"
    with (shared / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            shutil.rmtree(partial, ignore_errors=True)
            partial.mkdir()
            make(partial / "wave")
            partial.rename(folder)
    return folder / "wave"


@pytest.fixture(scope="session")
def wave(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 6 s of ``bags/tpose_wave``: the T-pose and some of the wave, for laws that do not need all of it."""
    from excerpts import beginning

    return _made_once(tmp_path_factory, "excerpt", lambda bag: beginning(ROOT / "bags" / "tpose_wave", bag, 6.0))


@pytest.fixture(scope="session")
def t_pose(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first 4 s of ``wave``, for commands that need only run."""
    from excerpts import beginning

    return _made_once(tmp_path_factory, "t_pose", lambda bag: beginning(ROOT / "bags" / "tpose_wave", bag, 4.0))


@pytest.fixture(scope="session")
def replayed_wave(tmp_path_factory: pytest.TempPathFactory, wave: Path) -> Path:
    """The bag that the offline graph makes of ``wave`` with its default settings."""
    from body_tracking.recording.replay import ReplaySettings, replay

    return _made_once(tmp_path_factory, "replayed", lambda bag: replay(wave, bag, ReplaySettings(())))


@pytest.fixture(scope="session")
def loaded_ekf() -> None:
    """The extended filter's compiled code, so that forked processes need not load it, which takes each a second."""
    from body_tracking.filters.ekf.filter import prepare

    prepare()


@pytest.fixture(scope="session")
def extended_wave(tmp_path_factory: pytest.TempPathFactory, wave: Path, loaded_ekf: None) -> Path:
    """As ``replayed_wave``, with the extended filter."""
    from body_tracking.recording.replay import ReplaySettings, replay

    settings = ReplaySettings((), filter_name="ekf")
    return _made_once(tmp_path_factory, "extended", lambda bag: replay(wave, bag, settings))

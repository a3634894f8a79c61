"""Compiled functions: which machine code is cached, and when it is compiled anew."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from patience import PATIENCE

_USER = """
from body_tracking.core.compiled import compiled
from inner import OFFSET, inner

@compiled
def outer(x):
    return inner(x) + OFFSET
"""
_INNER = """
from body_tracking.core.compiled import compiled

OFFSET = {offset}

@compiled
def inner(x):
    return {factor} * x
"""
_QUIET = "from body_tracking.core import compiled; compiled.QUIET = {}"
_SCRIPT = "from outer import outer; print(outer(1.0), sum(outer.stats.cache_hits.values()))"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


def run(folder: Path, cache: Path) -> str:
    """The value of ``outer(1)`` in a new process, and whether its code came from the cache."""
    return execute(_SCRIPT, folder, cache).stdout


def execute(script: str, folder: Path, cache: Path) -> subprocess.CompletedProcess[str]:
    """A script in a new process that finds the modules of a folder."""
    path = os.pathsep.join([str(folder), *filter(None, sys.path)])
    # Python's own cache treats a file of equal size and time in seconds as unchanged
    environment = {**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, "-c", script]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=True)


def write(folder: Path, offset: float = 1.0, factor: float = 1.0) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "outer.py").write_text(_USER)
    (folder / "inner.py").write_text(_INNER.format(offset=offset, factor=factor))


def test_code_is_compiled_anew_where_what_it_imports_changed_and_only_there(tmp_path: Path, cache: Path) -> None:
    write(tmp_path / "one")
    assert run(tmp_path / "one", cache).split() == ["2.0", "0"]
    write(tmp_path / "copy")
    assert run(tmp_path / "copy", cache).split() == ["2.0", "1"]
    write(tmp_path / "one", offset=5.0)
    assert run(tmp_path / "one", cache).split() == ["6.0", "0"]
    write(tmp_path / "one", offset=5.0, factor=3.0)
    assert run(tmp_path / "one", cache).split() == ["8.0", "0"]


def test_only_the_versions_used_last_are_kept(tmp_path: Path, cache: Path) -> None:
    write(tmp_path / "one")
    for age, name in enumerate("abcdef"):
        folder = cache / "body_tracking" / "compiled" / f"inner-{name}"
        folder.mkdir(parents=True)
        os.utime(folder, (1000.0 - age, 1000.0 - age))
    run(tmp_path / "one", cache)
    left = {each.name for each in (cache / "body_tracking" / "compiled").glob("inner-*")}
    assert len(left) == 4
    assert {"inner-a", "inner-b", "inner-c"} < left


def test_without_a_folder_to_write_to_it_runs_all_the_same(tmp_path: Path) -> None:
    write(tmp_path / "one")
    (tmp_path / "file").touch()
    done = execute(f"{_QUIET.format(1000.0)}; {_SCRIPT}", tmp_path / "one", tmp_path / "file")
    assert done.stdout.split() == ["2.0", "0"]
    assert done.stderr == ""  # compiling takes less than that


def test_a_user_reads_why_a_program_waits_while_it_compiles(tmp_path: Path, cache: Path) -> None:
    write(tmp_path)
    script = f"{_QUIET.format(0.0)}; {_SCRIPT}"
    assert execute(script, tmp_path, cache).stderr.startswith("compiling loops, once for each version")
    assert execute(script, tmp_path, cache).stderr == ""  # nothing is left to compile


def test_one_process_can_compile_several_systems() -> None:
    """As it has to where there are fewer processors than systems."""
    once = "compilation._seconds('body_tracking.markers.detection:prepare')"
    command = [sys.executable, "-c", f"from body_tracking import compilation; {once}; {once}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stderr) == (0, "")

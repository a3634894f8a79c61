"""Compiled functions: which machine code is cached, and when it is compiled anew."""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from numba.core import event

from body_tracking.core import compiled
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
_SCRIPT = "from body_tracking.core import compiled; compiled.QUIET = 0.0; from outer import outer; outer(1.0)"


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path / "cache"


Run = Callable[[Path, Path], tuple[float, int]]


@pytest.fixture
def run(monkeypatch: pytest.MonkeyPatch) -> Run:
    """The value of ``outer(1)`` and how often its code came from the cache, as in a process that begins.

    That is, with both modules imported anew; a new process would first import numba.
    """
    # Python's own cache treats a file of equal size and time in seconds as unchanged
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    monkeypatch.setattr(compiled, "LOOPS", [*compiled.LOOPS])

    def anew(folder: Path, cache: Path) -> tuple[float, int]:
        with monkeypatch.context() as process:
            process.setenv("XDG_CACHE_HOME", str(cache))
            process.syspath_prepend(folder)
            process.setattr(compiled, "_digests", dict(compiled._digests))
            try:
                outer = importlib.import_module("outer").outer
                return outer(1.0), sum(outer.stats.cache_hits.values())
            finally:
                for name in ("outer", "inner"):
                    sys.modules.pop(name, None)

    return anew


def write(folder: Path, offset: float = 1.0, factor: float = 1.0) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "outer.py").write_text(_USER)
    (folder / "inner.py").write_text(_INNER.format(offset=offset, factor=factor))


def test_code_is_compiled_anew_where_what_it_imports_changed_and_only_there(
    tmp_path: Path, cache: Path, run: Run
) -> None:
    write(tmp_path / "one")
    assert run(tmp_path / "one", cache) == (2.0, 0)
    write(tmp_path / "copy")
    assert run(tmp_path / "copy", cache) == (2.0, 1)
    write(tmp_path / "one", offset=5.0)
    assert run(tmp_path / "one", cache) == (6.0, 0)
    write(tmp_path / "one", offset=5.0, factor=3.0)
    assert run(tmp_path / "one", cache) == (8.0, 0)


def test_only_the_versions_used_last_are_kept(tmp_path: Path, cache: Path, run: Run) -> None:
    write(tmp_path / "one")
    for age, name in enumerate("abcdef"):
        folder = cache / "body_tracking" / "compiled" / f"inner-{name}"
        folder.mkdir(parents=True)
        os.utime(folder, (1000.0 - age, 1000.0 - age))
    run(tmp_path / "one", cache)
    left = {each.name for each in (cache / "body_tracking" / "compiled").glob("inner-*")}
    assert len(left) == 4
    assert {"inner-a", "inner-b", "inner-c"} < left


def test_without_a_folder_to_write_to_it_runs_all_the_same(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(compiled, "QUIET", 1000.0)
    write(tmp_path / "one")
    (tmp_path / "file").touch()
    assert run(tmp_path / "one", tmp_path / "file") == (2.0, 0)
    assert capsys.readouterr().err == ""  # compiling takes less than that


def test_a_user_reads_why_a_program_waits_while_it_compiles(
    tmp_path: Path, cache: Path, run: Run, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path)
    path = os.pathsep.join([str(tmp_path), *filter(None, sys.path)])
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        # as in ``run``: it leaves no bytecode that counts as that of the changed module below
        env={**os.environ, "PYTHONPATH": path, "XDG_CACHE_HOME": str(cache), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
    )
    assert done.stderr.startswith("compiling loops, once for each version")
    monkeypatch.setattr(compiled, "QUIET", 0.0)
    with event.install_listener("numba:compile", compiled.CompilingNotice()):
        assert run(tmp_path, cache) == (2.0, 1)
        assert capsys.readouterr().err == ""  # nothing is left to compile
        write(tmp_path, offset=5.0)
        assert run(tmp_path, cache) == (6.0, 0)
        assert capsys.readouterr().err == done.stderr


def test_one_process_can_compile_several_systems() -> None:
    """As it has to where there are fewer processors than systems."""
    once = "compilation._seconds('body_tracking.markers.detection:prepare')"
    command = [sys.executable, "-c", f"from body_tracking import compilation; {once}; {once}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert (done.returncode, done.stderr) == (0, "")

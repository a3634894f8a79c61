"""``pip install`` in a few lines: a moving one on a terminal, one for each phase in a file; errors as pip prints them.

Of the standard library only, since it runs before anything is installed.

    python scripts/pip_install.py LOG ARGUMENT...
"""

from __future__ import annotations

import re
import shutil
import site
import subprocess
import sys
import threading
import time
from pathlib import Path

MEGABYTES = {"bytes": 1e-6, "kB": 1e-3, "MB": 1.0, "GB": 1e3}
_COLLECTING = re.compile(r"(?:Collecting|Processing|Obtaining) ")
_DOWNLOADING = re.compile(r"  Downloading (?:.*/)?([^\s-]+)\S* \(([\d.]+) (bytes|kB|MB|GB)\)")
_INSTALLING = re.compile(r"Installing collected packages: (.*)")
_ERROR = re.compile(r"\s*error:", re.IGNORECASE)


class Line:
    """The line of a terminal that is written again and again; a file gets only what :meth:`keep` is given."""

    def __init__(self) -> None:
        self._on = sys.stdout.isatty()

    def show(self, text: str) -> None:
        """Write over what was shown."""
        if self._on:
            print(f"\r{text[: shutil.get_terminal_size().columns - 1]}\x1b[K", end="", flush=True)

    def keep(self, text: str) -> None:
        """Write over what was shown, and go on below."""
        print(f"\r{text}\x1b[K" if self._on else text, flush=True)


class Phases:
    """What pip does, from the lines that it prints."""

    def __init__(self, line: Line) -> None:
        self._line = line
        self._packages, self._size = 0, 0.0
        self._watcher: threading.Thread | None = None
        self._done = threading.Event()

    def read(self, text: str) -> None:
        """A line that pip has printed."""
        self._packages += bool(_COLLECTING.match(text))
        collected = f"{self._packages} packages, {self._size:.0f} MB downloaded"
        if _COLLECTING.match(text):
            self._line.show(f"collecting: {collected}")
        elif match := _DOWNLOADING.match(text):
            self._line.show(f"collecting: {collected}; now {match[1]}, {match[2]} {match[3]}")
            self._size += float(match[2]) * MEGABYTES[match[3]]
        elif match := _INSTALLING.match(text):
            count = match[1].count(",") + 1
            self._line.keep(f"installing {count} packages, {self._size:.0f} MB downloaded")
            self._watcher = threading.Thread(target=self._watch, args=(count,), daemon=True)
            self._watcher.start()

    def end(self) -> None:
        """pip has ended."""
        self._done.set()
        if self._watcher is not None:
            self._watcher.join()

    def _watch(self, count: int) -> None:
        """Show how many packages are installed, which pip does not print."""
        before = _installed()
        while not self._done.wait(0.3):
            self._line.show(f"installing: {min(max(_installed() - before, 0), count)} of {count} packages")


def _installed() -> int:
    """How many packages this environment has."""
    return sum(1 for folder in site.getsitepackages() for _ in Path(folder).glob("*.dist-info/RECORD"))


def main(log: Path, arguments: list[str]) -> int:
    began, line, printed = time.monotonic(), Line(), list[str]()
    phases = Phases(line)
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--progress-bar", "off", *arguments]
    print("collecting packages", flush=True)
    with (
        log.open("w", encoding="utf-8") as file,
        subprocess.Popen(pip, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace") as process,
    ):
        assert process.stdout is not None
        for text in process.stdout:
            file.write(text)
            printed.append(text)
            phases.read(text)
        phases.end()
    if process.returncode:
        first = next((number for number, text in enumerate(printed) if _ERROR.match(text)), max(len(printed) - 20, 0))
        line.keep(f"pip failed; all that it printed is in {log}:")
        sys.stderr.writelines(text for text in printed[first:] if not text.startswith("WARNING: "))
        return process.returncode
    line.keep(f"installed in {time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main(Path(sys.argv[1]), sys.argv[2:]))
    except KeyboardInterrupt:
        sys.exit(130)

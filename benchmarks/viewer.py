"""Cost of the viewer for the graph: the delay from capture to joint angles with it, beside the delay without it.

The graph of benchmarks/latency.py with two sensors of 30 Hz runs all the time. Stretches without a viewer alternate
with stretches in which the viewer runs, in its own session, and a real browser (headless Chromium) shows it. Delays are
from just before a frame is published until its angles are received, by one clock, in one process.

The browser has no graphics card here and renders in software. So it renders few pixels (``--sharpness``) at the lowest
priority; ``cpu_percent`` is the share of a processor that it still used.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import common
import latency
import live
import numpy as np
import psutil
from playwright.sync_api import sync_playwright

from body_tracking.pipeline import graph

LIMIT = 1.10
PATIENCE_MS = 180e3
SETTLE = 2.0
"""Seconds at the beginning of each stretch that do not count."""


def yields() -> None:
    """Give this process its own session and the lowest priority."""
    os.setsid()
    os.nice(19)
    # where the scheduler groups by session (sched(7)), niceness counts only within one
    with contextlib.suppress(OSError):
        Path("/proc/self/autogroup").write_text("19", encoding="ascii")


@contextlib.contextmanager
def chromium(folder: Path) -> Iterator[Any]:
    """A persistent browser at the lowest priority; its first page is blank."""
    path = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if path is None:
        raise SystemExit("viewer: no chromium here: apt-get install chromium")
    command = [path, "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    command += [
        "--remote-debugging-port=0",
        f"--user-data-dir={folder / 'profile'}",
        "--window-size=800,600",
        "about:blank",
    ]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, preexec_fn=yields, text=True)
    assert process.stderr is not None
    try:
        address = next(match[0] for line in process.stderr if (match := re.search(r"ws://\S+", line)))
        threading.Thread(target=process.stderr.read, daemon=True).start()
        with sync_playwright() as driver:
            browser = driver.chromium.connect_over_cdp(address, timeout=PATIENCE_MS)
            yield browser.contexts[0].pages[0], psutil.Process(process.pid)
    finally:
        process.terminate()
        process.wait(20.0)


@contextlib.contextmanager
def viewer(page: Any, folder: Path, sharpness: float) -> Iterator[psutil.Process]:
    """The viewer, shown and drawn by the browser."""
    log = folder / "viewer.log"
    command = [sys.executable, "-m", "body_tracking.nodes", "viewer", "--ros-args", "-p", "port:=0"]
    with live.processes([command], log) as running:
        live.wait("viewer: it", lambda: re.search(r"http://\S+", log.read_text()) is not None, running, 120.0)
        address = re.findall(r"http://\S+", log.read_text())[0]
        page.goto(f"{address}/?fixedDpr={sharpness}", timeout=PATIENCE_MS)
        page.wait_for_function(
            "Object.values(window.__viserTestpoints?.uplots ?? {}).some(plot => plot.chart.data[0].length > 20)",
            timeout=PATIENCE_MS,
        )
        yield psutil.Process(running[0].pid)
        page.goto("about:blank")


def measure(seconds: float, pairs: int, sharpness: float) -> dict[str, Any]:
    """Alternate stretches without and with the viewer, and compare their delays."""
    streams, poses = latency.recorded()
    bench = latency.bench_of_graph("viewer_bench")
    ended = threading.Event()
    spans: dict[str, list[tuple[int, int]]] = {"off": [], "on": []}
    used: dict[str, list[float]] = {"viewer": [], "browser": []}

    def send() -> None:
        frames = itertools.takewhile(lambda _: not ended.is_set(), latency.events(streams, relays=False))
        bench.publish(frames, {graph.skeleton_topic(latency.SENSORS[0]): "graph"})

    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        stack.enter_context(live.graph_of(bench, latency.LISTENERS, poses=poses, sensors=latency.SENSORS))
        page, browser = stack.enter_context(chromium(folder))
        sending = threading.Thread(target=send, daemon=True)
        sending.start()
        stack.callback(sending.join)
        stack.callback(ended.set)

        def stretch(name: str) -> None:
            time.sleep(SETTLE)
            begin = time.perf_counter_ns()
            time.sleep(seconds)
            spans[name].append((begin, time.perf_counter_ns()))

        for number in range(pairs):
            stretch("off")
            with viewer(page, folder, sharpness) as shown:
                before = [live.cpu_seconds(each, children=True) for each in (shown, browser)]
                stretch("on")
                for name, process, had in zip(used, (shown, browser), before, strict=True):
                    taken = live.cpu_seconds(process, children=True) - had
                    used[name].append(float(taken) / (SETTLE + seconds))
            common.progress(f"stretch {number + 1} of {pairs}")
        stretch("off")
        time.sleep(0.5)
    result: dict[str, Any] = {"seconds": seconds, "pairs": pairs}
    for name, own in spans.items():
        delays = np.concatenate([bench.delays_ms("graph", *span)[0] for span in own])
        result[name] = live.percentiles(delays, "the graph", late=95)
    for key in ("median", "p95"):
        result[f"ratio_{key}"] = round(result["on"][f"{key}_ms"] / result["off"][f"{key}_ms"], 3)
    result["cpu_percent"] = {name: round(100.0 * float(np.mean(shares)), 1) for name, shares in used.items()}
    result["load"] = round(os.getloadavg()[0], 1)
    result["cores"] = os.cpu_count()
    return result


def main() -> int:
    """The command: 0, or 1 when the bar is missed."""
    parser = common.parser(__doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="of each stretch (default: %(default)g)")
    parser.add_argument("--pairs", type=int, default=4, help="stretches with the viewer (default: %(default)s)")
    parser.add_argument(
        "--sharpness", type=float, default=0.2, help="pixels that the browser draws per pixel (default: %(default)s)"
    )
    args = parser.parse_args()
    result = measure(args.seconds, args.pairs, args.sharpness)
    common.report(args, result)
    return common.verdicts(
        args, {f"{key} at most {LIMIT} times": result[f"ratio_{key}"] <= LIMIT for key in ("median", "p95")}
    )


if __name__ == "__main__":
    sys.exit(main())

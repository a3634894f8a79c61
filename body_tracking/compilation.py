"""``body_tracking compile``: compiles the loops of image processing and of the body model in advance."""

from __future__ import annotations

import argparse
import math
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor, as_completed

from body_tracking.pipeline.system import load
from body_tracking.systems import SYSTEMS


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand ``compile``."""
    text = (
        "Compiles the loops of the image processing and of the body model (filter ekf, angles of its conventions), and "
        "keeps the machine code in the user's cache folder. Otherwise the first node that needs them takes half a "
        "minute to start."
    )
    subparsers.add_parser("compile", help=text, description=text).set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """The subcommand: each system in a process of its own, since numba compiles one function at a time.

    The processes are forked: a new interpreter would run the console script of this command again.
    """
    functions = {system.name: system.prepare for system in SYSTEMS if system.prepare}
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("fork")) as pool:
        names = {pool.submit(_seconds, function): name for name, function in functions.items()}
        for done in as_completed(names):
            print(f"compiled: {names[done]}, {done.result():.1f} s", flush=True)
    return 0


def _seconds(function: str) -> float:
    """Seconds that ``module:function`` takes."""
    from body_tracking.core import compiled  # imports numba: half a second, which other commands cannot wait for

    compiled.QUIET = math.inf  # the command says itself what it does
    began = time.perf_counter()
    load(function)()
    return time.perf_counter() - began

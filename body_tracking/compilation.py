"""``body_tracking compile``: compiles the loops of image processing and of the extended filter in advance."""

from __future__ import annotations

import argparse
import time

from body_tracking.pipeline.system import load
from body_tracking.systems import SYSTEMS


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the subcommand ``compile``."""
    text = (
        "Compiles the loops of the image processing and of the filter ekf, and keeps the machine code beside the "
        "package or in the user's cache folder. Otherwise the first node that needs them takes half a minute to start."
    )
    subparsers.add_parser("compile", help=text, description=text).set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """The subcommand."""
    for system in SYSTEMS:
        if system.prepare:
            began = time.perf_counter()
            print(f"{system.name} ...", end=" ", flush=True)
            load(system.prepare)()
            print(f"{time.perf_counter() - began:.1f} s", flush=True)
    return 0

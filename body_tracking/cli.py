"""The ``body_tracking`` command: collects the subcommands, which live in the modules that do the work."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

from body_tracking.errors import BodyTrackingError

SUBCOMMANDS = {
    "import": "recording.importer",
    "bag": "recording.info",
    "replay": "recording.replay",
    "calibrate": "calibration.offline",
    "up": "up",
    "doctor": "doctor.command",
    "show": "evaluation.show",
    "evaluate": "evaluation.evaluate",
    "simulate": "simulation.bags",
}
"""In the help's order; modules of the package with ``add_parser(subparsers)``, which sets ``run`` on its parser."""


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser with all subcommands, or with one only: the others' modules need not be loaded for it."""
    top = argparse.ArgumentParser(
        prog="body_tracking",
        description="Joint angles with honest uncertainty from several sensors: recordings in, the live graph, "
        "the same chain offline.",
        epilog="body_tracking COMMAND --help says more of each.",
    )
    top.add_argument("--version", action="version", version=f"body_tracking {version('body_tracking')}")
    subparsers = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for name in [command] if command in SUBCOMMANDS else SUBCOMMANDS:
        importlib.import_module(f"body_tracking.{SUBCOMMANDS[name]}").add_parser(subparsers)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 2 with one line on stderr for anything wrong outside the program."""
    if arguments is None:
        # The program itself, not a call within another one. Matrices as small as these gain nothing by a second thread,
        # which OpenBLAS lets spin meanwhile; it has to be said before numpy is loaded, with the first subcommand.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        arguments = sys.argv[1:]
    args = parser(arguments[0] if arguments else None).parse_args(arguments)
    try:
        code: int = args.run(args)
    except BodyTrackingError as error:
        print(f"body_tracking: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except BrokenPipeError:
        # Whoever read our output has left, as `head` does; Python would complain again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return code


if __name__ == "__main__":
    sys.exit(main())

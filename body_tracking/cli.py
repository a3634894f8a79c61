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
    "import": ("recording.importer", "turn CSV recordings, NTU RGB+D .skeleton or Xsens .mvnx files into a bag"),
    "bag": ("recording.info", "look into recordings, close one that was cut off"),
    "replay": ("recording.replay", "run the whole graph offline over a bag"),
    "calibrate": ("calibration.offline", "the poses and clocks of a bag's sensors"),
    "up": ("up", "run the live graph: sensors or a bag in, joint angles out"),
    "doctor": ("doctor.command", "why nothing comes: what is wrong with the shell, the graph or a bag, and what to do"),
    "show": ("evaluation.show", "show the joint angles in a recording"),
    "evaluate": ("evaluation.evaluate", "compare what was estimated with the truth"),
    "simulate": ("simulation.bags", "people who move before simulated sensors, as a bag with the truth"),
    "make-bags": ("simulation.bags", "make the simulated recordings that are shipped in bags/"),
}
"""Of each in the help's order: the module of the package with its ``add_parser(subparsers)``, which sets ``run`` on its
parser, and what it does. The module is loaded only for its own command."""


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser of one subcommand; without one that there is, of the names of all."""
    top = argparse.ArgumentParser(
        prog="body_tracking",
        description="Joint angles with honest uncertainty from several sensors: recordings in, the live graph, "
        "the same chain offline.",
        epilog="body_tracking COMMAND --help says more of each.",
    )
    top.add_argument("--version", action="version", version=f"body_tracking {version('body_tracking')}")
    subparsers = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    if command in SUBCOMMANDS:
        module, _ = SUBCOMMANDS[command]
        importlib.import_module(f"body_tracking.{module}").add_parser(subparsers)
    else:
        for name, (_, text) in SUBCOMMANDS.items():
            subparsers.add_parser(name, help=text)
    return top


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 2 with one line on stderr for anything wrong outside the program."""
    if arguments is None:
        # The program itself, not a call within another one. Matrices as small as these gain nothing by a second thread,
        # which OpenBLAS lets spin meanwhile; it has to be said before numpy is loaded, with the first subcommand.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        arguments = sys.argv[1:]
    try:
        args = parser(arguments[0] if arguments else None).parse_args(arguments)
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

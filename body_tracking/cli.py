"""The ``body_tracking`` command: collects the subcommands of all systems."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

from body_tracking import __version__
from body_tracking.core.arguments import Parser
from body_tracking.core.errors import BodyTrackingError

if TYPE_CHECKING:
    from body_tracking.pipeline.system import Command

_MEANT = {
    "play": "up --bag BAG",
    "demo": "up --bag bags/tpose_wave --viewer",
    "record": "up --record NEW_BAG",
    "start": "up",
    "run": "up",
    "launch": "up",
    "info": "bag info BAG",
    "viewer": "view",
    "plot": "show BAG -o PNG",
}
"""Command lines for words that are no commands here."""
_FIRST = ("view", "up", "replay", "show", "calibrate", "doctor")
"""Commands that come first in the help: those of a first session."""


def subcommands() -> dict[str, Command]:
    """The subcommands by name; their modules are not loaded."""
    # loads numpy, which must not happen before main() sets OPENBLAS_NUM_THREADS
    from body_tracking.systems import COMMANDS

    return COMMANDS


def parser(command: str | None = None) -> argparse.ArgumentParser:
    """The parser of one subcommand; for an unknown or no command, one with the names of all."""
    top = Parser(
        prog="body_tracking",
        description="Joint angles with standard deviations from several sensors: the live graph, "
        "and the same chain offline over recordings.",
        epilog="body_tracking COMMAND --help prints the options of a command; body_tracking alone says what to do.",
    )
    top.meant = _MEANT
    top.add_argument("--version", action="version", version=f"body_tracking {__version__}")
    subparsers = top.add_subparsers(title="commands", metavar="COMMAND", required=True)
    commands = subcommands()
    if command in commands:
        importlib.import_module(commands[command].module).add_parser(subparsers)
    else:
        for name in dict.fromkeys((*_FIRST, *sorted(commands))):
            subparsers.add_parser(name, help=commands[name].text)
    return top


def _joined(arguments: Sequence[str]) -> Sequence[str]:
    """The arguments with the two words of a command such as ``evaluate baseline`` as one."""
    both = " ".join(arguments[:2])
    return [both, *arguments[2:]] if both in subcommands() else arguments


def main(arguments: Sequence[str] | None = None) -> int:
    """The command; returns its exit code: 2 with one line on stderr for anything wrong outside the program."""
    if arguments is None:
        # Only in our own process. Small matrices gain nothing by a second thread, and OpenBLAS's threads spin while
        # they wait. The variable has to be set before numpy is loaded, with the first subcommand.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
        arguments = sys.argv[1:]
    arguments = _joined(arguments)
    args: argparse.Namespace | None = None
    try:
        if not arguments:
            from body_tracking.ros import advice

            return advice.run()
        chosen = parser(arguments[0])
        if arguments[0].startswith("-") and len(arguments) > 1:
            chosen.error(f"{arguments[0]}: options come after the command: body_tracking COMMAND {arguments[0]} ...")
        args = chosen.parse_args(arguments)
        code: int = args.run(args)
    except BodyTrackingError as error:
        print(f"body_tracking: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        output = getattr(args, "output", None)
        left = f"; {output} was not written" if output is not None and not output.exists() else ""
        print(f"body_tracking: interrupted{left}", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output has ended, as `head` does; Python would raise again when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return code


if __name__ == "__main__":
    sys.exit(main())

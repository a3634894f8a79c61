"""The parser of the command line."""

from __future__ import annotations

import argparse
from typing import Any, NoReturn

from body_tracking.core.errors import did_you_mean


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line that names a similar choice and the command's help, instead of its usage."""

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(2, f"body_tracking: {message} (see {self.prog} --help)\n")

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As the base class; exits for an unknown argument, which argparse would leave to the outermost parser."""
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            hint = did_you_mean(unknown[0], self._option_string_actions)
            if "--bag" in self._option_string_actions and not unknown[0].startswith("-"):
                hint = f"; did you mean '--bag {unknown[0]}'?"
            self.error(f"unrecognized arguments: {' '.join(unknown)}{hint}")
        return found, unknown

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As the base class; Python 3.14 names a similar choice itself, where asked to."""
        if action.choices is not None and value not in action.choices and (hint := did_you_mean(value, action.choices)):
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{hint}")
        super()._check_value(action, value)

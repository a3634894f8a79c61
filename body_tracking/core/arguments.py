"""The parser of the command line."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NoReturn

from body_tracking.core.errors import did_you_mean


class Parser(argparse.ArgumentParser):
    """A parser whose errors are one line that names a similar choice and the command's help, instead of its usage."""

    meant: Mapping[str, str] = MappingProxyType({})
    """Command lines for words that are none of the choices."""
    about_bag = ""
    """What to do with a recording, where none is expected."""
    _given: Sequence[str] = ()

    def error(self, message: str) -> NoReturn:
        """Exit with code 2."""
        self.exit(2, f"body_tracking: {message}{self._minus(message)} (see {self.prog} --help)\n")

    def _minus(self, message: str) -> str:
        """What to write where the value of an option begins with a minus sign, which argparse takes for an option."""
        missing = re.fullmatch(r"argument (?:-\w/)?(--[\w-]+): expected one argument", message)
        if missing and missing[1] in self._given[:-1]:
            value = self._given[self._given.index(missing[1]) + 1]
            return f"; write {missing[1]}={value}" if re.match(r"-[\d.]", value) else ""
        return ""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As the base class; exits for an unknown argument, which argparse would leave to the outermost parser."""
        self._given = sys.argv[1:] if args is None else list(args)
        found, unknown = super().parse_known_args(args, namespace)
        if unknown:
            self.error(f"unrecognized arguments: {' '.join(unknown)}{self._hint(unknown[0])}")
        return found, unknown

    def _hint(self, unknown: str) -> str:
        """What may be meant by an unknown argument."""
        bare, bag = not unknown.startswith("-"), unknown.partition("=")[0] == "--bag"
        if bare and "--bag" in self._option_string_actions:
            return f"; did you mean '--bag {unknown}'?"
        if (bare or bag) and self.about_bag:
            return f"; {self.about_bag}"
        if bag and self._get_positional_actions():
            return "; the recording stands here without '--bag'"
        return did_you_mean(unknown, self._option_string_actions)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """As the base class; Python 3.14 names a similar choice itself, where asked to."""
        if action.choices is not None and value in self.meant:
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}; did you mean {self.meant[value]!r}?")
        if action.choices is not None and value not in action.choices and (hint := did_you_mean(value, action.choices)):
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}{hint}")
        if action.choices is not None and value not in action.choices and self.about_bag:
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}; {self.about_bag}")
        super()._check_value(action, value)


class SinglePath(argparse.Action):
    """Stores a path; an error where the option is given twice with different ones, of which only one could be used."""

    def __call__(
        self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, values: Any, option: str | None = None
    ) -> None:
        before = getattr(namespace, self.dest, None)
        if before is not None and before not in (self.default, values):
            raise argparse.ArgumentError(self, f"given twice: {before} and {values}")
        setattr(namespace, self.dest, values)

"""The command that installs what only a part of the package needs: an extra of ``setup.py``."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, requires


def pip_install(extra: str) -> str:
    """The command that installs an extra's libraries; it works beside a clone and beside an installed wheel."""
    try:
        given = [each.partition(";") for each in requires("body_tracking") or ()]
    except PackageNotFoundError:  # only the sources are on the path: they lie in a clone
        return f"pip install -e '.[{extra}]'"
    wanted = [library.strip() for library, _, condition in given if f'extra == "{extra}"' in condition]
    return f"pip install {' '.join(repr(each) for each in wanted)}"

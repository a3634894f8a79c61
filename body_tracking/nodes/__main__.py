"""``python -m body_tracking.nodes <executable> [--ros-args ...]`` runs a node without an installed script, for ``up``.

``python -m body_tracking.nodes parameters`` prints ``config/body_tracking.yaml``.
"""

from __future__ import annotations

import sys

from body_tracking.core.signals import hold_signals
from body_tracking.executables import start

if __name__ == "__main__":
    hold_signals()
    from body_tracking.core.errors import did_you_mean
    from body_tracking.ros.supervised import die_with_parent
    from body_tracking.systems import EXECUTABLES, config_text

    die_with_parent()
    if sys.argv[1:] == ["parameters"]:
        print(config_text(), end="")
        sys.exit(0)
    if len(sys.argv) < 2 or sys.argv[1] not in EXECUTABLES:
        hint = did_you_mean(" ".join(sys.argv[1:2]), EXECUTABLES)
        usage = f"usage: python -m body_tracking.nodes {{{','.join(EXECUTABLES)}}} [--ros-args ...]{hint}"
        print(usage, file=sys.stderr)
        sys.exit(2)
    start(sys.argv.pop(1))

"""``python -m body_tracking`` is the command ``body_tracking``, without an installed script."""

from __future__ import annotations

import sys

from body_tracking.cli import main

if __name__ == "__main__":
    sys.exit(main())

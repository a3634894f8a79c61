"""Compiled loops: see :mod:`body_tracking.core.compiled`."""

from body_tracking.core.compiled import compiled as compiled

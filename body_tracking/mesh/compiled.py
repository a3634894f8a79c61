"""Compilation of loops, as everywhere: :mod:`body_tracking.core.compiled`."""

from __future__ import annotations

from body_tracking.core.compiled import compiled as compiled

"""Counters, rates and delays of a node's messages, for its diagnostics."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from body_tracking.core.clocks import JUMP_BACK_NS
from body_tracking.core.skeleton import NANOSECONDS

GAP_NS = 50_000_000
"""Nanoseconds between two stamps of a sensor beyond which there is a gap: at 30 Hz one frame is missing."""


class Monitor:
    """Counts the messages of a node."""

    def __init__(self) -> None:
        self.totals: Counter[str] = Counter()
        self.last_reason = ""
        self.failures: Counter[str] = Counter()
        """Number of unexpected errors by callback and kind of error."""
        self._window: Counter[str] = Counter()
        self._delays_ns: list[int] = []
        self._latencies_ns: list[int] = []
        self._last_stamp: dict[str, int] = {}
        self._since = time.monotonic()

    def arrived(self, topic: str) -> None:
        """Count a message of an input."""
        self._window[f"in {topic}"] += 1
        self.totals["received"] += 1

    def message_in(self, topic: str, stamp_ns: int) -> bool:
        """Count an irregular stamp of an input; True, without a count, if time jumped back."""
        last, self._last_stamp[topic] = self._last_stamp.get(topic), stamp_ns
        if last is None:
            return False
        step = stamp_ns - last
        if step == 0:
            self.totals["repeated stamps"] += 1
        elif step < -JUMP_BACK_NS:
            return True
        elif step < 0:
            self.totals["stamps backwards"] += 1
        elif step > GAP_NS:
            self.totals["gaps"] += 1
        return False

    def message_out(self, topic: str, delay_ns: int | None = None, latency_ns: int | None = None) -> None:
        """Count a message of an output.

        Args:
            topic: its name.
            delay_ns: since the input that caused it was sent: transport and processing.
            latency_ns: since capture.
        """
        self._window[f"out {topic}"] += 1
        self.totals["published"] += 1
        if delay_ns is not None:
            self._delays_ns.append(delay_ns)
        # Stamps of a sensor that counts from its own start give no latency.
        if latency_ns is not None and abs(latency_ns) < 10 * NANOSECONDS:
            self._latencies_ns.append(latency_ns)

    def values(self) -> dict[str, object]:
        """Rates since the last call, and totals."""
        now = time.monotonic()
        elapsed, self._since = max(now - self._since, 1e-3), now
        values: dict[str, object] = {
            f"rate {name}": f"{count / elapsed:.1f}" for name, count in sorted(self._window.items())
        }
        self._window = Counter(dict.fromkeys(self._window, 0))
        for name, samples in (("delay", self._delays_ns), ("latency", self._latencies_ns)):
            if samples:
                values[f"{name} median ms"] = f"{np.median(samples) / 1e6:.2f}"
                values[f"{name} max ms"] = f"{max(samples) / 1e6:.2f}"
                samples.clear()
        values.update(self.totals)
        values |= {f"raised {where}": count for where, count in self.failures.items()}
        if self.last_reason:
            values["last malformed"] = self.last_reason
        return values

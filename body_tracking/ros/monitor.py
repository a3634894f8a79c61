"""Counters, rates and delays of a node's messages, for its diagnostics."""

from __future__ import annotations

import time
from collections import Counter, deque

import numpy as np

from body_tracking.core.clocks import JUMP_BACK_NS
from body_tracking.core.skeleton import NANOSECONDS

GAP_NS = 50_000_000
"""Nanoseconds between two stamps of a sensor beyond which there is a gap: at 30 Hz one frame is missing."""

_WINDOW_S = 1.0
"""Seconds of a bag's time over which rates are averaged: a second of a slow playback has few frames."""
_SPANS = 20
"""Largest number of reports over which they are averaged."""


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
        self._played_ns = 0
        self._spans: deque[tuple[float, Counter[str]]] = deque(maxlen=_SPANS)

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

    def values(self, played_ns: int | None = None) -> dict[str, object]:
        """Rates since the last call, and totals.

        Args:
            played_ns: simulated time that has passed altogether, nanoseconds; rates are then per second of it. None
                for rates per second of real time.
        """
        values: dict[str, object] = {f"rate {name}": f"{rate:.1f}" for name, rate in self._rates(played_ns).items()}
        self._window = Counter(dict.fromkeys(self._window, 0))
        for name, samples in (("delay", self._delays_ns), ("latency", self._latencies_ns)):
            if samples:
                values[f"{name} median ms"] = f"{np.median(samples) / 1e6:.2f}"
                values[f"{name} max ms"] = f"{max(samples) / 1e6:.2f}"
                samples.clear()
        values.update(self.totals)
        failures = dict(self.failures)  # a source's thread changes it
        values |= {f"raised {where}": count for where, count in failures.items()}
        if self.last_reason:
            values["last malformed"] = self.last_reason
        return values

    def _rates(self, played_ns: int | None) -> dict[str, float]:
        """Rates by flow, hertz; of a bag over its last second, zero where nothing was played since the last call."""
        now = time.monotonic()
        elapsed, self._since = max(now - self._since, 1e-3), now
        if played_ns is not None:
            played, self._played_ns = (played_ns - self._played_ns) / NANOSECONDS, played_ns
            if played > 0.0:
                while sum(seconds for seconds, _ in list(self._spans)[1:]) + played >= _WINDOW_S and self._spans:
                    self._spans.popleft()
                self._spans.append((played, self._window))
                elapsed = sum(seconds for seconds, _ in self._spans)
                counts = sum((count for _, count in self._spans), Counter[str]())
                return {name: counts[name] / elapsed for name in sorted(self._window)}
            self._spans.clear()
        return {name: count / elapsed for name, count in sorted(self._window.items())}

"""Sets of simultaneous frames of several cameras."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from typing import Final, Generic, TypeVar

Frame = TypeVar("Frame")
_KEPT: Final = 64
"""Largest number of incomplete sets kept; older ones are dropped."""
_RECENT, _MANY = 30, 10
"""Number of recent sets that :meth:`FrameSets.problem` examines, and how many of them must lack a camera."""
_SILENT_NS: Final = 500_000_000
"""Time without a frame of a camera, while others send, after which it counts as silent, nanoseconds."""


class FrameSets(Generic[Frame]):
    """Collects frames of synchronised cameras in sets of equal stamps.

    Args:
        cameras: names.
        tolerance_ns: largest difference of stamps within a set, nanoseconds.
        max_wait_ns: longest wait of a set for its missing frames, nanoseconds, by the clock of :meth:`push`.

    Attributes:
        incomplete: number of sets returned or dropped with a frame missing.
        late: number of frames that arrived after their set.
    """

    def __init__(self, cameras: Sequence[str], tolerance_ns: int, max_wait_ns: int) -> None:
        self._cameras = tuple(cameras)
        self._tolerance_ns, self._max_wait_ns = tolerance_ns, max_wait_ns
        self._open: list[tuple[int, int, dict[str, Frame]]] = []  # stamp, arrival of the first, frames
        self._last_ns: int | None = None
        self.incomplete = self.late = 0
        self._recent: deque[tuple[str, ...]] = deque(maxlen=_RECENT)  # the cameras that each set lacked
        self._newest: dict[str, tuple[int, int]] = {}  # stamp and arrival

    def push(self, camera: str, stamp_ns: int, frame: Frame, now_ns: int) -> list[dict[str, Frame]]:
        """Add a frame; returns the sets that it completes, in the order of their stamps."""
        self._newest[camera] = stamp_ns, now_ns
        if self._last_ns is not None and stamp_ns <= self._last_ns + self._tolerance_ns:
            self.late += 1
            return []
        for stamp, _, frames in self._open:
            if abs(stamp - stamp_ns) <= self._tolerance_ns and camera not in frames:
                frames[camera] = frame
                break
        else:
            self._open.append((stamp_ns, now_ns, {camera: frame}))
            self._open.sort(key=lambda each: each[0])
        complete = [k for k, (_, _, frames) in enumerate(self._open) if len(frames) == len(self._cameras)]
        # cameras send in order, so sets older than a complete one stay incomplete
        return self._give(complete[-1] + 1 if complete else max(0, len(self._open) - _KEPT))

    def poll(self, now_ns: int) -> list[dict[str, Frame]]:
        """Return the sets whose wait has expired."""
        waited = [k for k, (_, arrival, _) in enumerate(self._open) if now_ns - arrival >= self._max_wait_ns]
        return self._give(waited[-1] + 1 if waited else 0)

    @property
    def deadline_ns(self) -> int | None:
        """When the wait of the next set expires; None if no set waits."""
        if not self._open:
            return None
        return min(arrival for _, arrival, _ in self._open) + self._max_wait_ns

    def problem(self) -> str:
        """Name a camera that many of the latest sets lack, and why; empty if there is none."""
        # ignore sets that lack most cameras: there the present camera is the one out of step
        few = [cameras for cameras in self._recent if 2 * len(cameras) <= len(self._cameras)]
        lacking = Counter(camera for cameras in few for camera in cameras)
        often = [camera for camera in self._cameras if lacking[camera] >= _MANY]
        if not often:
            return ""
        late = often[-1]  # where two cameras lack each other, the first is the reference
        count = f"{late} lacks in {lacking[late]} of {len(self._recent)} sets of images"
        other = next((camera for camera in self._cameras if camera != late and camera in self._newest), None)
        if late not in self._newest or other is None:
            return f"{count}: nothing comes from it"
        (stamp, arrival), (other_stamp, other_arrival) = self._newest[late], self._newest[other]
        if other_arrival - arrival > _SILENT_NS:
            return f"{count}: nothing has come from it for {(other_arrival - arrival) / 1e9:.1f} s"
        with_it = [cameras for cameras in self._recent if late not in cameras]
        if with_it and not any(with_it):
            return f"{count}: some of its images do not come"
        apart = (stamp - other_stamp) / 1e6
        return f"{count}: its stamps are {abs(apart):.1f} ms {'after' if apart > 0 else 'before'} those of {other}"

    def reset(self) -> None:
        """Forget all frames."""
        self._open.clear()
        self._recent.clear()
        self._newest.clear()
        self._last_ns = None

    def _give(self, count: int) -> list[dict[str, Frame]]:
        given, self._open = self._open[:count], self._open[count:]
        if given:
            self._last_ns = given[-1][0]
        self._recent.extend(tuple(c for c in self._cameras if c not in frames) for _, _, frames in given)
        self.incomplete += sum(len(frames) < len(self._cameras) for _, _, frames in given)
        return [frames for _, _, frames in given if len(frames) > 1]

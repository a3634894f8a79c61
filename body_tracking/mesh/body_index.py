"""Body-index images for depth images: pairing by stamp, and selection of the person's body."""

from __future__ import annotations

from collections import Counter, deque
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from body_tracking.core.skeleton import NANOSECONDS, BoolArray, SingleArray
from body_tracking.mesh.depth import DepthError

NO_BODY: Final = 255
"""Pixel of a body-index image that belongs to nobody (Kinect SDK 2.0)."""
_STRAY: Final = 0.05
"""Share of the largest body's pixels, below which a body is discarded as stray pixels."""
_NEAR: Final = 0.3
"""Share of a body's pixels near the predicted mesh, above which it may be the person; excludes somebody who walks in
front of the person."""
_WAIT_NS: Final = NANOSECONDS // 20
"""Longest wait of a depth image for its body-index image."""
_SENT_NS: Final = NANOSECONDS
"""Largest difference of stamps at which a sensor still counts as sending body-index images."""
_MAX_MISSES: Final = 10
"""Consecutive depth images without a body-index image, after which the wait is disabled."""
_KEPT: Final = 64
"""Largest number of body-index images kept for their depth images; 14 MB for a Kinect v2."""

IndexArray = NDArray[np.uint8]


def of_body_index(
    index: IndexArray, depth: SingleArray, near: BoolArray | None = None, choice: int = 0
) -> tuple[BoolArray, int | None]:
    """Mask of the person in a body-index image, and the person's number there.

    Args:
        index: (height, width) number of the body at each pixel, 255 for none.
        depth: (height, width) metres, 0 where missing.
        near: (height, width) pixels near the predicted mesh: the body with most of them is taken, whatever its number
            was before. None if nobody was tracked: the body with most pixels is taken.
        choice: without ``near``, rank of the body to take, the largest first; wraps around after the last one.

    Returns:
        The mask, and the number; None if nobody is visible.

    Raises:
        DepthError: the two images differ in size.
    """
    if index.shape != depth.shape:
        raise DepthError(f"body-index image of {_size(index)} for a depth image of {_size(depth)} pixels")
    there = (index != NO_BODY) & (depth > 0.0)
    counts = np.bincount(index[there], minlength=NO_BODY)
    if near is not None:
        close = np.bincount(index[there & near], minlength=NO_BODY)
        close[close < _NEAR * counts] = 0
        body = int(np.argmax(close)) if close.any() else None
    else:
        bodies = np.flatnonzero(counts > _STRAY * counts.max(initial=0))
        largest = bodies[np.argsort(-counts[bodies], kind="stable")]
        body = int(largest[choice % len(largest)]) if len(largest) else None
    return (np.zeros(depth.shape, np.bool_) if body is None else there & (index == body)), body


def _size(image: NDArray[np.generic]) -> str:
    return f"{image.shape[1]} x {image.shape[0]}"


class Pair(NamedTuple):
    """A depth image, and the body-index image with its stamp and size if there is one."""

    stamp_ns: int
    depth: SingleArray
    bodies: IndexArray | None


class IndexPairs:
    """Pairs the depth images of a sensor with body-index images of equal stamps, in either order of arrival.

    A depth image waits only while the sensor sends matching body-index images; else it is returned at once.

    Args:
        topic: of the body-index images, for :attr:`problem`.
        counters: of images by outcome.
    """

    def __init__(self, topic: str, counters: Counter[str]) -> None:
        self._topic, self._counters = topic, counters
        self._waiting: deque[tuple[int, SingleArray, int]] = deque()
        self._bad = ""
        self._newest_ns: int | None = None
        self.forget_indices()

    def add_depth(self, stamp_ns: int, depth: SingleArray, now_ns: int) -> None:
        """Add a depth image; ``now_ns`` is its arrival, by the clock of :meth:`next`."""
        self._waiting.append((stamp_ns, depth, now_ns))

    def add_index(self, stamp_ns: int, index: IndexArray) -> None:
        """Add a body-index image."""
        self._newest_ns = stamp_ns
        if stamp_ns in self._unpaired:
            # its depth image has been returned already
            self._counters["body-index images that came too late"] += 1
            self._misses = 0
            return
        self._indices[stamp_ns] = index
        if len(self._indices) > _KEPT:
            self._give_up(next(iter(self._indices)))

    def refuse(self) -> None:
        """Note a body-index image that could not be decoded."""
        self._counters["body-index images of another encoding"] += 1
        self._bad = f"{self._topic}: not mono8"

    def next(self, now_ns: int) -> Pair | None:
        """The next depth image that need not wait; None if there is none."""
        if not self._waiting:
            return None
        stamp_ns, depth, since_ns = self._waiting[0]
        index, sent = self._indices.pop(stamp_ns, None), self._is_sent(stamp_ns)
        comes = sent and self._newest_ns is not None and self._newest_ns < stamp_ns and self._misses < _MAX_MISSES
        if index is None and comes and now_ns - since_ns < _WAIT_NS:
            return None
        self._waiting.popleft()
        for other_ns in [each for each in self._indices if each < stamp_ns]:
            self._give_up(other_ns)
        if index is None:
            self._unpaired.append(stamp_ns)
            if sent:
                self._misses += 1
                self._counters["images without a body index"] += 1
            return Pair(stamp_ns, depth, None)
        self._misses = 0
        if index.shape != depth.shape:
            self._counters["body-index images of another size"] += 1
            self._bad = f"{self._topic}: {_size(index)} pixels, the depth image has {_size(depth)}"
            return Pair(stamp_ns, depth, None)
        self._counters["images with a body index"] += 1
        self._bad = ""
        return Pair(stamp_ns, depth, index)

    @property
    def deadline_ns(self) -> int | None:
        """When the wait of the next depth image expires; None if none waits."""
        return self._waiting[0][2] + _WAIT_NS if self._waiting else None

    @property
    def problem(self) -> str:
        """Why body-index images are not used; "" if they are, or if there are none."""
        if not self._bad and self._misses >= _MAX_MISSES:
            return f"{self._topic}: none has the stamp of one of the last {self._misses} depth images"
        return self._bad

    def forget_depth(self) -> None:
        """Drop the waiting depth images."""
        self._waiting.clear()

    def forget_indices(self) -> None:
        """Drop the body-index images, e.g. after a backward jump of their time."""
        self._indices: dict[int, IndexArray] = {}
        self._unpaired: deque[int] = deque(maxlen=_KEPT)
        self._newest_ns = None
        self._misses = 0

    def _is_sent(self, stamp_ns: int) -> bool:
        return self._newest_ns is not None and abs(stamp_ns - self._newest_ns) < _SENT_NS

    def _give_up(self, stamp_ns: int) -> None:
        del self._indices[stamp_ns]
        self._counters["body-index images of another stamp"] += 1

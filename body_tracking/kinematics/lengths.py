"""How long a person's segments are, from the distances between the points of many frames.

Independent of the pose that a filter or a fit believes in: a wrong pose spoils no length here. :class:`SegmentLengths`
gathers what sensors show; :class:`SkeletonLengths` is for who has filtered skeletons and asks after every frame.

What a sensor shows of one bone differs from pose to pose by a tenth and more, for seconds, and these errors are by far
the greatest; averaging frames as if each were new would soon be sure of a wrong length. Therefore

- frames are gathered into blocks of a second (longer where there are few); the mean squared distances in a block, less
  what white noise adds to them, tell its lengths. Frames far from the block's median do not count;
- over the blocks a mean is taken that single strange poses do not move (Huber 1964), each weighed by how much the
  sensors' points are weights by the measurement model: a body seen from the side is not seen well;
- its variance is that of the blocks: the part that two interleaved halves of a block do not share is white and
  averages out from block to block, the rest persists from pose to pose and averages out that much more slowly;
- and all is weighed against how people differ in their proportions, left hardly from right.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from body_tracking.core.measurement import BASE_STDDEV, INFERRED_FACTOR
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, IntArray, Joint
from body_tracking.kinematics.upper_body import LENGTHS, UpperBody

_BLOCK_NS = NANOSECONDS
_MIN_FRAMES = 4
"""Frames from which on a block counts: two for each of its halves."""
_MAX_BLOCK_NS = 4 * _BLOCK_NS
"""What a block waits for these."""
_OUTLIER = 4.0
"""Standard deviations from the median of a block from which a frame does not count in it."""
_HUBER = 1.345
"""Huber's constant of 95 % efficiency."""
_EFFICIENCY = 0.95
_ITERATIONS = 8
_MAD_TO_STDDEV = 1.4826
"""Standard deviation of normal deviates over the median of their sizes."""
_PRIOR_BLOCKS = 3.0
"""Blocks that what is stated of the slow errors is weights against their observed spread."""
_MIN_STDDEV = 1e-5
"""Metres: standard deviation that no length falls below, so that covariances stay invertible."""
_MIN_LENGTH = 0.005
"""Metres: nothing is shorter."""
_STATURE_SHARE, _PROPORTION_SHARE, _SIDE_SHARE = 0.04, 0.08, 0.02
"""Standard deviations by which lengths differ from the average: all alike, each kind, left from right."""
_MIN_SCALE = 0.08
"""Metres: shorter lengths differ as if they were as long as this, because sensors place these points so."""
_MIN_SIZE, _MAX_SIZE = 0.5, 1.4
"""Of a person against one of average stature."""

_MODEL: Final = UpperBody()
_DEFAULT: Final = _MODEL.default_lengths()


def proportions() -> FloatArray:
    """(21, 21) square metres: how people differ in their lengths; left and right of one person hardly do."""
    kinds = [name.removesuffix("_left").removesuffix("_right") for name in LENGTHS]
    same = np.array([[a == b for b in kinds] for a in kinds])
    relative = _STATURE_SHARE**2 + _PROPORTION_SHARE**2 * same + _SIDE_SHARE**2 * np.eye(len(LENGTHS))
    scale = np.maximum(_DEFAULT, _MIN_SCALE)
    result: FloatArray = relative * np.outer(scale, scale)
    return result


def _ends() -> dict[str, tuple[Joint, Joint]]:
    """The two points between which each length shows; the model's hand tip and thumb hang on the wrist."""
    found = {
        "lower_trunk": (Joint.SPINE_BASE, Joint.SPINE_MID),
        "upper_trunk": (Joint.SPINE_MID, Joint.SPINE_SHOULDER),
        "neck": (Joint.SPINE_SHOULDER, Joint.NECK),
        "head": (Joint.NECK, Joint.HEAD),
        "hip_drop": (Joint.SPINE_BASE, Joint.HIP_LEFT),
    }
    for side in ("LEFT", "RIGHT"):
        own = {kind: Joint[f"{kind}_{side}"] for kind in ("SHOULDER", "ELBOW", "WRIST", "HAND", "THUMB", "HIP")}
        pairs = {
            "clavicle": (Joint.SPINE_SHOULDER, own["SHOULDER"]),
            "upper_arm": (own["SHOULDER"], own["ELBOW"]),
            "forearm": (own["ELBOW"], own["WRIST"]),
            "hand": (own["WRIST"], own["HAND"]),
            "hand_tip": (own["WRIST"], Joint[f"HAND_TIP_{side}"]),
            "thumb_along": (own["WRIST"], own["THUMB"]),
            "thumb_out": (own["WRIST"], own["THUMB"]),
            "hip_width": (Joint.SPINE_BASE, own["HIP"]),
        }
        found |= {f"{kind}_{side.lower()}": pair for kind, pair in pairs.items()}
    return found


_ENDS: Final = _ends()
_POINT: Final = {Joint(joint): number for number, joint in enumerate(_MODEL.joints)}
_SIDES: Final = ("left", "right")


def _scalar_products() -> tuple[tuple[str, ...], IntArray]:
    """Names (k,) and points (4, k) a, b, c, d of the scalar products (b - a) . (d - c) that tell all lengths."""
    rows: dict[str, tuple[Joint, Joint, Joint, Joint]] = {}
    for name, (a, b) in _ENDS.items():
        if not name.startswith(("thumb_out", "hip_drop")):
            rows[name] = (a, b, a, b)
    rows["hips"] = (Joint.HIP_RIGHT, Joint.HIP_LEFT) * 2
    for side, other in (_SIDES, _SIDES[::-1]):
        wrist, tip = _ENDS[f"hand_tip_{side}"]
        rows[f"thumb_tip_{side}"] = (*_ENDS[f"thumb_along_{side}"], wrist, tip)
        rows[f"hip_across_{side}"] = (
            *_ENDS[f"hip_width_{side}"],
            Joint[f"HIP_{other.upper()}"],
            Joint[f"HIP_{side.upper()}"],
        )
    return tuple(rows), np.array([[_POINT[joint] for joint in row] for row in rows.values()], dtype=np.intp).T


_PRODUCTS, _FACTORS = _scalar_products()
_COLUMN: Final = {name: number for number, name in enumerate(_PRODUCTS)}


def _noise() -> FloatArray:
    """(k, 19) by how much white noise of unit variance of each point raises each product."""
    first, second = np.zeros((2, len(_PRODUCTS), len(_POINT)))
    rows = np.arange(len(_PRODUCTS))
    a, b, c, d = _FACTORS
    first[rows, b] += 1.0
    first[rows, a] -= 1.0
    second[rows, d] += 1.0
    second[rows, c] -= 1.0
    result: FloatArray = 3.0 * first * second
    return result


_NOISE_GAIN: Final = _noise()
_SHARES: Final = np.array(
    [[float(joint in _ENDS[name]) for joint in _POINT] for name in LENGTHS]  # (21, 19)
)
_INVOLVED: Final = np.array(
    [[float(point in column) for point in range(len(_POINT))] for column in _FACTORS.T]  # (k, 19)
)
_LIMB: Final = np.array([name.startswith(("upper_arm", "forearm")) for name in LENGTHS])
_MIRRORED: Final = {"left": "right", "right": "left"}
_OTHER_SIDE: Final = np.array(
    [LENGTHS.index("_".join(_MIRRORED.get(part, part) for part in name.split("_"))) for name in LENGTHS], dtype=np.intp
)
_NO_NOISE: Final = np.zeros(len(_POINT))
_UNSEEN: Final = (INFERRED_FACTOR * BASE_STDDEV[_MODEL.joints]) ** 2
"""(19,) square metres: what a point that was not seen in a frame counts for in the weights of its block."""
_FOLLOW_TIME = 1.0
"""Seconds in which lengths that are told after every frame follow what the blocks say."""
_SKELETONS_MEMORY = 60
"""Blocks: who takes the place of another person, unnoticed, has their own lengths after half of it."""


def _lengths_of(products: FloatArray) -> FloatArray:
    """(..., 21) metres from (..., k) products in square metres."""
    of = {name: products[..., column] for name, column in _COLUMN.items()}

    def root(square: FloatArray) -> FloatArray:
        result: FloatArray = np.sqrt(np.maximum(square, _MIN_LENGTH**2))
        return result

    across = root(of["hips"])
    found: dict[str, FloatArray] = {}
    drops = []
    for side in _SIDES:
        tip = root(of[f"hand_tip_{side}"])
        hand = root(of[f"hand_{side}"])
        along = np.maximum(of[f"thumb_tip_{side}"] / tip, _MIN_LENGTH)
        width = np.maximum(of[f"hip_across_{side}"] / across, _MIN_LENGTH)
        found[f"hand_{side}"] = hand
        found[f"hand_tip_{side}"] = np.maximum(tip - hand, _MIN_LENGTH)
        found[f"thumb_along_{side}"] = along
        found[f"thumb_out_{side}"] = root(of[f"thumb_along_{side}"] - along**2)
        found[f"hip_width_{side}"] = width
        drops.append(of[f"hip_width_{side}"] - width**2)
    found["hip_drop"] = root(0.5 * (drops[0] + drops[1]))
    return np.stack([found[name] if name in found else root(of[name]) for name in LENGTHS], axis=-1)


_Frame = tuple[int, FloatArray, BoolArray, FloatArray]
"""Stamp, points (19, 3), which of them count (19,), their variance by the measurement model (19,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """A second of frames of one sensor.

    Attributes:
        stamp_ns: of its first frame.
        products: (k,) square metres, less what white noise adds; NaN where not seen.
        lengths: (21,) metres.
        white: (21,) square metres: variance of the lengths by what its two interleaved halves do not share.
        slow: (21,) square metres: variance of the lengths by slow errors, as it was stated.
        model: (19,) square metres: variance of the points by the measurement model.
    """

    stamp_ns: int
    products: FloatArray
    lengths: FloatArray
    white: FloatArray
    slow: FloatArray
    model: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class LengthEstimate:
    """Lengths and what is known of them.

    Attributes:
        lengths: (21,) metres.
        covariance: (21, 21) square metres.
        seen: (21,) which of them the points showed; the others are what these and the average person make likely.
    """

    lengths: FloatArray
    covariance: FloatArray
    seen: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class SegmentLengths:
    """What was seen of a person's lengths so far; never written into.

    Attributes:
        persistence: seconds, the time constant of the autocorrelation of errors in a length.
        memory: blocks that are kept; older ones are forgotten.
        blocks: the finished blocks.
    """

    persistence: float = 3.0
    memory: int = 240
    blocks: tuple[_Block, ...] = ()
    _gathered: dict[str, tuple[_Frame, ...]] = field(default_factory=dict)

    def with_frame(
        self,
        sensor: str,
        stamp_ns: int,
        points: FloatArray,
        tracked: BoolArray,
        white: FloatArray,
        model: FloatArray,
        slow: float = 0.0,
        stretch: float = 0.0,
    ) -> SegmentLengths:
        """With one more frame; ``blocks`` is another one whenever a block is complete. Arrays are kept, not copied.

        Args:
            sensor: whose frame it is.
            stamp_ns: when it was captured.
            points: (19, 3) metres, the points of the model, in any frame.
            tracked: (19,) which of them count.
            white: (19,) square metres per axis, variance of their white noise.
            model: (19,) square metres per axis, their variance by the measurement model, which blocks are weighed by.
            slow: share of that which is known to be errors that last for seconds.
            stretch: share of their length that upper arms and forearms are wrong by, beside that (standard deviation).
        """
        frames = self._gathered.get(sensor, ())
        blocks = self.blocks
        longest = _BLOCK_NS if len(frames) >= _MIN_FRAMES else _MAX_BLOCK_NS
        if frames and not 0 <= stamp_ns - frames[0][0] < longest:
            if len(frames) >= _MIN_FRAMES:
                blocks = (*blocks, _block(frames, white, slow, stretch))[-self.memory :]
            frames = ()
        frames = (*frames, (stamp_ns, points, tracked, model))
        return SegmentLengths(self.persistence, self.memory, blocks, {**self._gathered, sensor: frames})

    def with_unfinished_block(
        self, sensor: str, white: FloatArray, slow: float = 0.0, stretch: float = 0.0
    ) -> SegmentLengths:
        """With the frames of a sensor's unfinished block as one more block, for who cannot wait for it.

        Args:
            sensor: whose block it is.
            white: see :meth:`with_frame`.
            slow: see :meth:`with_frame`.
            stretch: see :meth:`with_frame`.
        """
        frames = self._gathered.get(sensor, ())
        if not frames:
            return self
        # the first few, again and again: what they differ by among themselves is all that is known of their noise
        frames *= -(-_MIN_FRAMES // len(frames))
        blocks = (*self.blocks, _block(frames, white, slow, stretch))[-self.memory :]
        return SegmentLengths(self.persistence, self.memory, blocks, self._gathered)

    def estimate(self) -> LengthEstimate:
        """All that is known; an average person where nothing was seen."""
        prior = proportions()
        if not self.blocks:
            return LengthEstimate(_DEFAULT, prior, np.zeros(len(LENGTHS), dtype=np.bool_))
        products = np.stack([block.products for block in self.blocks])
        lengths = np.stack([block.lengths for block in self.blocks])
        seen = np.isfinite(lengths)
        count = np.maximum(seen.sum(axis=0), 1)
        model = np.stack([block.model for block in self.blocks])
        weights, total = _weights(1.0 / (model @ _SHARES.T), seen)
        white = np.stack([block.white for block in self.blocks])
        whiteness = np.nansum(white, axis=0) / count
        stated = (weights * [block.slow for block in self.blocks]).sum(axis=0) / count
        centre, off = _location(lengths, weights, np.sqrt(whiteness + stated))
        product_weights, _ = _weights(1.0 / (model @ _INVOLVED.T), np.isfinite(products))
        middle = _lengths_of(_location(products, product_weights, np.zeros(products.shape[1]))[0])
        known = np.isfinite(centre) & np.isfinite(middle)
        if not known.any():
            return LengthEstimate(_DEFAULT, prior, known)
        # variance of a block that is weights as much as one on average
        spread = (weights * off**2).sum(axis=0) / np.maximum(count - 1, 1)
        excess = np.maximum(spread - whiteness, 0.0)
        slow = (_PRIOR_BLOCKS * stated + (count - 1.0) * excess) / (_PRIOR_BLOCKS + count - 1.0)
        # the variance of a mean of blocks whose errors are as alike as they are close in time
        stamps = np.array([block.stamp_ns for block in self.blocks]) / NANOSECONDS
        alike = np.exp(-np.abs(stamps[:, None] - stamps) / self.persistence)
        roots = np.sqrt(weights)
        from_slow = slow * ((alike @ roots) * roots).sum(axis=0)
        from_white = (weights**2 * np.where(seen, whiteness, 0.0)).sum(axis=0)
        variance = (from_white + from_slow) / np.maximum(total, 1e-12) ** 2 / _EFFICIENCY + _MIN_STDDEV**2
        size = np.clip(np.median(middle[known] / _DEFAULT[known]), _MIN_SIZE, _MAX_SIZE)
        mean = size * _DEFAULT
        rows = np.flatnonzero(known)
        gain = np.linalg.solve(prior[np.ix_(rows, rows)] + np.diag(variance[rows]), prior[rows]).T
        covariance = prior - gain @ prior[rows]
        return LengthEstimate(mean + gain @ (middle - mean)[rows], 0.5 * (covariance + covariance.T), known)


class SkeletonLengths:
    """The lengths that the filtered skeletons of one person show, from the first frame on and after every one.

    Before a first block is complete, the frames so far are one. Every block can move a length by centimetres, and a
    pose that is fitted with it by degrees: the lengths go there gradually. The points count as free of white noise,
    which a filter has taken away, and no slow errors are stated: what was seen outweighs the average person.

    Attributes:
        lengths: (21,) metres; those that were never seen are the other side's, or in proportion to the others.
        stddev: (21,) metres; infinity where never seen.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._seen = SegmentLengths(memory=_SKELETONS_MEMORY)
        self._frames, self._stamp_ns = 0, 0
        self._target: FloatArray = _DEFAULT
        self.lengths: FloatArray = _DEFAULT
        self.stddev: FloatArray = np.full(len(LENGTHS), np.inf)

    def update(self, stamp_ns: int, points: FloatArray, variance: FloatArray) -> None:
        """Take one frame.

        Args:
            stamp_ns: when it was captured.
            points: (19, 3) metres, the points of the model, in any frame; NaN where not known.
            variance: (19,) square metres per axis, of the points; infinity where not known.
        """
        known: BoolArray = np.isfinite(points).all(axis=1) & np.isfinite(variance)
        model = np.where(known, variance, _UNSEEN)
        before = self._seen.blocks
        self._seen = self._seen.with_frame("", stamp_ns, points, known, _NO_NOISE, model)
        if self._seen.blocks is not before:
            self._use(self._seen.estimate())
        elif not before:
            self._use(self._seen.with_unfinished_block("", _NO_NOISE).estimate())
        elapsed = abs(stamp_ns - self._stamp_ns) / NANOSECONDS
        self._frames, self._stamp_ns = self._frames + 1, stamp_ns
        share = max(1.0 / self._frames, 1.0 - float(np.exp(-elapsed / _FOLLOW_TIME)))
        self.lengths = self.lengths + share * (self._target - self.lengths)

    def _use(self, estimate: LengthEstimate) -> None:
        seen = estimate.seen
        from_other = ~seen & seen[_OTHER_SIDE]
        self._target = np.where(from_other, estimate.lengths[_OTHER_SIDE], estimate.lengths)
        self.stddev = np.where(seen, np.sqrt(estimate.covariance.diagonal()), np.inf)


def _block(frames: tuple[_Frame, ...], white: FloatArray, slow: float, stretch: float) -> _Block:
    """What some frames say; see :meth:`SegmentLengths.with_frame` for the rest."""
    stamps, positions, counted, variances = zip(*frames, strict=True)
    points = np.where(np.stack(counted)[:, :, None], np.stack(positions), np.nan)
    model = np.mean(variances, axis=0)
    a, b, c, d = _FACTORS
    products = ((points[:, b] - points[:, a]) * (points[:, d] - points[:, c])).sum(axis=-1)
    with np.errstate(invalid="ignore"):
        middle = _nanmedian(products)
        scale = np.maximum(
            _MAD_TO_STDDEV * _nanmedian(np.abs(products - middle)), _MIN_STDDEV**2
        )  # rounding is no outlier
        products = np.where(np.abs(products - middle) <= _OUTLIER * scale, products, np.nan)
    noise = _NOISE_GAIN @ white
    whole, even, odd = (_lengths_of(_nanmean(part) - noise) for part in (products, products[::2], products[1::2]))
    seen = np.isfinite(even) & np.isfinite(odd)
    return _Block(
        stamps[0],
        _nanmean(products) - noise,
        np.where(seen, whole, np.nan),
        np.where(seen, 0.25 * (even - odd) ** 2, np.nan),
        slow * (_SHARES @ model) + _LIMB * (stretch * _DEFAULT) ** 2,
        model,
    )


def _nanmean(values: FloatArray) -> FloatArray:
    """Over the first dimension; NaN, without a warning, where at most one value is there."""
    there = np.isfinite(values)
    count = there.sum(axis=0)
    total = np.where(there, values, 0.0).sum(axis=0)
    return np.where(count > 1, total / np.maximum(count, 1), np.nan)


def _nanmedian(values: FloatArray) -> FloatArray:
    """Over the first dimension; NaN, without a warning, where no value is there."""
    ordered = np.sort(values, axis=0)  # NaN comes last
    count = np.isfinite(values).sum(axis=0)
    columns = np.arange(values.shape[1])
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, len(values) - 1)
    result: FloatArray = 0.5 * (ordered[low, columns] + ordered[high, columns])
    return result


def _weights(weights: FloatArray, seen: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Weights (n, m), 1 on average and 0 where not seen, and their sums (m,)."""
    weights = np.where(seen, weights, 0.0)
    total = weights.sum(axis=0)
    count = seen.sum(axis=0)
    return weights * count / np.where(count > 0, total, 1.0), count.astype(float)


def _location(values: FloatArray, weights: FloatArray, least: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Huber's estimate of location (m,) of values (n, m), NaN where missing, and how far (n, m) these are from it.

    What is missing is not far, and nothing farther than some times the scale.

    Args:
        values: one row per block.
        weights: (n, m) inverse variances, 1 on average.
        least: (m,) scale that a value of average weights has at least.
    """
    there = np.isfinite(values)
    filled = np.where(there, values, 0.0)
    root = np.sqrt(weights)
    centre = _nanmedian(values)
    distance = np.where(there, root * np.abs(filled - centre), np.nan)
    scale = np.maximum(np.maximum(_MAD_TO_STDDEV * _nanmedian(distance), least), 1e-12)
    for _ in range(_ITERATIONS):
        far = root * np.abs(filled - centre)
        weight = weights * np.minimum(1.0, _HUBER * scale / np.maximum(far, 1e-15))
        total = weight.sum(axis=0)
        centre = np.where(total > 0.0, (weight * filled).sum(axis=0) / np.where(total > 0.0, total, 1.0), np.nan)
    bound = _OUTLIER * scale / np.where(there, np.maximum(root, 1e-12), 1.0)
    return centre, np.where(there, np.clip(filled - centre, -bound, bound), 0.0)

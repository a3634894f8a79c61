"""Estimation of a person's segment lengths from the distances between the points of many frames.

Independent of the estimated pose. :class:`SegmentLengths` estimates from sensors' frames, :class:`SkeletonLengths` from
filtered skeletons, after every frame. :class:`LengthChanges` decides when to publish them.

A sensor's error of a length depends on the pose, is a tenth of the length and more, and lasts for seconds. Frames are
therefore not independent:

- Frames are gathered into blocks of a second (longer where there are few). A block's lengths follow from its mean
  squared distances less the variance of the white noise. Frames far from the block's median are outliers.
- Huber's estimate of location (Huber 1964) combines the blocks, weighted by the inverse variance of their points by the
  measurement model.
- Its variance has two parts. The difference between two interleaved halves of a block is white and averages out from
  block to block; the rest of the blocks' spread is correlated over time and averages out more slowly.
- The prior is the distribution of people's proportions, with a high correlation between left and right.
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
"""Least frames of a block: two for each of its halves."""
_MAX_BLOCK_NS = 4 * _BLOCK_NS
"""Longest block, where frames are few."""
_OUTLIER = 4.0
"""Standard deviations from the block's median beyond which a frame is an outlier."""
_HUBER = 1.345
"""Huber's constant of 95 % efficiency."""
_EFFICIENCY = 0.95
_ITERATIONS = 8
_MAD_TO_STDDEV = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
_PRIOR_BLOCKS = 3.0
"""Weight of the stated variance of slow errors against the observed spread, in blocks."""
_MIN_STDDEV = 1e-5
"""Metres: least standard deviation of a length, so that covariances stay invertible."""
MIN_LENGTH = 0.005
"""Metres: no length is estimated shorter."""
_STATURE_SHARE, _PROPORTION_SHARE, _SIDE_SHARE = 0.04, 0.08, 0.02
"""Relative standard deviations of lengths between people: common to all, per kind, per side."""
_MIN_SCALE = 0.08
"""Metres: shorter lengths have the standard deviation of this length, because sensors displace their points."""
_MIN_SIZE, _MAX_SIZE = 0.5, 1.4
"""Bounds of a person's size relative to the average."""

_MODEL: Final = UpperBody()
_DEFAULT: Final = _MODEL.default_lengths()


def proportions() -> FloatArray:
    """(21, 21) square metres: covariance of lengths between people, with left and right of one person correlated."""
    kinds = [name.removesuffix("_left").removesuffix("_right") for name in LENGTHS]
    same = np.array([[a == b for b in kinds] for a in kinds])
    relative = _STATURE_SHARE**2 + _PROPORTION_SHARE**2 * same + _SIDE_SHARE**2 * np.eye(len(LENGTHS))
    scale = np.maximum(_DEFAULT, _MIN_SCALE)
    result: FloatArray = relative * np.outer(scale, scale)
    return result


def _ends() -> dict[str, tuple[Joint, Joint]]:
    """The two points whose distance measures each length; the model's hand tip and thumb are attached to the wrist."""
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
    """Names (k,) and points (4, k) a, b, c, d of the scalar products (b - a) . (d - c) that determine lengths."""
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
    """(k, 19) bias of each product by white noise of unit variance of each point."""
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
"""(19,) square metres: variance of an unseen point in the weight of its block."""
_FOLLOW_TIME = 1.0
"""Seconds: time constant with which the published lengths follow the estimate."""
_SKELETONS_MEMORY = 60
"""Blocks: after an unnoticed change of person the lengths are the new person's after half of it."""


def _lengths_of(products: FloatArray) -> FloatArray:
    """(..., 21) metres from (..., k) products in square metres."""
    of = {name: products[..., column] for name, column in _COLUMN.items()}

    def root(square: FloatArray) -> FloatArray:
        result: FloatArray = np.sqrt(np.maximum(square, MIN_LENGTH**2))
        return result

    across = root(of["hips"])
    found: dict[str, FloatArray] = {}
    drops = []
    for side in _SIDES:
        tip = root(of[f"hand_tip_{side}"])
        hand = root(of[f"hand_{side}"])
        along = np.maximum(of[f"thumb_tip_{side}"] / tip, MIN_LENGTH)
        width = np.maximum(of[f"hip_across_{side}"] / across, MIN_LENGTH)
        found[f"hand_{side}"] = hand
        found[f"hand_tip_{side}"] = np.maximum(tip - hand, MIN_LENGTH)
        found[f"thumb_along_{side}"] = along
        found[f"thumb_out_{side}"] = root(of[f"thumb_along_{side}"] - along**2)
        found[f"hip_width_{side}"] = width
        drops.append(of[f"hip_width_{side}"] - width**2)
    found["hip_drop"] = root(0.5 * (drops[0] + drops[1]))
    return np.stack([found[name] if name in found else root(of[name]) for name in LENGTHS], axis=-1)


_Frame = tuple[int, FloatArray, BoolArray, FloatArray]
"""Stamp, points (19, 3), mask of the used ones (19,), their variance by the measurement model (19,)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """A second of frames of one sensor.

    Attributes:
        stamp_ns: of its first frame.
        products: (k,) square metres, without the bias by white noise; NaN where not seen.
        lengths: (21,) metres.
        white: (21,) square metres: variance of the lengths by the difference of two interleaved halves.
        slow: (21,) square metres: stated variance of the lengths by slow errors.
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
    """Estimated lengths.

    Attributes:
        lengths: (21,) metres.
        covariance: (21, 21) square metres.
        seen: (21,) which of them were measured; the others follow from these and the prior.
    """

    lengths: FloatArray
    covariance: FloatArray
    seen: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class SegmentLengths:
    """Measurements of a person's lengths; immutable.

    Attributes:
        persistence: seconds, the time constant of the autocorrelation of errors in a length.
        memory: number of the newest blocks that are kept.
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
        """A copy with one more frame; ``blocks`` is a new object whenever a block is complete. Arrays are not copied.

        Args:
            sensor: name of the sensor.
            stamp_ns: capture time.
            points: (19, 3) metres, the points of the model, in any frame.
            tracked: (19,) which of them to use.
            white: (19,) square metres per axis, variance of their white noise.
            model: (19,) square metres per axis, their variance by the measurement model, for the weights of blocks.
            slow: share of ``model`` that is due to errors that last for seconds.
            stretch: additional relative standard deviation of the lengths of upper arms and forearms.
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

    def with_unfinished_block(self, white: FloatArray) -> SegmentLengths:
        """A copy with the unfinished block of the sensor without a name as one more; see :meth:`with_frame`."""
        frames = self._gathered.get("", ())
        if not frames:
            return self
        # too few frames are repeated: both halves of a block need two
        frames *= -(-_MIN_FRAMES // len(frames))
        blocks = (*self.blocks, _block(frames, white, 0.0, 0.0))[-self.memory :]
        return SegmentLengths(self.persistence, self.memory, blocks, self._gathered)

    def estimate(self) -> LengthEstimate:
        """The lengths by all blocks and the prior."""
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
        # variance of a block of average weight
        spread = (weights * off**2).sum(axis=0) / np.maximum(count - 1, 1)
        excess = np.maximum(spread - whiteness, 0.0)
        slow = (_PRIOR_BLOCKS * stated + (count - 1.0) * excess) / (_PRIOR_BLOCKS + count - 1.0)
        # the variance of a mean of blocks whose errors are correlated over time
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
    """The lengths of one person by filtered skeletons, from the first frame on.

    Until the first block is complete, the frames so far count as one block. The lengths follow the estimate gradually,
    because a block can change a length by centimetres, and the pose fitted with it by degrees. Points count as free of
    white noise, which the filter has removed, and of slow errors, so that measurements outweigh the prior.

    Attributes:
        lengths: (21,) metres; unseen ones are the other side's, or in proportion to the others.
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
        """Update with one frame.

        Args:
            stamp_ns: capture time.
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
            self._use(self._seen.with_unfinished_block(_NO_NOISE).estimate())
        elapsed = abs(stamp_ns - self._stamp_ns) / NANOSECONDS
        self._frames, self._stamp_ns = self._frames + 1, stamp_ns
        share = max(1.0 / self._frames, 1.0 - float(np.exp(-elapsed / _FOLLOW_TIME)))
        self.lengths = self.lengths + share * (self._target - self.lengths)

    def _use(self, estimate: LengthEstimate) -> None:
        seen = estimate.seen
        from_other = ~seen & seen[_OTHER_SIDE]
        self._target = np.where(from_other, estimate.lengths[_OTHER_SIDE], estimate.lengths)
        self.stddev = np.where(seen, np.sqrt(estimate.covariance.diagonal()), np.inf)


class LengthChanges:
    """Decides when to publish segment lengths: at first, when they change, and when they settle."""

    TOLERANCE = 0.002
    """Least difference of a length from the published one, metres."""
    PERIOD_NS = NANOSECONDS
    """Least time between two publications."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the person."""
        self._published: FloatArray | None = None
        self._published_ns = 0
        self._before: FloatArray | None = None

    def due(self, stamp_ns: int, lengths: FloatArray) -> bool:
        """Whether to publish these (n,) lengths, metres, of this capture time; if so, they count as published."""
        settled = self._before is not None and np.array_equal(self._before, lengths)
        self._before = lengths
        if self._published is not None:
            if 0 <= stamp_ns - self._published_ns < self.PERIOD_NS:
                return False
            change = float(np.abs(lengths - self._published).max())
            if change <= self.TOLERANCE and not (settled and change > 0.0):
                return False
        self._published, self._published_ns = lengths, stamp_ns
        return True


def _block(frames: tuple[_Frame, ...], white: FloatArray, slow: float, stretch: float) -> _Block:
    """The block of some frames; see :meth:`SegmentLengths.with_frame` for the other arguments."""
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
    """Mean over the first dimension; NaN, without a warning, for fewer than two values."""
    there = np.isfinite(values)
    count = there.sum(axis=0)
    total = np.where(there, values, 0.0).sum(axis=0)
    return np.where(count > 1, total / np.maximum(count, 1), np.nan)


def _nanmedian(values: FloatArray) -> FloatArray:
    """Median over the first dimension; NaN, without a warning, where there is no value."""
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
    """Huber's estimate of location (m,) of values (n, m), NaN where missing, and the residuals (n, m).

    Residuals of missing values are 0, and the others are clipped at :data:`_OUTLIER` times the scale.

    Args:
        values: one row per block.
        weights: (n, m) inverse variances, 1 on average.
        least: (m,) lower bound of the scale of a value of average weight.
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

"""Compiled kernels of the extended filter: its most expensive steps."""

from __future__ import annotations

import numpy as np

from body_tracking.core.compiled import compiled
from body_tracking.core.skeleton import BoolArray, FloatArray, IntArray, SingleArray
from body_tracking.filters.ekf.algebra import factored, forward_substituted, invert, squared_distance
from body_tracking.kinematics.compiled_body import Tree, curved, integrated, linearised
from body_tracking.kinematics.compiled_posture import PriorTable, prior_rows

_SUDDEN, _SUDDEN_TIME = 20.0, 0.05
"""m/s2: standard deviation of a sudden acceleration of a joint, beyond the motion model; s: its greatest duration."""
_FIRST_LIMB = 6
"""Segment whose origin is the first shoulder; then the other, both elbows, both wrists."""
_TANGENT, _VELOCITIES = 32, 53


@compiled
def upright(
    q: FloatArray,
    lengths: FloatArray,
    covariance: FloatArray,
    chosen: IntArray,
    variance: FloatArray,
    mean: FloatArray,
    tree: Tree,
    table: PriorTable,
    updates: int,
) -> FloatArray:
    """The iterated update by the posture prior; changes the covariance in place, velocities are only considered.

    Args:
        q: (35,) configuration.
        lengths: (21,) metres.
        covariance: (85, 85) of tangent, lengths and velocities.
        chosen: (k,) rows of :func:`prior_rows`.
        variance: (k,) of these rows.
        mean: (k,) mean residual of each row over the last minute, where the prior applies to that mean; NaN where it
            applies to the present pose.
        tree: of the model.
        table: of the prior.
        updates: number of linearisations.

    Returns:
        (35,) the updated configuration.
    """
    size, count = tree.axes.shape[0], len(chosen)
    known = len(covariance) - size
    start, moved = q, np.zeros(size)
    pose = np.ascontiguousarray(covariance[:, :size])
    half = np.empty((count, len(covariance)))
    aim = np.zeros(count)
    for update in range(updates):
        _, rotations, _, _, turning = linearised(q, lengths, tree)
        _, residuals, gradients = prior_rows(q, rotations[0], turning[0], table)
        if update == 0:
            for k in range(count):
                if not np.isnan(mean[k]):
                    aim[k] = residuals[chosen[k]] - mean[k]
        rows = gradients[chosen]
        cross = np.dot(rows, pose.T)  # (k, 85)
        s = np.dot(np.ascontiguousarray(cross[:, :size]), rows.T)
        for k in range(count):
            s[k, k] += variance[k]
        off = np.dot(rows, moved) - residuals[chosen] + aim
        factored(s)
        half = cross
        forward_substituted(s, half)
        white = off.reshape(count, 1)
        forward_substituted(s, white)
        for column in range(size):
            moved[column] = 0.0
            for k in range(count):
                moved[column] += half[k, column] * white[k, 0]
        q = integrated(start, moved, tree)
    taken = np.dot(half.T, half)
    for row in range(len(covariance)):
        end = len(covariance) if row < known else known
        for column in range(end):
            covariance[row, column] -= taken[row, column]
    return q


@compiled
def displacing(observation: FloatArray, weights: FloatArray, information: FloatArray) -> FloatArray:
    """(53, 57) change of the best-fitting pose by errors of the points: G = (H^T W H + P^-1)^-1 H^T W.

    Args:
        observation: (57, 53) H.
        weights: (19,) diagonal of W, for each point.
        information: (53, 53) P^-1.
    """
    weighted = observation.T.copy()
    size = len(weighted)
    for column in range(len(observation)):
        for row in range(size):
            weighted[row, column] *= weights[column // 3]
    factor = np.dot(weighted, observation) + information
    right = weighted
    factored(factor)
    forward_substituted(factor, right)
    for k in range(size - 1, -1, -1):
        for i in range(k + 1, size):
            times = factor[k, i]
            for j in range(right.shape[1]):
                right[k, j] -= times * right[i, j]
        pivot = 1.0 / factor[k, k]
        for j in range(right.shape[1]):
            right[k, j] *= pivot
    return right


@compiled
def point_covariances(observation: FloatArray, covariance: FloatArray) -> FloatArray:
    """(19, 3, 3) covariance of each point, from its (57, 53) derivatives and the covariance (53, 53) of the pose."""
    half = np.dot(observation, covariance)
    count, size = len(observation) // 3, observation.shape[1]
    result = np.empty((count, 3, 3))
    for point in range(count):
        for i in range(3):
            for j in range(i, 3):
                total = 0.0
                for k in range(size):
                    total += half[3 * point + i, k] * observation[3 * point + j, k]
                result[point, i, j] = result[point, j, i] = total
    return result


@compiled
def _by_points(crosses: SingleArray, place: int, own: FloatArray) -> FloatArray:
    """(n, 57) covariance of the state with the points' slow errors of the sensor at a place of ``crosses``."""
    size = 3 * len(own)
    result = np.zeros((len(crosses), size))
    for point in range(len(own)):
        for j in range(point + 1):
            if own[point, j] != 0.0:
                for row in range(len(crosses)):
                    for i in range(3):
                        result[row, 3 * point + i] += own[point, j] * crosses[row, place + 3 * j + i]
    return result


@compiled
def expected(
    q: FloatArray,
    lengths: FloatArray,
    positions: FloatArray,
    covariance: FloatArray,
    spread: FloatArray,
    crosses: SingleArray,
    place: int,
    own: FloatArray,
    along: FloatArray,
    carried: FloatArray,
    white: FloatArray,
    turns: FloatArray,
    tree: Tree,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The predicted measurement of a frame, its innovation and their covariances.

    Args:
        q: (35,) configuration at which to linearise.
        lengths: (21,) metres.
        positions: (19, 3) metres: measured points.
        covariance: (n, n) of the state.
        spread: (32, 32) covariance of the tangent, for the second-order terms.
        crosses: (n, m) covariance of the state with the slow errors of all sensors.
        place: first column of this sensor's slow errors.
        own: (19, 19) metres: the points' slow errors by independent ones of unit variance, lower triangular.
        along: (4,) standard deviation of each limb's measured length, as a share of the length; 0 for none.
        carried: (19, 4) which points each limb carries.
        white: (19,) square metres: variance of the white noise.
        turns: (3, 3, 3) derivatives of the free rotations' tangents at ``q`` by those at the state; (0, 3, 3) if ``q``
            is the state's.
        tree: of the model; the limbs' ends are the origins of segments 6 to 11.

    Returns:
        (57, 53) derivative of the points, (57,) innovation, (57, 57) its covariance, (n, 57) covariance of the state
        with the innovation, (19, 3, 3) innovation covariance of each point with the second-order terms, (57, 4)
        displacement by one standard deviation of each limb's length.
    """
    points, _, axes, observation, _ = linearised(q, lengths, tree)
    count, known = len(points), observation.shape[1]
    size = 3 * count
    curvature = curved(observation, axes, spread, tree)
    number = 0
    for segment in range(len(tree.parents)):
        if tree.ball[segment] and number < len(turns):
            first = tree.coordinates[segment, 0]
            for row in range(size):
                x, y, z = observation[row, first], observation[row, first + 1], observation[row, first + 2]
                for i in range(3):
                    observation[row, first + i] = (
                        x * turns[number, 0, i] + y * turns[number, 1, i] + z * turns[number, 2, i]
                    )
            number += 1
    innovation = (positions - points - curvature).reshape(-1)
    limbs = np.zeros((size, carried.shape[1]))
    for limb in range(carried.shape[1]):
        if along[limb] > 0.0:
            start, end = tree.origins[_FIRST_LIMB + limb], tree.origins[_FIRST_LIMB + 2 + limb]
            for point in range(count):
                for i in range(3):
                    limbs[3 * point + i, limb] = (
                        carried[point, limb] * along[limb] * (points[end, i] - points[start, i])
                    )
    cross = np.dot(np.ascontiguousarray(covariance[:, :known]), observation.T)  # P H^T
    half = 0.5 * cross[:known]
    # H P H^T + B C^T H^T + H C B^T + B B^T, and P H^T + C B^T
    by_limbs = np.dot(crosses[:, place + size : place + size + limbs.shape[1]].astype(np.float64), limbs.T)
    by_points = _by_points(crosses, place, own)
    for row in range(len(cross)):
        for k in range(size):
            change = by_points[row, k] + by_limbs[row, k]
            cross[row, k] += change
            if row < known:
                half[row, k] += change
    product = np.dot(observation, half)
    s = np.dot(limbs, limbs.T)
    variance = np.dot(own, own.T)
    blocks = np.empty((count, 3, 3))
    for i in range(size):
        for j in range(size):
            s[i, j] += product[i, j] + product[j, i]
        s[i, i] += white[i // 3]
        for j in range(i % 3, size, 3):
            s[i, j] += variance[i // 3, j // 3]
    for point in range(count):
        for i in range(3):
            for j in range(3):
                # for a normal error x, x^2 / 2 with the mean m has the variance 2 m^2
                blocks[point, i, j] = s[3 * point + i, 3 * point + j] + 2.0 * curvature[point, i] * curvature[point, j]
    return observation, innovation, s, cross, blocks, limbs


@compiled
def solved(
    s: FloatArray, blocks: FloatArray, cross: FloatArray, innovation: FloatArray, covariance: FloatArray, rows: IntArray
) -> tuple[bool, FloatArray, FloatArray, FloatArray, FloatArray]:
    """The Kalman update by selected rows of the innovation.

    Args:
        s: (57, 57) covariance of the innovation.
        blocks: (19, 3, 3) covariance of each point, which replaces the diagonal blocks of ``s``.
        cross: (n, 57) C, covariance of the state with the innovation.
        innovation: (57,) metres.
        covariance: (n, n) of the state.
        rows: (k,) the selected rows, ascending.

    Returns:
        Whether s is positive definite; (k, k) W, the inverse of its lower Cholesky factor; (k, n) W C^T; (k,) the
        normalised innovation; (n, n) the updated covariance.
    """
    count, size = len(rows), len(cross)
    factor, whitening = np.empty((count, count)), np.empty((count, count))
    gain, white = np.empty((count, size)), np.empty((count, 1))
    for i in range(count):
        row = rows[i]
        for j in range(count):
            column = rows[j]
            factor[i, j] = blocks[row // 3, row % 3, column % 3] if row // 3 == column // 3 else s[row, column]
        white[i, 0] = innovation[row]
        for j in range(size):
            gain[i, j] = cross[j, row]
    sound = factored(factor)
    if sound:
        forward_substituted(factor, gain)
        forward_substituted(factor, white)
        invert(factor, whitening)
    return sound, whitening, gain, white.reshape(-1), covariance - np.dot(gain.T, gain)


@compiled
def crosses_updated(
    crosses: SingleArray,
    kalman: FloatArray,
    observation: FloatArray,
    rows: IntArray,
    place: int,
    own: FloatArray,
    limbs: FloatArray,
) -> SingleArray:
    """(n, m) covariance of the state with considered slow errors (Schmidt 1966): C - K H C, - K B for this sensor's.

    Args:
        crosses: (n, m) C, before the update.
        kalman: (n, k) gain.
        observation: (57, 53) derivative of the points.
        rows: (k,) rows of ``observation`` that were used.
        place: first column of this sensor's slow errors.
        own: (19, 19) metres: the points' slow errors by independent ones of unit variance, lower triangular.
        limbs: (57, 4) displacement by one standard deviation of each limb's length.
    """
    known, size = observation.shape[1], len(observation)
    seen = np.dot(kalman, observation[rows]).astype(np.float32)
    result: SingleArray = crosses - np.dot(seen, crosses[:known])
    by_limbs = np.dot(kalman, limbs[rows])
    for k in range(len(rows)):
        point, axis = rows[k] // 3, rows[k] % 3
        for j in range(point + 1):
            if own[point, j] != 0.0:
                for i in range(len(result)):
                    result[i, place + 3 * j + axis] -= kalman[i, k] * own[point, j]
    result[:, place + size : place + size + limbs.shape[1]] -= by_limbs.astype(np.float32)
    return result


@compiled
def pseudo_measured(
    covariance: FloatArray,
    crosses: SingleArray,
    free: FloatArray,
    free_crosses: SingleArray,
    rows: FloatArray,
    error: FloatArray,
    noise: FloatArray,
) -> tuple[bool, FloatArray, FloatArray, SingleArray]:
    """The update by pseudo-measurements of the tangent.

    Args:
        covariance: (n, n) of the state.
        crosses: (n, m) covariance of the state with the slow errors of cameras.
        free: (n, n) the part of ``covariance`` that may be corrected.
        free_crosses: (n, m) the same part of ``crosses``.
        rows: (k, 32) observation matrix.
        error: (k,) innovation.
        noise: (k,) variances of the pseudo-measurements.

    Returns:
        Whether the innovation covariance is positive definite, the correction (n,), and both updated covariances.
    """
    count = len(rows)
    half = np.dot(rows, free[:_TANGENT])
    s = np.dot(np.ascontiguousarray(half[:, :_TANGENT]), rows.T)
    white = error.copy().reshape(count, 1)
    for k in range(count):
        s[k, k] += noise[k]
    sound = factored(s)
    if sound:
        forward_substituted(s, half)
        forward_substituted(s, white)
        covariance = covariance - np.dot(half.T, half)
        if crosses.shape[1]:
            slow = np.dot(rows, free_crosses[:_TANGENT].astype(np.float64))
            forward_substituted(s, slow)
            crosses = crosses - np.dot(half.T, slow).astype(np.float32)
    return sound, np.dot(half.T, white).reshape(-1), covariance, crosses


@compiled
def gated(
    innovation: FloatArray, blocks: FloatArray, measured: BoolArray, rejected_for: FloatArray, dt: float, gate: float
) -> tuple[BoolArray, FloatArray]:
    """Gate each point by the Mahalanobis distance of its innovation.

    Args:
        innovation: (57,) metres.
        blocks: (19, 3, 3) innovation covariance of each point.
        measured: (19,) which points are measured.
        rejected_for: (19,) seconds for which each point has been rejected, before this frame.
        dt: seconds since the sensor's last frame.
        gate: greatest squared distance.

    Returns:
        (19,) which points are used, and the new ``rejected_for``.
    """
    used, rejected_for = measured.copy(), rejected_for.copy()
    # a limb may accelerate more than the motion model expects: its displacement since the last frame is no outlier
    sudden = (0.5 * _SUDDEN * min(dt, _SUDDEN_TIME) ** 2) ** 2
    for k in range(len(measured)):
        if measured[k]:
            used[k] = squared_distance(blocks[k], innovation[3 * k : 3 * k + 3], sudden) < gate
            rejected_for[k] = 0.0 if used[k] else rejected_for[k] + dt
    return used, rejected_for


@compiled
def carry(part: FloatArray | SingleArray, turns: FloatArray, balls: IntArray, reach: float, fade: float) -> None:
    """Multiply rows (85 or more, n) from the left by the transition matrix of the motion model, in place.

    Args:
        part: rows of tangent (32), lengths, velocities (32) and more.
        turns: (3, 3, 3) rotations of the tangents of free rotations.
        balls: (3,) index of each free rotation's first coordinate in the tangent.
        reach: seconds: displacement per unit of velocity.
        fade: decay factor of the velocities.
    """
    for k in range(len(balls)):
        ball = balls[k]
        for j in range(part.shape[1]):
            x, y, z = part[ball, j], part[ball + 1, j], part[ball + 2, j]
            for i in range(3):
                part[ball + i, j] = turns[k, i, 0] * x + turns[k, i, 1] * y + turns[k, i, 2] * z
    for i in range(_TANGENT):
        for j in range(part.shape[1]):
            part[i, j] += reach * part[_VELOCITIES + i, j]
            part[_VELOCITIES + i, j] *= fade


@compiled
def transported(
    covariance: FloatArray,
    crosses: SingleArray,
    turns: FloatArray,
    balls: IntArray,
    reach: float,
    fade: float,
    kept: float,
    noise: FloatArray,
) -> tuple[FloatArray, SingleArray]:
    """The covariances after some time of integrated Ornstein-Uhlenbeck velocities: F P F^T + Q, and F C.

    Args:
        covariance: (n, n) of tangent (32), lengths, velocities (32) up to 85, and sources.
        crosses: (n, m) covariance of the state with the slow errors.
        turns: (3, 3, 3) rotations of the tangents of free rotations.
        balls: (3,) index of each free rotation's first coordinate in the tangent.
        reach: seconds: displacement per unit of velocity.
        fade: decay factor of the velocities.
        kept: decay factor of the slow errors.
        noise: (3, 32) process noise: variances of tangent and of velocities, and their covariance.
    """
    p = covariance.copy()
    c = crosses * np.float32(kept)
    carry(p, turns, balls, reach, fade)
    carry(p.T, turns, balls, reach, fade)
    carry(c, turns, balls, reach, fade)
    for i in range(noise.shape[1]):
        p[i, i] += noise[0, i]
        p[_VELOCITIES + i, _VELOCITIES + i] += noise[1, i]
        p[i, _VELOCITIES + i] += noise[2, i]
        p[_VELOCITIES + i, i] += noise[2, i]
    return p, c

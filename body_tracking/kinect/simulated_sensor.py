"""Simulates the skeletons that a Kinect v2 reports of a person: their errors and their times.

The errors apply to the body as the sensor interprets it: facing the sensor, so that left and right are swapped where
the person faces away (``mirrored``). From the true joints to the reported ones:

1. lifted shoulders are reported too low, the body's yaw too small (``lift_damping``, ``turn_loss``);
2. each joint has a constant offset from the anatomical one in the body's own frames (``anatomical``, ``offset``), the
   arms an error of direction by their pose (the inverse of ``calibration.arm_directions``, by ``anatomical``), and
   along the ray an offset by its kind (``depth_offset``);
3. each joint has an error that is a function of pose and view (``bias``, ``bias_turn``, ``length_spread``), and one
   that drifts with time (``drift``, ``drift_time``); :class:`Misreading` holds the random numbers that are drawn once
   per person and type of sensor;
4. a hidden joint is guessed (``guess``), pulled to the surface that hides it (``drag``) and released with a delay
   (``hang_over``); limbs nearly keep their lengths;
5. all frames have white noise (``white``) and, rarely, outliers;
6. SpineMid is not measured but interpolated between SpineBase and SpineShoulder (``straightening``), however the
   person bends.

Bias, drift and noise grow with the distance (``distance_growth``) and with the yaw of the body against the sensor
(``growth_60``, ``growth_90``), on its far side more than on its near side; guesses grow with the distance. All of these
are greater along the ray than across it.

Over 500 lines: one sensor, whose errors share the geometry of its view.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from scipy.special import ndtri

from body_tracking.calibration.arm_directions import KINECT_V2, turn_arms
from body_tracking.core.clocks import ClockModel
from body_tracking.core.measurement import body_heading
from body_tracking.core.sensor_poses import SensorPose
from body_tracking.core.skeleton import (
    MIRROR,
    N_JOINTS,
    NANOSECONDS,
    BoolArray,
    FloatArray,
    IntArray,
    Joint,
    Skeleton,
    TrackingState,
)
from body_tracking.core.sources import RecordedFrame, optical_frame
from body_tracking.kinect import simulated_joints as tables
from body_tracking.kinect.occlusion import Capsules, obstruction, veil
from body_tracking.kinect.simulated import KinectErrors

FIELD_OF_VIEW: Final = (np.radians(70.6), np.radians(60.0))
"""Horizontal and vertical angle of the depth camera, radians."""
RANGE: Final = (0.5, 4.5)
"""Metres along the optical axis within which the sensor sees bodies."""
RATE, DARK_RATE = 30.0, 15.0
"""Frames per second, in the light and in the dark."""
REFERENCE_DISTANCE: Final = 2.0
"""Distance at which the parameters of the errors hold, metres."""
ALONG_RAY: Final = 1.5
"""Ratio of the errors along the ray to those across it."""
_RAY_AXES: Final = np.array([1.0, 1.0, ALONG_RAY])
_SPINE_WEIGHT, _FAR_DEPTH = 0.4, 0.3
"""The spine's share of the variance that grows with yaw; metres behind the spine at which a limb is all far side."""
_MIDDLE = 0.75
"""Cover from which a joint is behind the middle of a body part."""
_LOST_FROM, _FIND_AGAIN = 0.6, 0.15
"""Share of the trunk's joints behind other people from which a body is lost, and seconds until it is found again."""
_REST_LEVEL = -0.27
"""Height of a shoulder over SpineShoulder when standing, as a share of its distance (``kinect_pairs``)."""
_SPINE_MID_SHARE, _SPINE_MID_BACK = 0.578, 0.007
"""SpineMid's share of the way from SpineBase to SpineShoulder, and its distance behind that line as a share of it:
0.577 to 0.579 and 0.004 to 0.008 in each recording of ``kinect_pairs`` and each subject of ``kinect_vs_vicon``, with a
standard deviation of 0.002 within them, also where the person bends by 49 degrees."""
_STIFFNESS = 0.7
"""Share of a limb's error of length that the sensor corrects."""
_FEATURES = 24
"""Random features per joint: enough for errors that are nearly Gaussian."""


@dataclass(frozen=True, slots=True, eq=False)
class Misreading:
    """Systematic errors of a type of sensor for one person: the same for all sensors in the same view and pose.

    All in units of the parameters of :class:`KinectErrors`, of standard deviation 1.

    Attributes:
        offset: (25, 3) in the body's frames: of the trunk (forward, left, up), or of the trunk turned as the limb's
            segment is turned from the T-pose (arms) or from standing (legs).
        frequencies: (25, m, 9) per unit of direction: of the view, of a joint's first and of its second segment.
        phases: (25, m) radians.
        amplitudes: (25, m, 4) of the error to the right, down and along the ray, and of the length.
    """

    offset: FloatArray
    frequencies: FloatArray
    phases: FloatArray
    amplitudes: FloatArray

    @classmethod
    def draw(cls, rng: np.random.Generator) -> Misreading:
        """Draw the random features of a Gaussian kernel (Rahimi and Recht 2007)."""
        shape = (N_JOINTS, _FEATURES)
        return cls(
            tables.KIN @ rng.normal(size=(N_JOINTS, 3)),
            rng.normal(size=(*shape, 9)),
            rng.uniform(0.0, 2.0 * np.pi, shape),
            rng.normal(size=(*shape, 4)) * np.sqrt(2.0 / _FEATURES),
        )

    def at(self, directions: FloatArray, turn: float) -> FloatArray:
        """(n, 25, 4) errors at (n, 25, 9) directions, with a correlation length of ``turn`` radians."""
        angles = np.einsum("njd,jmd->njm", directions, self.frequencies / turn, optimize=True) + self.phases
        result: FloatArray = np.einsum("njm,jme->nje", np.cos(angles), self.amplitudes, optimize=True)
        return result


@dataclass(frozen=True, slots=True)
class SimulatedKinect:
    """A Kinect v2 with its pose, clock and errors.

    Attributes:
        pose: of its optical frame in ``world``; its name is the sensor's.
        clock: its clock against the reference clock.
        phase: seconds of its first frame after the start.
        errors: their parameters.
        dark: without light the frame rate is halved.
    """

    pose: SensorPose
    clock: ClockModel = field(default_factory=ClockModel)
    phase: float = 0.0
    errors: KinectErrors = field(default_factory=KinectErrors)
    dark: bool = False

    @property
    def rate(self) -> float:
        """Frames per second of its own clock."""
        return DARK_RATE if self.dark else RATE

    def capture_times(self, duration: float, rng: np.random.Generator) -> FloatArray:
        """(n,) seconds of its captures, ascending: at the rate of its own clock, with jitter."""
        period = 1.0 / (self.rate * (1.0 + self.clock.drift_ppm * 1e-6))
        times = np.arange(self.phase, duration, period)
        moved = np.clip(rng.normal(scale=self.errors.jitter, size=len(times)), -0.3 * period, 0.3 * period)
        result: FloatArray = times + moved
        return result

    def see(
        self,
        times: FloatArray,
        truth: FloatArray,
        capsules: Capsules,
        rng: np.random.Generator,
        misreading: Misreading,
        others: Sequence[tuple[FloatArray, Capsules]] = (),
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """One person as the sensor reports it.

        Args:
            times: (n,) seconds of the captures after the start.
            truth: (n, 25, 3) metres, true joints in ``world`` at these times.
            capsules: the person's surface.
            rng: random generator.
            misreading: of this person; the same for all sensors.
            others: true joints and surface of each person who may hide this one.

        Returns:
            (n, 25, 3) metres in the optical frame, NaN where a joint is not tracked, and the (n, 25) states.
        """
        if len(times) == 0:
            return np.empty((0, N_JOINTS, 3)), np.empty((0, N_JOINTS), dtype=np.uint8)
        sight = (truth - self.pose.translation) @ self.pose.rotation
        steps = np.diff(times)
        period = float(np.median(steps)) if len(steps) else 1.0 / self.rate
        veiled = np.zeros(sight.shape[:2])
        for joints, flesh in others:
            other = (joints - self.pose.translation) @ self.pose.rotation
            np.maximum(veiled, veil(sight, capsules, other, flesh), out=veiled)
        return _Sighting(self.errors, period, rng).of(sight, capsules, misreading, veiled)

    def deliver(
        self,
        times: FloatArray,
        bodies: Mapping[int, tuple[FloatArray, NDArray[np.uint8]]],
        start_ns: int,
        received_from_ns: int,
        rng: np.random.Generator,
    ) -> list[RecordedFrame]:
        """The frames that arrive, in order of receipt; frames without any tracked joint are left out.

        Args:
            times: (n,) seconds of the captures after the start.
            bodies: results of :meth:`see`, by the sensor's body numbers.
            start_ns: the start in the reference clock.
            received_from_ns: the start in the receiver's clock.
            rng: random generator.
        """
        errors, count = self.errors, len(times)
        lost = rng.random(count) < errors.lost
        received = times + errors.delay + rng.gamma(1.0, errors.delay_jitter, count)
        for begin, end in _events(times, errors.stall_rate, errors.stall_time, rng):
            during = slice(*np.searchsorted(times, (begin, end)))
            if rng.random() < 0.5:
                lost[during] = True
            else:
                received[during] = np.maximum(received[during], end + errors.delay)
        # the connection keeps the order: a delayed frame delays the next ones
        received = np.maximum.accumulate(received)
        frames = []
        for k in np.flatnonzero(~lost):
            stamp_ns = self.clock.to_sensor(start_ns + round(times[k] * NANOSECONDS))
            skeletons = tuple(
                Skeleton(stamp_ns, optical_frame(self.pose.sensor), positions[k], states[k], body)
                for body, (positions, states) in bodies.items()
                if states[k].any()
            )
            if skeletons:
                receipt_ns = received_from_ns + round(received[k] * NANOSECONDS)
                frames.append(RecordedFrame(self.pose.sensor, receipt_ns, skeletons))
        return frames


@dataclass(frozen=True, slots=True, eq=False)
class _View:
    """The body as the sensor interprets it, over n frames.

    Attributes:
        trunk: (n, 3, 3) the trunk's axes (forward, left, up) in the optical frame, as columns.
        thorax: (n, 3, 3) likewise of the thorax.
        yaw: (n,) radians about the trunk's axis from its forward direction to the sensor, positive to its left.
        rays: (n, 25, 3, 3) unit vectors right, down and along the ray of each joint, as rows.
        growth: (n, 25) factor of the errors by distance and yaw.
        distance: (n, 25) factor of the errors by distance alone.
    """

    trunk: FloatArray
    thorax: FloatArray
    yaw: FloatArray
    rays: FloatArray
    growth: FloatArray
    distance: FloatArray

    @classmethod
    def of(cls, sight: FloatArray, errors: KinectErrors) -> _View:
        trunk, yaw = _trunk(sight)
        far = np.linalg.norm(sight, axis=2)
        along = sight / np.maximum(far, 1e-9)[..., None]
        right = _unit(np.cross([0.0, 1.0, 0.0], along))
        rays = np.stack([right, np.cross(along, right), along], axis=2)
        distance = (far / REFERENCE_DISTANCE) ** errors.distance_growth
        grown = [1.0, 1.0, 1.0 + errors.growth_60, 1.0 + errors.growth_90]
        factor = np.interp(np.abs(yaw), np.radians([0.0, 30.0, 60.0, 90.0]), grown)[:, None]
        # the RMS of both sides is the factor; the near side is hardly affected
        away = _unit(sight[:, Joint.SPINE_MID])
        behind = np.einsum("nji,ni->nj", sight - sight[:, None, Joint.SPINE_MID], away)
        weight = np.where(tables.SPINE, _SPINE_WEIGHT, np.clip(1.0 + behind / _FAR_DEPTH, 0.1, 1.9))
        growth = distance * np.sqrt(1.0 + (factor**2 - 1.0) * weight)
        return cls(trunk, _thorax(sight), yaw, rays, growth, distance)

    def in_optical(self, errors: FloatArray) -> FloatArray:
        """Transform (n, 25, 3) errors from (right, down, along the ray) into the optical frame."""
        result: FloatArray = np.einsum("njk,njki->nji", errors, self.rays)
        return result


@dataclass(frozen=True, slots=True, eq=False)
class _Sighting:
    """Applies the errors to frames at a regular ``period`` in seconds."""

    errors: KinectErrors
    period: float
    rng: np.random.Generator

    def of(
        self, sight: FloatArray, capsules: Capsules, misreading: Misreading, veiled: FloatArray
    ) -> tuple[FloatArray, NDArray[np.uint8]]:
        """The reported joints and their states.

        Args:
            sight: (n, 25, 3) metres, true joints in the optical frame.
            capsules: the person's surface.
            misreading: of the person.
            veiled: (n, 25) how deep each joint is behind other people, 0 to 1.
        """
        # one generator per kind of error, so that the kinds do not affect each other
        for_labels, for_slow, for_states, for_white = self.rng.spawn(4)
        before, in_view = obstruction(sight, capsules), _in_view(sight)
        labels = self._labels(sight, for_labels)
        sight = np.take_along_axis(sight, labels[..., None], axis=1)
        # the sensor separates people: a joint hidden by another person is not pulled to that person
        covers = np.maximum(before.cover, veiled), np.where(veiled > before.cover, 0.0, before.nearer)
        cover, nearer = (np.take_along_axis(values, labels, axis=1) for values in covers)
        in_view = np.take_along_axis(in_view, labels, axis=1)

        view = _View.of(sight, self.errors)
        segments = _unit(sight - sight[:, tables.PARENTS])
        anatomy = sight + self._offset(sight, view, segments, misreading)
        slow, length = self._slow(anatomy, view, segments, misreading, for_slow)
        placed = anatomy + self._shape(sight, view) + slow
        placed += self._hidden(view, cover, nearer, for_slow)
        self._keep_lengths(placed, anatomy, length)
        placed += self._new(view, for_white)
        self._interpolate_spine(placed, view)
        states = self._states(cover, in_view, for_states)
        states[self._unseen(veiled)] = TrackingState.NOT_TRACKED
        placed[states == TrackingState.NOT_TRACKED] = np.nan
        return placed, states

    def _labels(self, sight: FloatArray, rng: np.random.Generator) -> IntArray:
        """(n, 25) the true joint that the sensor reports as each joint."""
        errors, count = self.errors, len(sight)
        times: FloatArray = self.period * np.arange(count, dtype=np.float64)
        labels = np.tile(np.arange(N_JOINTS, dtype=np.intp), (count, 1))
        _, yaw = _trunk(sight)
        labels[self._mirrored(np.abs(yaw), times, rng)] = MIRROR
        for limbs in (tables.ARMS, tables.LEGS):
            which = np.flatnonzero(limbs)
            for begin, end in _events(times, errors.limb_swap_rate, errors.hang_over, rng):
                during = slice(*np.searchsorted(times, (begin, end)))
                labels[during, which] = labels[during, MIRROR[which]]
        return labels

    def _mirrored(self, yaw: FloatArray, times: FloatArray, rng: np.random.Generator) -> BoolArray:
        """(n,) whether the sensor swaps left and right; yaw (n,) radians from 0 to pi."""
        errors = self.errors
        back = yaw > np.pi / 2 + errors.mirror_hysteresis
        front = yaw < np.pi / 2 - errors.mirror_hysteresis
        mirrored: BoolArray = np.zeros_like(back)
        edges = np.flatnonzero(np.diff(back, prepend=False, append=False))
        for begin, end in edges.reshape(-1, 2):
            # the swap ends when the person faces the sensor unambiguously, or a while before
            until = min(end + round(rng.exponential(errors.mirror_time) / self.period), len(yaw))
            seen = np.flatnonzero(front[end:until])
            mirrored[begin : end + int(seen[0]) if len(seen) else until] |= rng.random() < errors.mirrored
        # at 45 degrees a quarter as often as from the side
        likely = np.sin(yaw) ** 4
        for begin, end in _events(times, errors.mirror_rate, errors.mirror_time, rng):
            first, last = np.searchsorted(times, (begin, end))
            if rng.random() < likely[min(first, len(likely) - 1)]:
                mirrored[first:last] ^= True
        return mirrored

    def _shape(self, sight: FloatArray, view: _View) -> FloatArray:
        """(n, 25, 3) displacement: damped lift of the shoulders, reduced yaw of the body."""
        errors, moved = self.errors, np.zeros_like(sight)
        up = view.trunk[:, :, 2]
        turn = errors.turn_loss * view.yaw * np.sin(view.yaw) ** 4
        for centre, root, followers in tables.FOLLOWS:
            for side in ("LEFT", "RIGHT"):
                end = Joint[f"{root}_{side}"]
                arm = sight[:, end] - sight[:, centre]
                turned = Rotation.from_rotvec(turn[:, None] * up).apply(arm) - arm
                moved[:, end] += turned
                for name, much in followers.items():
                    moved[:, Joint[f"{name}_{side}"]] += much * turned
                if root == "SHOULDER":
                    level = np.einsum("ni,ni->n", arm, up)
                    lift = np.maximum(level - _REST_LEVEL * np.linalg.norm(arm, axis=1), 0.0)
                    moved[:, end] -= errors.lift_damping * lift[:, None] * up
        return moved

    def _offset(self, sight: FloatArray, view: _View, segments: FloatArray, misreading: Misreading) -> FloatArray:
        """(n, 25, 3) offsets common to all people, a person's own in the body's frames, and those along the ray."""
        common = turn_arms(sight, view.thorax, KINECT_V2.measured) - sight
        common += np.einsum("nik,jk->nji", view.trunk, tables.ANATOMICAL)
        own = np.einsum("nik,jk->nji", view.trunk, self.errors.offset * tables.SLOW_SCALE[:, None] * misreading.offset)
        # limbs: by the least rotation that takes the segment's rest direction to its present one
        limbs = ~tables.ON_TRUNK
        rest = np.einsum("nik,jk->nji", view.trunk, tables.REST[limbs])
        own[:, limbs] = _least_rotation(rest, segments[:, limbs], own[:, limbs])
        result: FloatArray = self.errors.anatomical * common + own
        return result + self.errors.depth_offset * tables.DEPTH_PATTERN[:, None] * view.rays[:, :, 2]

    def _slow(
        self,
        anatomy: FloatArray,
        view: _View,
        segments: FloatArray,
        misreading: Misreading,
        rng: np.random.Generator,
    ) -> tuple[FloatArray, FloatArray]:
        """Bias and drift: (n, 25, 3) displacement, and (n, 25) relative errors of the segments' lengths.

        A joint's segment is the one from its anchor; the displacement includes the errors of the lengths.
        """
        errors = self.errors
        pointing = np.einsum("nki,njk->nji", view.trunk, segments)
        towards = np.einsum("nki,nk->ni", view.trunk, -_unit(anatomy[:, Joint.SPINE_MID]))
        towards = np.broadcast_to(towards[:, None], pointing.shape)
        directions = np.concatenate([towards, pointing[:, tables.FIRST], pointing[:, tables.SECOND]], axis=2)
        posed = misreading.at(directions, errors.bias_turn)
        wandering = self._wander((*anatomy.shape[:2], 4), rng)
        joint = tables.KIN @ (errors.bias * posed[..., :3] + errors.drift * wandering[..., :3])
        displacement = view.in_optical((tables.SLOW_SCALE * view.growth)[..., None] * _RAY_AXES * joint)
        length = errors.length_spread * np.sqrt(0.5) * (posed[..., 3] + wandering[..., 3])[:, tables.VARYING]
        return displacement + length[..., None] * (anatomy - anatomy[:, tables.ANCHORS]), length

    def _hidden(self, view: _View, cover: FloatArray, nearer: FloatArray, rng: np.random.Generator) -> FloatArray:
        """(n, 25, 3) displacement of hidden joints; those of the trunk are not pulled to the hiding surface."""
        errors = self.errors
        half = 0.5 * errors.hidden_from
        hidden = np.clip((cover - half) / half, 0.0, 1.0)
        drawn = self._lag(errors.drag * hidden * np.where(tables.ON_TRUNK, 0.0, nearer))
        size = errors.guess * self._lag(hidden) * tables.SLOW_SCALE * view.distance
        guessed = size[..., None] * _RAY_AXES * self._wander((*cover.shape, 3), rng)
        guessed[..., 2] -= drawn
        return view.in_optical(guessed)

    @staticmethod
    def _keep_lengths(placed: FloatArray, anatomy: FloatArray, longer: FloatArray) -> None:
        """Move the limbs' joints of ``placed``, from the trunk outwards, so that limbs nearly keep their lengths."""
        for joints in tables.CHAINS:
            parents = tables.PARENTS[joints]
            way = placed[:, joints] - placed[:, parents]
            now = np.linalg.norm(way, axis=2)
            kept = np.linalg.norm(anatomy[:, joints] - anatomy[:, parents], axis=2) * (1.0 + longer[:, joints])
            placed[:, joints] += (_STIFFNESS * (kept - now) / np.maximum(now, 1e-3))[..., None] * way

    def _interpolate_spine(self, placed: FloatArray, view: _View) -> None:
        """Move SpineMid of ``placed`` to its interpolated place, by the share ``straightening`` of the way."""
        base, top = placed[:, Joint.SPINE_BASE], placed[:, Joint.SPINE_SHOULDER]
        chord = top - base
        back = np.linalg.norm(chord, axis=1, keepdims=True) * view.trunk[:, :, 0]
        middle = base + _SPINE_MID_SHARE * chord - _SPINE_MID_BACK * back
        placed[:, Joint.SPINE_MID] += self.errors.straightening * (middle - placed[:, Joint.SPINE_MID])

    def _new(self, view: _View, rng: np.random.Generator) -> FloatArray:
        """(n, 25, 3) white noise, and outliers of one to three frames."""
        errors, shape = self.errors, view.growth.shape
        noise = errors.white * (tables.WHITE_SCALE * view.growth)[..., None] * _RAY_AXES * rng.normal(size=(*shape, 3))
        result = view.in_optical(noise)
        for frame, joint in np.argwhere(rng.random(shape) < errors.outlier_rate * self.period):
            jump = rng.uniform(0.5, 1.5) * errors.outlier_size * _unit(rng.normal(size=3))
            result[frame : frame + rng.integers(1, 4), joint] += jump
        return result

    def _states(self, cover: FloatArray, in_view: BoolArray, rng: np.random.Generator) -> NDArray[np.uint8]:
        """(n, 25) tracking states."""
        errors, shape = self.errors, cover.shape
        hidden = self._lag(cover)
        # the state of a hidden joint persists for a while
        chance = self._wander(shape, rng)
        inferred = (hidden > errors.hidden_from) & (chance > ndtri(errors.mislabelled))
        lost = inferred & (hidden > _MIDDLE) & (chance > -ndtri(errors.given_up))
        flickers = rng.random(shape) < errors.flicker * tables.FLICKERS
        states = np.where(inferred | flickers, TrackingState.INFERRED, TrackingState.TRACKED).astype(np.uint8)
        states[lost | ~in_view] = TrackingState.NOT_TRACKED
        return states

    def _unseen(self, veiled: FloatArray) -> BoolArray:
        """(n,) whether the body is lost: most of the trunk is behind other people, or was within ``_FIND_AGAIN``."""
        hidden = (veiled[:, tables.ON_TRUNK] > self.errors.hidden_from).mean(axis=1) > _LOST_FROM
        until = np.convolve(hidden, np.ones(1 + round(_FIND_AGAIN / self.period)))[: len(hidden)]
        return until > 0.5

    def _wander(self, shape: tuple[int, ...], rng: np.random.Generator) -> FloatArray:
        """A smooth process of unit variance over the first axis: two Ornstein-Uhlenbeck processes in series.

        Its correlation is (1 + t) exp(-t) after a time t in units of half the ``drift_time`` (Matern, 3/2).
        """
        keep = np.exp(-2.0 * self.period / self.errors.drift_time)
        settle = int(np.ceil(5.0 * self.errors.drift_time / self.period))
        drive = rng.normal(size=(settle + shape[0], *shape[1:])) * np.sqrt((1.0 - keep**2) ** 3 / (1.0 + keep**2))
        result: FloatArray = lfilter([1.0], [1.0, -2.0 * keep, keep**2], drive, axis=0)[settle:]
        return result

    def _lag(self, values: FloatArray) -> FloatArray:
        """(n, ...) values through a first-order low-pass filter with time constant ``hang_over``."""
        keep = np.exp(-self.period / max(self.errors.hang_over, 1e-9))
        result: FloatArray
        result, _ = lfilter([1.0 - keep], [1.0, -keep], values, axis=0, zi=keep * values[:1])
        return result


def _events(times: FloatArray, rate: float, duration: float, rng: np.random.Generator) -> list[tuple[float, float]]:
    """(begin, end) in seconds of the events of a Poisson process, with exponential durations."""
    span = float(times[-1] - times[0]) if len(times) else 0.0
    begins = times[:1] + np.sort(rng.uniform(0.0, span, rng.poisson(rate * span)))
    return [(float(begin), float(begin + rng.exponential(duration))) for begin in begins]


def _unit(vectors: FloatArray) -> FloatArray:
    """(..., 3) vectors of length 1; 0 stays 0."""
    result: FloatArray = vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-9)
    return result


def _axes(up: FloatArray, across: FloatArray) -> FloatArray:
    """(n, 3, 3) forward, left and up as columns, from (n, 3) vectors up and roughly to the left."""
    up = _unit(up)
    left = _unit(across - (across * up).sum(axis=1, keepdims=True) * up)
    return np.stack([np.cross(left, up), left, up], axis=2)


def _thorax(sight: FloatArray) -> FloatArray:
    """(n, 3, 3) the thorax's axes (forward, left, up) as columns."""
    shoulders = sight[:, Joint.SHOULDER_LEFT] - sight[:, Joint.SHOULDER_RIGHT]
    return _axes(sight[:, Joint.SPINE_SHOULDER] - sight[:, Joint.SPINE_MID], shoulders)


def _trunk(sight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(n, 3, 3) the trunk's axes (forward, left, up) as columns, and (n,) radians from forward to the sensor."""
    axes = _axes(sight[:, Joint.SPINE_SHOULDER] - sight[:, Joint.SPINE_BASE], body_heading(sight))
    forward, left, _ = np.einsum("nik,ni->kn", axes, -sight[:, Joint.SPINE_SHOULDER])
    return axes, np.arctan2(left, forward)


def _least_rotation(start: FloatArray, end: FloatArray, vectors: FloatArray) -> FloatArray:
    """(..., 3) vectors rotated by the least rotation that takes unit vectors ``start`` to ``end``."""
    cos = (start * end).sum(axis=-1, keepdims=True)
    axis = np.cross(start, end)
    along = (axis * vectors).sum(axis=-1, keepdims=True) / np.maximum(1.0 + cos, 0.05)
    result: FloatArray = cos * vectors + np.cross(axis, vectors) + along * axis
    return result


def _in_view(sight: FloatArray) -> BoolArray:
    """(n, 25) which joints lie in the frustum and the range."""
    x, y, z = np.moveaxis(sight, 2, 0)
    across, down = (np.tan(0.5 * angle) * z for angle in FIELD_OF_VIEW)
    seen: BoolArray = (np.abs(x) <= across) & (np.abs(y) <= down) & (z >= RANGE[0]) & (z <= RANGE[1])
    return seen

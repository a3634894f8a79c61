"""Tracking of one person through depth images: segmentation, fit, detection of a lost fit.

Each fit starts from the predicted pose. A lost fit is tried again with a wide robust scale from the last pose, and then
by a search; a person who stays lost is searched for among the candidates of a person's size in turn. A walking person
is expected to face the walking direction: such starts are tried where the fit leaves points of the person unexplained.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from body_tracking.core import so3
from body_tracking.core.camera import Camera
from body_tracking.core.parameters import number_field
from body_tracking.core.skeleton import NANOSECONDS, BoolArray, FloatArray, Joint, SingleArray, Skeleton, TrackingState
from body_tracking.mesh.body_index import of_body_index
from body_tracking.mesh.body_model import Body, Pose, load
from body_tracking.mesh.depth import DepthCamera, supported
from body_tracking.mesh.energy import Observation, observe
from body_tracking.mesh.person import COVERED, NOBODY, REACH, PersonFinder, is_covered, near
from body_tracking.mesh.personalisation import personalise
from body_tracking.mesh.raster import render
from body_tracking.mesh.solver import SCALES, WIDE, Fit, MeshFitter, Orientation, Prediction, is_along
from body_tracking.mesh.uncertainty import kinect_landmarks, placed

_RATES: Final = {"shoulder": 9.0, "elbow": 9.0, "wrist": 9.0, "collar": 3.0}
_TRUNK_RATE: Final = 3.0
"""rad/s: standard deviation of a joint's change of angular velocity; arms, and all others."""
_SHIFT_RATE: Final = 1.0
"""m/s: standard deviation of the pelvis's change of velocity."""
_KEPT: Final = 0.7
"""Factor on the last change of pose in the prediction."""
_LONGEST_S: Final = 0.2
"""Longest time between two images for which their change of pose gives a rate, seconds."""
_COURSE_S: Final = 0.5
"""Seconds over which a walking person's velocity is measured."""
_SLOWEST: Final = 0.35
_FASTEST: Final = 3.0
"""m/s: horizontal speed of a walking person; a faster one indicates a change of person."""
_SMALLER: Final = (-1.6, -3.2)
"""First shape component (size) of smaller bodies, standard deviations: 1.55 and 1.42 m. The mean body of 1.69 m fits
people of 1.60 to 2 m."""
_FARTHER_OUT: Final = 0.03
"""Growth of the share of vertices outside of the silhouette above which hanging arms are no better fit."""
_WHOLE: Final = 0.99
"""Share of explained points below which a start with hanging arms is tried."""
_EXPLAINED: Final = 0.97
"""Share of explained points below which a hand may be at unexplained points."""
_ELSEWHERE: Final = 0.15
"""Metres: additional standard deviation per axis of such an arm's joints."""
_LIMBS: Final = {
    side: [Joint[f"{name}_{side.upper()}"] for name in ("ELBOW", "WRIST", "HAND", "HAND_TIP", "THUMB")]
    for side in ("left", "right")
}
_OUTSIDE: Final = 0.1
"""Share of seen vertices outside of the silhouette above which a start with a wide robust scale is tried."""
_SEEN: Final = 0.05
"""Metres: largest standard deviation per axis of a tracked joint; others are inferred."""


@dataclass(frozen=True, slots=True)
class TrackerParameters:
    """Settings of the tracker; each field's metadata states its meaning, unit and range."""

    points: int = field(
        default=600, metadata={"doc": "number of measured points of the person per fit", "min": 100, "max": 5000}
    )
    predict_for: float = number_field(0.5, "time for which a lost person is expected at the last place", "s", 0.0, 5.0)
    search_every: float = number_field(0.2, "time between two searches for a person", "s", 0.0, 10.0)


@dataclass(frozen=True, slots=True, eq=False)
class Tracked:
    """A person in one image.

    Attributes:
        stamp_ns: of the image.
        fit: of the body.
        points: (25, 3) joints of the Kinect's set, metres in the optical frame.
        covariance: (25, 3, 3) square metres.
    """

    stamp_ns: int
    fit: Fit
    points: FloatArray
    covariance: FloatArray

    def skeleton(self, frame_id: str, body: int = 0) -> Skeleton:
        """The joints as a sensor's skeleton; joints with a large covariance are inferred."""
        spread = np.sqrt(np.trace(self.covariance, axis1=1, axis2=2) / 3.0)
        states = np.where(spread < _SEEN, TrackingState.TRACKED, TrackingState.INFERRED).astype(np.uint8)
        return Skeleton(self.stamp_ns, frame_id, self.points, states, body, covariances=self.covariance)


class MeshTracker:
    """Tracks one person.

    Args:
        view: the depth camera.
        body: of the person.
        shape_covariance: (S, S) of the body's shape components.
        parameters: settings.
        counters: of a previous tracker to continue; None for new ones.

    Attributes:
        problem: why no person was found in the last image; "" if one was.
        counters: of images by outcome.
    """

    def __init__(
        self,
        view: DepthCamera,
        body: Body,
        shape_covariance: FloatArray,
        parameters: TrackerParameters | None = None,
        counters: Counter[str] | None = None,
    ) -> None:
        self.parameters = parameters or TrackerParameters()
        self.counters: Counter[str] = Counter() if counters is None else counters
        self._view, self._finder = view, PersonFinder(view)
        self.wear(body, shape_covariance)
        self.reset()

    def wear(self, body: Body, shape_covariance: FloatArray) -> None:
        """Change to another body, e.g. after a personalisation.

        With the mean body, a person whom it does not fit is searched for with smaller bodies, too.
        """
        self._shape_covariance = shape_covariance
        self._fitters = [MeshFitter(body)]
        if not body.shape.any():
            size = np.eye(len(body.shape))[0]
            self._fitters += [MeshFitter(body.model.body(share * size)) for share in _SMALLER]
        self._take(self._fitters[0])
        names = [name.rpartition("_")[2] for name in body.model.joint_names]
        self._rates = np.array([[_RATES.get(name, _TRUNK_RATE)] * 3 for name in names])

    def _take(self, fitter: MeshFitter) -> None:
        self._fitter, self._landmarks, self._smaller = fitter, kinect_landmarks(fitter.body), 0

    def reset(self) -> None:
        """Forget the person and the background."""
        self._take(self._fitters[0])
        self._finder.reset()
        self._fits: list[tuple[int, Fit]] = []
        self._lost_ns: int | None = None
        self._searched_ns: int | None = None
        self._arms_ns: int | None = None
        self._wide_ns: int | None = None
        self._places: list[tuple[int, FloatArray]] = []
        self._choice = 0
        self.problem = NOBODY
        self.observation: Observation | None = None

    @property
    def camera(self) -> Camera:
        """Intrinsics of the depth camera."""
        return self._view.camera

    @property
    def body(self) -> Body:
        """The body that is fitted."""
        return self._fitter.body

    def update(
        self,
        stamp_ns: int,
        depth: SingleArray,
        index: NDArray[np.uint8] | None = None,
        orientations: Sequence[Orientation] = (),
    ) -> Tracked | None:
        """Track the person in the next image.

        Args:
            stamp_ns: of the image, nanoseconds.
            depth: (height, width) metres, 0 where missing.
            index: (height, width) body-index image of the same time, if there is one.
            orientations: of inertial sensors.

        Returns:
            The person; None if nobody is found, or the fit is lost.

        Raises:
            DepthError: another size than the camera's.
        """
        self.counters["images"] += 1
        expected = self._fits[-1][1] if self._fits else None
        if index is not None:
            mask = self._indexed(index, depth, expected)
        else:
            found = self._finder.find(depth, None if expected is None else expected.posed.vertices, self._choice)
            mask, self.problem = found.mask, found.reason
        if self.problem:
            self.counters[self.problem] += 1
            self._forget(stamp_ns)
            return None
        self.observation = observe_person(self._view, depth, mask, self.parameters.points)
        if len(self.observation.points) < self.parameters.points // 4:
            self.problem = "too few points of the person for a fit"
            self.counters[self.problem] += 1
            self._forget(stamp_ns)
            return None
        since_ns = stamp_ns - round(_COURSE_S * NANOSECONDS)
        self._places = [each for each in self._places if since_ns <= each[0] < stamp_ns]
        self._places.append((stamp_ns, np.median(self.observation.points, axis=0)))
        fit = self._fit(stamp_ns, self.observation, orientations)
        if fit is None:
            return None
        if fit.lost:
            self.problem = f"the body does not fit: {fit.matched:.0%} of the points, {fit.violations:.0%} outside"
            self.counters["lost"] += 1
            self._choice += not self._fits
            self._forget(stamp_ns)
            return None
        self._lost_ns = None
        self._fits = [*self._fits[-1:], (stamp_ns, fit)]
        result = placed(self._fitter, fit, self.observation, self._landmarks, self._shape_covariance)
        elsewhere = self._fitter.unmatched(self.observation, fit) if fit.matched < _EXPLAINED else ()
        for side in elsewhere:
            self.counters["arms that may be elsewhere"] += 1
            result.covariance[_LIMBS[side]] += _ELSEWHERE**2 * np.eye(3)
        return Tracked(stamp_ns, fit, result.points, result.covariance)

    def _indexed(self, index: NDArray[np.uint8], depth: SingleArray, expected: Fit | None) -> BoolArray:
        """The person's mask from a body-index image."""
        self._view.check(depth)
        close = None if expected is None else near(expected.posed.vertices, depth, self._view.camera, REACH)
        mask, body = of_body_index(index, depth, close, self._choice)
        self.problem = COVERED if is_covered(depth) else NOBODY if body is None else ""
        return mask

    def _fit(self, stamp_ns: int, seen: Observation, orientations: Sequence[Orientation]) -> Fit | None:
        """The best available fit; None if it is not yet time to search again."""
        if self._fits:
            prediction = self._predicted(stamp_ns, seen)
            fit = self._fitter.fit(seen, prediction.pose, prediction, orientations)
            if not fit.lost:
                return self._or_better(stamp_ns, seen, orientations, fit)
            self.counters["second starts"] += 1
            fits = [fit, self._fitter.fit(seen, self._fits[-1][1].pose, None, orientations, scales=WIDE)]
            course = self._course()
            if (course is not None or all(each.lost for each in fits)) and self._may_search(stamp_ns):
                fits.append(self._fitter.search(seen, orientations, course))
            return min(fits, key=lambda each: (each.lost, each.energy))
        if not self._may_search(stamp_ns):
            self.problem = "searching"
            return None
        return self._searched(seen, orientations)

    def _searched(self, seen: Observation, orientations: Sequence[Orientation]) -> Fit:
        """The best fit of an untracked person; a smaller body is kept if only it fits."""
        course = self._course()
        fit = self._fitter.search(seen, orientations, course)
        if fit.lost and len(self._fitters) > 1:
            smaller = self._fitters[1 + self._smaller]
            self._smaller = (self._smaller + 1) % len(_SMALLER)
            found = smaller.search(seen, orientations, course)
            if not found.lost:
                self._take(smaller)
                return found
        return fit

    def _may_search(self, stamp_ns: int) -> bool:
        """Whether the last search is long enough ago; if so, this call counts as a search."""
        if self._waits(stamp_ns, self._searched_ns):
            return False
        self._searched_ns = stamp_ns
        self.counters["searches"] += 1
        return True

    def _waits(self, stamp_ns: int, last_ns: int | None) -> bool:
        """Whether an action last done at ``last_ns`` has to wait."""
        return last_ns is not None and 0 <= stamp_ns - last_ns < self.parameters.search_every * NANOSECONDS

    def _course(self) -> FloatArray | None:
        """(3,) velocity of a walking person in m/s, whose direction they face; None if the person may be standing."""
        (first_ns, first), (last_ns, last) = self._places[0], self._places[-1]
        elapsed = (last_ns - first_ns) / NANOSECONDS
        if elapsed < _COURSE_S / 5.0:
            return None
        velocity = (last - first) / elapsed
        return velocity if _SLOWEST < np.hypot(velocity[0], velocity[2]) < _FASTEST else None

    def _or_better(self, stamp_ns: int, seen: Observation, orientations: Sequence[Orientation], fit: Fit) -> Fit:
        """The fit, or a better one from another start.

        The trunk's surface can hold an arm that was hidden behind it for some images: a start with hanging arms frees
        it. A hand faster than predicted leaves unexplained points: starts with the hand there, and for a walking person
        those of a search. A trunk that turned faster than predicted leaves vertices outside of the silhouette: a start
        with a wide robust scale.
        """
        starts = [] if fit.matched >= _EXPLAINED else self._fitter.towards_unmatched(seen, fit)
        if starts:
            self.counters["starts with a hand elsewhere"] += 1
        fits = [self._fitter.fit(seen, start, None, orientations) for start in starts]
        if fit.matched < _WHOLE and not self._waits(stamp_ns, self._arms_ns):
            self._arms_ns = stamp_ns
            self.counters["starts with hanging arms"] += 1
            hanging = self._fitter.fit(seen, self._fitter.with_hanging_arms(fit.pose), None, orientations)
            # an arm that points at the camera is few points, and costs less energy where it hangs and explains none
            outside = hanging.violations - fit.violations
            fits += [hanging] if hanging.matched >= fit.matched and outside < _FARTHER_OUT else []
        if fit.violations > _OUTSIDE and not self._waits(stamp_ns, self._wide_ns):
            self._wide_ns = stamp_ns
            self.counters["starts with a wide scale"] += 1
            fits.append(self._fitter.fit(seen, self._fits[-1][1].pose, None, orientations, scales=WIDE))
        course = self._course()
        if fit.matched < _EXPLAINED and course is not None and self._may_search(stamp_ns):
            found = self._fitter.search(seen, orientations, course)
            # front and back look alike in depth, so a pose that faces away from the walking direction is rejected
            fits += [found] if is_along(found.pose, course) else []
        if not fits:
            return fit
        again = min(fits, key=lambda each: (each.lost, each.energy))
        here = self._fitter.evaluate(seen, fit.pose, SCALES[-1], None, orientations).fit
        return again if not again.lost and again.energy < here.energy else fit

    def _predicted(self, stamp_ns: int, seen: Observation) -> Prediction:
        """Prediction from the last pose and its last change."""
        last_ns, last = self._fits[-1]
        elapsed = max((stamp_ns - last_ns) / NANOSECONDS, 1e-3)
        pose = last.pose
        if len(self._fits) > 1:
            before_ns, before = self._fits[-2]
            between = (last_ns - before_ns) / NANOSECONDS
            if 0.0 < between < _LONGEST_S and elapsed < _LONGEST_S:
                share = _KEPT * elapsed / between
                turns = so3.rotation_vectors(before.pose.rotations.mT @ pose.rotations)
                rotations = pose.rotations @ so3.quat_to_matrix(so3.exp(share * turns))
                pose = Pose(rotations, pose.translation + share * (pose.translation - before.pose.translation))
        hidden = self._fitter.hidden(seen, last.posed.vertices)
        return Prediction(pose, 0.01 + _SHIFT_RATE * elapsed, 0.05 + self._rates * elapsed, hidden)

    def _forget(self, stamp_ns: int) -> None:
        """Note that the person is lost; after ``predict_for`` seconds forget them."""
        self._lost_ns = stamp_ns if self._lost_ns is None else self._lost_ns
        if self._fits and stamp_ns - self._lost_ns > self.parameters.predict_for * NANOSECONDS:
            self._fits = []
            self._take(self._fitters[0])
            self.counters["people lost"] += 1

    def state(self) -> dict[str, Any]:
        """Figures of the last fit, for diagnostics."""
        if not self._fits:
            return {"tracked": False, "problem": self.problem}
        fit = self._fits[-1][1]
        return {
            "tracked": not self.problem,
            "problem": self.problem,
            "points matched": round(fit.matched, 3),
            "outside of the silhouette": round(fit.violations, 3),
            "residual, mm": round(1e3 * fit.rms, 1),
        }


def observe_person(view: DepthCamera, depth: SingleArray, mask: BoolArray, count: int) -> Observation:
    """Observation of a person without flying pixels; arguments and errors as of :func:`observe`."""
    return observe(view, _without_flying(depth, mask), mask, count)


def _without_flying(depth: SingleArray, mask: BoolArray) -> SingleArray:
    """The image without pixels off surfaces, within the mask's bounding box."""
    left, top, width, height = cv2.boundingRect(mask.astype(np.uint8))
    # pixels at the border of a block have too few neighbours
    box = slice(max(top - 2, 0), top + height + 2), slice(max(left - 2, 0), left + width + 2)
    clean = depth.copy()
    block = np.ascontiguousarray(depth[box])
    clean[box] = np.where(supported(block), block, np.float32(0.0))
    return clean


@cache
def prepare() -> None:
    """Compile the loops, or load them, before the first image: detect, track and personalise a rendered person."""
    matrix = np.array([[92.0, 0.0, 64.0], [0.0, 92.0, 53.0], [0.0, 0.0, 1.0]])
    view = DepthCamera(Camera("prepared", 128, 106, matrix, np.zeros(5)))
    body = load().body()
    standing = MeshFitter(body).neutral(np.array([0.0, 0.0, 2.3]), 0.6, 0.3)
    person = render(body.posed(standing).vertices, body.model.faces, view.camera).depth
    wall = np.full_like(person, 4.0)
    depth = np.where(person > 0.0, person, wall)
    tracker = MeshTracker(view, body, np.eye(len(body.shape)))
    for stamp_ns, image in enumerate((wall, depth, depth)):
        tracker.update(stamp_ns * NANOSECONDS, image)
    assert tracker.observation is not None
    personalise(body.model, [tracker.observation], [standing])

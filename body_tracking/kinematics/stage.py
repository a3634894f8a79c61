"""Filtered skeletons, or the state of the filter's model, to joint angles: the stage of the node ``joint_angles``."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from body_tracking.core import so3
from body_tracking.core.estimate import ModelEstimate
from body_tracking.core.joint_angles import JointAngles
from body_tracking.core.measurement import BONE_CORRELATION
from body_tracking.core.parameters import Parameter, Value
from body_tracking.core.skeleton import NANOSECONDS, FloatArray, Skeleton
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, ConventionError, angles_of
from body_tracking.kinematics.positional import positional_angles
from body_tracking.kinematics.upper_body import UpperBody
from body_tracking.messages.codecs import Angles, ModelCovariance, ModelState
from body_tracking.pipeline import graph
from body_tracking.pipeline.pairs import Pairs
from body_tracking.pipeline.people import ALL, PEOPLE, people_from
from body_tracking.pipeline.shared import BODY, RELIABLE, result_qos, skeleton_input, skeleton_qos
from body_tracking.pipeline.stage import Now, Output, Port, Stage

if TYPE_CHECKING:
    from body_tracking.kinematics.skeleton_fit import SkeletonFit

ANGLES = (
    Parameter(
        "convention",
        graph.AUTO,
        "the angles: the model's own, those of the ISB, of REP-155, of Schlagenhauf (2017), or angles between joint "
        "positions; auto: model if the input is a model's state, else positional",
        choices=(graph.AUTO, *ALL_CONVENTIONS),
        live=True,
    ),
    Parameter(
        "input",
        graph.AUTO,
        "source of the angles: the state of the filter's model, or filtered skeletons, to which a model is fitted "
        "(but not for positional angles); auto: what the filter publishes, also when the filter changes",
        choices=(graph.AUTO, graph.SKELETON_INPUT, graph.MODEL_INPUT),
        live=True,
    ),
    Parameter(
        "bone_correlation",
        BONE_CORRELATION,
        "correlation of the errors of the two joints of a bone, for the deviations of positional angles: the default "
        "is a Kinect's; 0 for joints with independent errors, as those of cameras",
        min=0.0,
        max=0.99,
        live=True,
    ),
)
"""The parameters of ``joint_angles`` that the offline graph has too."""


_AWAY_S = 1.0
"""With several people, a person's state is reset after an absence of this long, seconds."""
_BAND = 1.96
"""Standard deviations of a 95 % band."""
_DOUBT_S = 0.2
"""Seconds in which the doubt about an angle that has jumped falls to 1 / e."""
_UNPAIRED = 1000
"""Largest number of a person's states and covariances that wait for each other: the depth of reliable topics, because
a resent message comes late."""


class JumpDoubt:
    """Adds to the deviations of angles that have jumped.

    Where two successive estimates of an angle lie farther apart than both their 95 % bands allow, one of them was
    wrong, and nothing says which: sides were swapped, a limb was found again, or the convention's angles jumped back
    into their usual ranges. The deviation then covers the value before, and returns to the stated one within half a
    second or so.
    """

    def __init__(self) -> None:
        self._last: JointAngles | None = None
        self._doubt: FloatArray = np.zeros(0)

    def reset(self) -> None:
        """Forget the person."""
        self._last = None

    def __call__(self, angles: JointAngles) -> JointAngles:
        """The angles of the next instant, with their deviations, radians."""
        last, self._last = self._last, angles
        if last is None or last.names != angles.names:
            self._doubt = np.zeros(len(angles.names))
            return angles
        seconds = (angles.stamp_ns - last.stamp_ns) / NANOSECONDS
        moved = np.nan_to_num(0.5 * seconds * (last.velocity + angles.velocity))
        step = np.abs(so3.wrapped(angles.position - last.position - moved))
        jumped = step > _BAND * np.hypot(last.position_stddev, angles.position_stddev)  # never where one is NaN
        self._doubt *= math.exp(-max(seconds, 0.0) / _DOUBT_S)
        self._doubt = np.where(jumped, np.maximum(self._doubt, step / _BAND), self._doubt)
        return replace(angles, position_stddev=np.hypot(angles.position_stddev, self._doubt))


class AngleStream:
    """Joint angles in one convention, of skeletons or of states of ``upper_body``, one instant after the other.

    Args:
        convention: one of ``ALL_CONVENTIONS``.
        forget_after: seconds without the person after which the next frame is of another one.
        of_bones: correlation of the errors of the two joints of a bone, for positional angles.

    Raises:
        ConventionError: unknown convention.
    """

    def __init__(self, convention: str, forget_after: float = math.inf, of_bones: float = BONE_CORRELATION) -> None:
        if convention not in ALL_CONVENTIONS:
            raise ConventionError(f"angle convention {convention!r}: not one of {', '.join(ALL_CONVENTIONS)}")
        self.convention = convention
        self.model = UpperBody()
        self._fit: SkeletonFit | None = None
        self._previous: JointAngles | None = None
        self._doubt = JumpDoubt()
        self._forget_after_ns, self._of_bones = forget_after * NANOSECONDS, of_bones

    def reset(self) -> None:
        """Forget the person."""
        if self._fit is not None:
            self._fit.reset()
        self._doubt.reset()
        self._previous = None

    @property
    def counters(self) -> Counter[str]:
        """Events of the fits of the model to skeletons."""
        return Counter() if self._fit is None else self._fit.counters

    def prepare(self) -> SkeletonFit:
        """The fit of the model to skeletons; the first call compiles its loops, or loads them from the cache."""
        if self._fit is None:
            from body_tracking.kinematics.skeleton_fit import SkeletonFit  # imports numba: half a second

            self._fit = SkeletonFit()
        return self._fit

    def of_skeleton(self, skeleton: Skeleton) -> JointAngles | None:
        """The angles of one frame; None if the convention needs a model and no trunk is seen."""
        self._reset_after_gap(skeleton.stamp_ns)
        if self.convention == graph.POSITIONAL:
            self._previous = positional_angles(skeleton, self._of_bones)
            return self._doubt(self._previous)
        estimate = self.prepare().update(skeleton)
        return None if estimate is None else self.of_estimate(estimate)

    def of_estimate(self, estimate: ModelEstimate) -> JointAngles:
        """The angles of one state of the model.

        Raises:
            ConventionError: the convention is positional.
        """
        self._reset_after_gap(estimate.stamp_ns)
        angles = angles_of(estimate, self.model, self.convention, self._previous)
        self._previous = angles
        return self._doubt(angles)

    def _reset_after_gap(self, stamp_ns: int) -> None:
        if self._previous is not None and stamp_ns - self._previous.stamp_ns > self._forget_after_ns:
            self.reset()


def by_person(skeletons: Sequence[Skeleton], ids: Collection[str], *, several: bool) -> Iterator[tuple[str, Skeleton]]:
    """The skeletons of one message, each with the id of its person.

    Args:
        skeletons: as ``/filtered/skeleton`` has them.
        ids: of those who may be in it, in the order of their numbers.
        several: whether ``body`` is the number of a person; else the first skeleton is that of the only one.
    """
    for number, body in enumerate(ids, 1):
        if not several:
            yield body, skeletons[0]
            return
        yield from ((body, skeleton) for skeleton in skeletons if skeleton.body == number)


def state_estimate(
    model: UpperBody, stamp_ns: int, frame_id: str, q: FloatArray, velocity: FloatArray, covariance: FloatArray
) -> ModelEstimate:
    """An estimate of the pose, with default lengths of infinite standard deviation.

    Args:
        model: the body.
        stamp_ns: capture time, nanoseconds.
        frame_id: of the base.
        q: (nq,) configuration.
        velocity: (nv,) tangent velocity.
        covariance: (2 nv, 2 nv) of both.
    """
    lengths = model.default_lengths()
    return ModelEstimate(stamp_ns, frame_id, 0, q, velocity, covariance, lengths, np.full(len(lengths), np.inf))


class AnglesStage(Stage):
    """Computes the angles of one skeleton, or one state of the model, per message and person."""

    NAME = "joint_angles"
    PARAMETERS = (BODY, *(item for item in PEOPLE if item.name in ("subject", "people")), *ANGLES, RELIABLE)

    def __init__(self, values: Mapping[str, Value], wanted: Callable[[str], bool] = lambda topic: True) -> None:
        super().__init__(values, wanted)
        # which input the filter publishes: confirmed, and at the last check
        self._published = self._seen = ""
        self._configure(values)
        self._pairs = {body: Pairs(_UNPAIRED) for body in self.streams}
        qos = result_qos(values)
        self.outputs = tuple(
            Port(topic, Angles(body, part, lambda: self.convention), qos, measured=part == 0)
            for body in self.streams
            for part, topic in enumerate((graph.joint_states_topic(body), graph.joint_states_stddev_topic(body)))
        )

    @property
    def convention(self) -> str:
        """The convention of the published angles."""
        return next(iter(self.streams.values())).convention

    def change(self, values: Mapping[str, Value]) -> None:
        """New angles start from the next message on."""
        self._configure(values)
        self.values = values

    def _configure(self, values: Mapping[str, Value]) -> None:
        asked = str(values["convention"])
        known = self._published if values["input"] == graph.AUTO else str(values["input"])
        convention, source = graph.angles_for(asked, known or graph.SKELETON_INPUT)
        # No input before the source is known: the first angles could be of another convention than the later ones.
        self.source = source if known or asked == graph.POSITIONAL else ""
        people = people_from(values)
        self._several = people.subject == ALL
        of_bones = float(str(values["bone_correlation"]))
        body = graph.check_body(str(values["body"]))
        if self._several:
            self.streams = {each: AngleStream(convention, _AWAY_S, of_bones) for each in graph.bodies(people.people)}
        else:
            self.streams = {body: AngleStream(convention, of_bones=of_bones)}
        self._states: dict[str, str] = {}
        self._covariances: dict[str, str] = {}
        if self.source == graph.SKELETON_INPUT:
            self.inputs = (skeleton_input(graph.FILTERED, values),)
            for stream in self.streams.values() if convention != graph.POSITIONAL else ():
                stream.prepare()
        elif self.source == graph.MODEL_INPUT:
            qos, perishable = skeleton_qos(values), not values["reliable"]
            ports = []
            for body, stream in self.streams.items():
                topics = graph.model_topics(body, self._several)
                self._states[topics.state], self._covariances[topics.covariance] = body, body
                ports += [
                    Port(topics.state, ModelState(stream.model), qos, perishable=perishable),
                    Port(topics.covariance, ModelCovariance(stream.model), qos, perishable=perishable),
                ]
            self.inputs = tuple(ports)
        else:
            self.inputs = ()

    @property
    def _covariance(self) -> str:
        """The topic that only a filter with a model publishes."""
        return graph.model_topics(next(iter(self.streams)), self._several).covariance

    def look(self, published: Callable[[str], bool]) -> bool:
        """Subscribe to the topics that the filter publishes, once two checks agree: topics are discovered one by one.

        Nothing changes while there is no filter, as during its restart.
        """
        before, inputs = self._seen, ((graph.MODEL_INPUT, self._covariance), (graph.SKELETON_INPUT, graph.FILTERED))
        self._seen = next((source for source, topic in inputs if published(topic)), "")
        if self._seen != before or self._seen in ("", self._published):
            return False
        self._published = self._seen
        if self.values["input"] != graph.AUTO:
            return False
        self._configure(self.values)
        return True

    def take(self, topic: str, payload: Any, now: Now) -> Iterable[Output]:
        if topic in self._states:
            return self._pair(self._states[topic], payload[0], "state", payload)
        if topic in self._covariances:
            return self._pair(self._covariances[topic], payload[0], "covariance", payload[1])
        found = by_person(payload, self.streams, several=self._several)
        angles = ((body, self.streams[body].of_skeleton(skeleton)) for body, skeleton in found)
        return [output for body, each in angles if each is not None for output in _published(body, each)]

    def _pair(self, body: str, stamp_ns: int, part: str, value: Any) -> Iterable[Output]:
        """Compute once state and covariance are there."""
        found = self._pairs[body].add(stamp_ns, part, value)
        if found is None:
            return ()
        stream, (_, frame_id, q, velocity) = self.streams[body], found["state"]
        estimate = state_estimate(stream.model, stamp_ns, frame_id, q, velocity, found["covariance"])
        return _published(body, stream.of_estimate(estimate))

    def reset(self, topic: str) -> None:
        for stream in self.streams.values():
            stream.reset()
        for pairs in self._pairs.values():
            pairs.clear()

    def state(self, ros_ns: int) -> tuple[int, str, dict[str, object]]:
        """The convention, and the counters of the fits."""
        fits: Counter[str] = Counter()
        for stream in self.streams.values():
            fits.update(stream.counters)
        values: dict[str, object] = {f"fit {name}": count for name, count in fits.items()}
        if unpaired := sum(pairs.unpaired for pairs in self._pairs.values()):
            values["unpaired"] = unpaired
        if not self.source:
            return 1, "no filter publishes anything", values
        text = f"{self.convention} angles of {self.source}"
        if self.source == graph.MODEL_INPUT != self._seen:
            return 1, f"{text}, but no filter publishes {self._covariance}", values
        if fits["no trunk"] > fits["frames"]:
            return 1, f"{text} need two joints of the spine, which are not seen: {_WITHOUT_TRUNK}", values
        return 0, text, values


_WITHOUT_TRUNK = f"filter ekf needs the shoulders alone, convention {graph.POSITIONAL} has the elbows"


def _published(body: str, angles: JointAngles) -> tuple[Output, Output]:
    return (
        Output(graph.joint_states_topic(body), angles, angles.stamp_ns),
        Output(graph.joint_states_stddev_topic(body), angles, angles.stamp_ns),
    )

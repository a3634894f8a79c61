"""The second half of the offline graph in its own processes: one filters, one computes angles and writes the bag.

With ``ekf`` the filter takes as long as all the rest; the results are the same as in one process.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import threading
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from body_tracking.core.parameters import Value
from body_tracking.core.qos import Qos
from body_tracking.pipeline import graph
from body_tracking.pipeline.offline import OfflineRunner
from body_tracking.pipeline.stage import Stage
from body_tracking.pipeline.system import Place
from body_tracking.recording.rosbag2 import BAG_WIRE, BagError, BagWriter, remove_file
from body_tracking.systems import NODES, stage_class

_BATCH = 128
"""Messages per batch through the pipe: a batch by itself costs as much as several messages."""


@dataclass(frozen=True, slots=True)
class Written:
    """Result of the second half, or of its last part.

    Attributes:
        frames: number of joint angle messages.
        counters: of the filter, and of unusable messages.
        problems: of the stages at the end, in words.
    """

    frames: int
    counters: Mapping[str, int]
    problems: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class StageSettings:
    """A stage of the graph.

    Attributes:
        node: name of the node that would host it.
        executable: of that node.
        values: of all its parameters.
    """

    node: str
    executable: str
    values: Mapping[str, Value]

    def make(self) -> Stage:
        """The stage; BodyTrackingError for invalid parameters."""
        return stage_class(self.executable)(self.values)


@dataclass(frozen=True, slots=True)
class Job:
    """Parameters of the second half, or of its last part.

    Attributes:
        stages: in the order in which messages go through them.
        out: the bag to write.
        topics: type and QoS of further topics to write.
        overwrite: replace an existing ``out``.
        model_covariance: also write the covariance of the filter's model.
    """

    stages: Sequence[StageSettings]
    out: Path
    topics: Mapping[str, tuple[str, Qos]]
    overwrite: bool
    model_covariance: bool


def is_second(executable: str) -> bool:
    """Whether a stage belongs to the second half."""
    return NODES[executable].place >= Place.FILTER


class Downstream:
    """Runs the second half: the filter in this process, the stages after it by ``follow``.

    Args:
        job: of the second half.
        follow: constructs the runner of the stages after the filter, which writes the bag; None for :class:`Last`.

    Raises:
        BodyTrackingError: ``out`` cannot be written, or invalid parameters.
    """

    def __init__(self, job: Job, follow: Callable[[Job], Last | ForkedDownstream] | None = None) -> None:
        filters = [each for each in job.stages if is_second(each.executable) and not _is_last(each.executable)]
        self._stages = {each.node: each.make() for each in filters}
        self._runner = OfflineRunner([*self._stages.values()], BAG_WIRE, self._published, job.topics)
        own = {p.topic: (p.codec.type_name, p.qos) for p in self._runner.outputs if not p.optional}
        rest = [each for each in job.stages if each not in filters]
        self._next = (follow or Last)(replace(job, stages=rest, topics={**job.topics, **own}))

    def take(self, topic: str, cdr: bytes, at_ns: int) -> None:
        self._next.take(topic, cdr, at_ns)
        self._runner.push(topic, cdr, at_ns)

    def _published(self, topic: str, cdr: bytes, at_ns: int) -> None:
        self._next.take(topic, cdr, at_ns)

    def finish(self, at_ns: int) -> Written:
        """Close the bag, or remove it if it has no angles."""
        self._runner.finish(at_ns)
        written = self._next.finish(at_ns)
        # both may have counted the same message
        counters = Counter(_counters(self._stages.values(), self._runner)) | Counter(written.counters)
        return Written(written.frames, counters, (*problems_of(self._stages, self._runner, at_ns), *written.problems))

    @property
    def path(self) -> Path | None:
        """The file of the bag."""
        return self._next.path

    def abandon(self) -> None:
        """Remove the unfinished bag."""
        self._next.abandon()


class Last:
    """Runs the stages after the filter, and writes every message; errors as of :class:`Downstream`."""

    def __init__(self, job: Job) -> None:
        self._stages = {each.node: each.make() for each in job.stages if _is_last(each.executable)}
        self._runner = OfflineRunner([*self._stages.values()], BAG_WIRE, self._published, job.topics)
        self._covariance = job.model_covariance
        self._frames = 0
        self._writer = BagWriter(job.out, overwrite=job.overwrite)
        own = {p.topic: (p.codec.type_name, p.qos) for p in self._runner.outputs if not p.optional}
        for topic, (type_name, qos) in {**job.topics, **own}.items():
            if self._written(topic):
                self._writer.add_topic(topic, type_name, qos)

    def take(self, topic: str, cdr: bytes, at_ns: int) -> None:
        if self._written(topic):
            self._writer.write(topic, cdr, at_ns)
        self._runner.push(topic, cdr, at_ns)

    def _written(self, topic: str) -> bool:
        return self._covariance or not graph.is_model_covariance(topic)

    def _published(self, topic: str, cdr: bytes, at_ns: int) -> None:
        self._frames += topic.endswith("/joint_states")
        self._writer.write(topic, cdr, at_ns)

    def finish(self, at_ns: int) -> Written:
        self._runner.finish(at_ns)
        if self._frames:
            self._writer.close()
        else:
            self._writer.discard()
        counters = _counters(self._stages.values(), self._runner)
        return Written(self._frames, counters, problems_of(self._stages, self._runner, at_ns))

    @property
    def path(self) -> Path:
        return self._writer.path

    def abandon(self) -> None:
        self._writer.discard()


def problems_of(stages: Mapping[str, Stage], runner: OfflineRunner, at_ns: int) -> tuple[str, ...]:
    """What is wrong in stages, by node, at a time, and with their inputs, in words."""
    states = {node: stage.state(at_ns) for node, stage in stages.items()}
    return (*(f"{node}: {text}" for node, (level, text, _) in states.items() if level and text), *runner.problems)


def _is_last(executable: str) -> bool:
    """Whether a stage comes after the filter."""
    return NODES[executable].place > Place.FILTER


def _counters(stages: Iterable[Stage], runner: OfflineRunner) -> dict[str, int]:
    counters = {
        f"{'filter' if stage.NAME == 'skeleton_filter' else stage.NAME} {name}": count
        for stage in stages
        for name, count in stage.counters.items()
    }
    return {**counters, **runner.counters}


class ForkedDownstream:
    """:class:`Downstream` in its own process, with a child process for :class:`Last`; errors as of :class:`Downstream`.

    Args:
        job: of the second half.
        last: the process runs only :class:`Last`.
    """

    def __init__(self, job: Job, *, last: bool = False) -> None:
        context = multiprocessing.get_context("fork")
        self._connection, remote = context.Pipe()
        # Removed if the process is killed before it reports its file, unless the bag existed before.
        self.path = None if job.out.exists() else job.out.absolute() / f"{job.out.absolute().name}_0.mcap"
        # a daemon may have no child
        self._process = context.Process(target=_serve, args=(self._connection, remote, job, last), daemon=last)
        self._batch: list[tuple[str, bytes, int]] = []
        self._error: BaseException | None = None
        with warnings.catch_warnings():
            # Python 3.12 warns of forking with threads; those of the numeric libraries handle it.
            warnings.simplefilter("ignore", DeprecationWarning)
            enabled = gc.isenabled()
            gc.disable()  # until gc.freeze() in the other process
            try:
                self._process.start()
            finally:
                if enabled:
                    gc.enable()
        remote.close()
        self.path = self._receive()

    def take(self, topic: str, cdr: bytes, at_ns: int) -> None:
        self._batch.append((topic, cdr, at_ns))
        if len(self._batch) >= _BATCH:
            self._send()

    def finish(self, at_ns: int) -> Written:
        self._send()
        self._connection.send(at_ns)
        written = self._receive()
        self._process.join()
        assert isinstance(written, Written)
        return written

    def abandon(self) -> None:
        """Remove the unfinished bag."""
        self._connection.close()
        self._process.join()
        if self.path is not None:
            remove_file(self.path)  # still there where the other process was killed

    def _send(self) -> None:
        if self._error is not None:  # raised before, but a runner took it for an error of its stages
            raise self._error
        try:
            self._connection.send(self._batch)
        except (BrokenPipeError, ConnectionResetError):
            self._receive()  # raises the error of the other process
        self._batch = []

    def _receive(self) -> Any:
        try:
            answer = self._connection.recv()
        except (EOFError, ConnectionResetError):  # the latter if it left data unread
            self.abandon()
            answer = BagError(f"the process that writes the bag ended with code {self._process.exitcode}")
        if isinstance(answer, BaseException):
            self._process.join()
            self._error = answer
            raise answer
        return answer


def _serve(inherited: Connection, connection: Connection, job: Job, last: bool) -> None:
    """Main function of the other process."""
    # With this copy of the first process's end open, recv() would not notice that it was closed there.
    inherited.close()
    # Inherited garbage must not be collected here: ROS nodes, whose threads do not exist in this process, would crash.
    gc.freeze()
    gc.enable()
    downstream: Downstream | Last | None = None
    try:
        downstream = Last(job) if last else Downstream(job, partial(ForkedDownstream, last=True))
        connection.send(downstream.path)
        while isinstance(batch := connection.recv(), list):
            for topic, cdr, at_ns in batch:
                downstream.take(topic, cdr, at_ns)
        connection.send(downstream.finish(batch))
    except (EOFError, BrokenPipeError, ConnectionResetError, KeyboardInterrupt):  # the first process has ended
        if downstream is not None:
            downstream.abandon()
    except BaseException as error:
        if downstream is not None:
            downstream.abandon()
        connection.send(error)


def start_downstream(job: Job) -> Downstream | ForkedDownstream:
    """The second half, in other processes if the platform allows it and there are two processors.

    Raises:
        BodyTrackingError: as of :class:`Downstream`.
    """
    if hasattr(os, "fork") and len(os.sched_getaffinity(0)) > 1 and threading.active_count() == 1:
        return ForkedDownstream(job)
    return Downstream(job)

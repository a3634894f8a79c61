"""Names of topics: relative to a node's namespace, full, and back."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from body_tracking.core import names
from body_tracking.core.names import NamespaceError, check_namespace, relative, resolved, rig_namespace, within
from body_tracking.pipeline import graph

PART = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,5}", fullmatch=True)
NAMESPACE = st.lists(PART, max_size=3).map(lambda parts: f"/{'/'.join(parts)}")
TOPIC = st.sampled_from(
    [
        graph.skeleton_topic("kinect1"),
        graph.FUSED,
        graph.CALIBRATION_CLOCK,
        graph.joint_states_topic("body1"),
        "/forearm_left/imu/data",
        *names.WHOLE_DOMAIN,
    ]
)


@given(NAMESPACE, TOPIC)
def test_resolved_and_within_are_inverse(namespace: str, topic: str) -> None:
    assert within(resolved(topic, namespace), namespace) == topic
    assert resolved(topic, "/") == topic == within(topic, "/")
    assert relative(topic) in (topic, topic[1:])


@given(NAMESPACE)
def test_namespace_of_a_rig_is_found_by_skeletons_or_persons(namespace: str) -> None:
    for topic in (graph.skeleton_topic("kinect1"), graph.joint_states_topic("body1")):
        assert rig_namespace([resolved(topic, namespace), graph.TF, "/somebody/else"]) == namespace
    rig = [resolved(topic, namespace) for topic in (graph.skeleton_topic("a"), graph.FUSED, graph.TRUE_SKELETON)]
    assert rig_namespace(rig) == namespace
    assert rig_namespace([*rig, resolved(graph.FUSED, f"{namespace.rstrip('/')}/other")]) == "/"


def test_another_namespace_is_outside() -> None:
    assert within("/lab/fused/skeleton", "/la") is None
    assert within("/laboratory/fused/skeleton", "/lab") is None
    assert within("/fused/skeleton", "/lab") is None
    assert rig_namespace([]) == rig_namespace(["/tf", "/kinect1/points"]) == "/"


def test_a_namespace_is_written_as_ros_does_or_refused() -> None:
    for text, written in {"": "/", "/": "/", "lab": "/lab", "/lab/": "/lab", "lab/left": "/lab/left"}.items():
        assert check_namespace(text) == written
    for text in ("la b", "9", "lab//left", "lab-1", "lab/9"):
        with pytest.raises(NamespaceError, match="namespace"):
            check_namespace(text)

"""The content of a recording in words: its sensors, and the results in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, IMU, POINT_CLOUD
from body_tracking.core.parameters import Value
from body_tracking.markers import setup
from body_tracking.pipeline import graph

_COLOURS = ("color", "colour", "rgb")


@dataclass(frozen=True, slots=True)
class Content:
    """What is in a recording.

    Attributes:
        sources: names of the sensors of each kind, such as ``IMUs``; none for points of several cameras together.
        bodies: whose joint angles are in it, by which it is a result of ``replay`` or of a running graph.
    """

    sources: Mapping[str, tuple[str, ...]]
    bodies: tuple[str, ...]

    def without(self, options: Mapping[str, Value]) -> Mapping[str, tuple[str, ...]]:
        """The sources that a graph with these options does not take."""
        taken = {name: _names(options.get(name)) for name in ("sensors", "camera", "depth", "imus")}
        markers = bool(options.get("marker_setup"))
        images = markers or bool(options.get("camera_rig"))
        left: dict[str, tuple[str, ...]] = {}
        for kind, names in self.sources.items():
            if (kind == _SKELETONS and options.get("computed")) or (kind == _POINTS and markers):
                continue
            if kind.endswith("images"):
                own = names if images else (*taken["camera"], *(taken["depth"] if kind == _DEPTH else ()))
            else:
                own = taken["sensors" if kind == _SKELETONS else "imus"] if kind != _POINTS else ()
            rest = tuple(name for name in names if name not in own)
            if rest or not names:
                left[kind] = rest
        return left


_SKELETONS, _IMUS, _POINTS, _DEPTH = "sensors", "IMUs", "marker points", "depth images"


def content_of(topics: Mapping[str, str]) -> Content:
    """The content of a recording.

    Args:
        topics: type by name, in the root namespace.
    """
    found: dict[str, set[str]] = {_SKELETONS: set(graph.sensors_among(topics))}
    for name, type_name in topics.items():
        sensor, *rest = name.removeprefix("/").split("/")
        if type_name == IMU and sensor != "imu":  # /imu/<segment>/orientation is estimated
            found.setdefault(_IMUS, set()).add(sensor)
        elif type_name in (IMAGE, COMPRESSED_IMAGE):
            colour = any(word in name for word in _COLOURS)
            kind = _DEPTH if "depth" in rest else "colour images" if colour else "images"
            found.setdefault(kind, set()).add(sensor)
        elif type_name == POINT_CLOUD and (name == setup.POINTS or rest == ["balls"]):
            found.setdefault(_POINTS, set()).update((sensor,) if rest == ["balls"] else ())
    sources = {kind: tuple(sorted(names)) for kind, names in found.items() if names or kind != _SKELETONS}
    return Content(sources, graph.bodies_among(topics))


def in_words(sources: Mapping[str, Sequence[str]]) -> str:
    """Such as ``IMUs forearm_left; depth images of kinect1``."""
    return "; ".join(
        f"{kind}{' of' * (kind not in (_SKELETONS, _IMUS))} {', '.join(names)}" if names else kind
        for kind, names in sources.items()
    )


def _names(value: Value | None) -> tuple[str, ...]:
    """The names in an option of sensors, as in ``forearm_left:imu_forearm_left``."""
    return tuple(part for each in value for part in each.split(":")) if isinstance(value, tuple) else ()

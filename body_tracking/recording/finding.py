"""The recordings of a folder, and those that come with the package."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Collection, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Final

import body_tracking
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.message_types import COMPRESSED_IMAGE, IMAGE, IMU, POINT_CLOUD
from body_tracking.core.parameters import Value
from body_tracking.markers import setup
from body_tracking.messages.codecs import Skeletons
from body_tracking.pipeline import graph
from body_tracking.pipeline.roles import DEFAULT_FILTER, role_of
from body_tracking.pipeline.system import Option
from body_tracking.recording.rosbag2 import BAG_WIRE, BagReader
from body_tracking.systems import OPTIONS

SETUPS: Final[Mapping[str, Mapping[str, Value]]] = {
    "cameras_turning": {"camera_rig": "config/camera_rig", "compressed": "colour"},
    "markers_arm": {"marker_setup": "config/marker_setup", "sensors": ()},
    "mesh_reaching": {"depth": ("kinect1",)},
}
"""Options of ``up`` for those shipped recordings whose topics do not determine them."""

_CAMERAS: Final = ("--camera", "--camera-rig", "--depth", "--marker-setup")
_COLOUR, _DEPTH = ("color", "colour", "rgb"), ("depth", "stereo")
"""Words in the names of the topics of drivers."""
_BALLS: Final = "/balls"
_ESTIMATED: Final = ("/imu/", "/humans/")
"""Topics of what the graph estimates, of the same types as those of sensors."""
_BY_TYPE: Final[Mapping[str, tuple[str, ...]]] = {
    IMAGE: _CAMERAS,
    COMPRESSED_IMAGE: _CAMERAS,
    IMU: ("--imus",),
}


def options_for_topic(name: str, type_name: str) -> tuple[str, ...]:
    """The options of ``up`` and ``replay`` that take a topic that is no skeleton; none if nothing takes it."""
    if type_name == POINT_CLOUD and name.endswith((setup.POINTS, _BALLS)):
        return ("--marker-setup",)
    if name.startswith(_ESTIMATED):
        return ()
    return _BY_TYPE.get(type_name, ())


def _takers(topics: Mapping[str, str]) -> dict[str, tuple[str, ...]]:
    """The options that take each topic that is no skeleton, given the topics' types."""
    found = {name: options_for_topic(name, type_name) for name, type_name in topics.items()}
    found = {name: options for name, options in found.items() if options}
    for source in {name.split("/")[1] for name, options in found.items() if options == _CAMERAS}:
        own = [name for name, options in found.items() if name.startswith(f"/{source}/") and options == _CAMERAS]
        colour, depth = (any(word in name for name in own for word in words) for words in (_COLOUR, _DEPTH))
        if colour or depth:
            options = ("--camera",) * (colour and depth) + ("--camera-rig",) * colour + ("--depth",) * depth
            found |= dict.fromkeys(own, options)
    for camera in (name.removesuffix(_BALLS) for name in topics if name.endswith(_BALLS)):
        # its images are of the infrared camera that sees the balls
        found |= {name: ("--marker-setup",) for name in found if name.startswith(f"{camera}/")}
    return found


def advice_for(topics: Mapping[str, str], command: str = "the command") -> str:
    """The option to add for a recording of these topics without skeletons; empty if nothing takes them.

    Args:
        topics: type by name.
        command: to which it is added.
    """
    found = _takers(topics)
    options = sorted(set(chain.from_iterable(found.values())))
    if not options:
        return ""
    page = " (docs/markers.md says how to make a setup)" if ("--marker-setup",) in found.values() else ""
    flags = [f"{option} {_option(option).metavar}" for option in options]
    return f"add to {command} the option that takes them: {listed(flags, 'or')}{page}"


def unused(topics: Mapping[str, str], options: Mapping[str, Value]) -> str:
    """The sources in a recording that a graph leaves out, after the options that take them; empty if there are none.

    Args:
        topics: type by name.
        options: of the graph.
    """
    left: dict[tuple[str, ...], set[str]] = {}
    for topic, takers in _takers(topics).items():
        source = topic.split("/")[1]
        given = [options.get(_option(each).name) for each in takers]
        # a folder takes all of its kind, names take what they name, as in SEGMENT:NAME
        taken = {part for each in given if isinstance(each, tuple) for name in each for part in name.split(":")}
        if source not in taken and not any(each for each in given if isinstance(each, str)):
            left.setdefault(takers, set()).add(source)
    sensors, computed = (options.get(name) for name in ("sensors", "computed"))
    if isinstance(computed, tuple) and computed and sensors == computed and (there := graph.sensors_among(topics)):
        left[("--sensors",)] = {*there} - {*computed}
    return "; ".join(f"{listed(takers, 'or')}: {', '.join(sorted(names))}" for takers, names in left.items() if names)


def unused_imus(options: Mapping[str, Value]) -> str:
    """A line that says that the filter of a graph leaves out its inertial sensors; empty where something uses them.

    Args:
        options: of the graph.
    """
    alone = not options["sensors"]
    if not options["imus"] or alone or options["depth"] or role_of(options).input == graph.SENSORS_INPUT:
        return ""
    return f"the filter {options['filter'] or DEFAULT_FILTER} does not use the inertial sensors: --filter ekf does"


def _option(flag: str) -> Option:
    return OPTIONS[flag.removeprefix("--").replace("-", "_")]


def with_covariances(bag: BagReader, wanted: Collection[str] = ()) -> tuple[str, ...]:
    """The sensors in a recording whose skeletons have covariances: cameras and others, but no Kinect v2.

    Args:
        bag: open.
        wanted: sensor names; all in the bag when empty.
    """
    found = []
    for sensor in graph.sensors_among(bag.topics):
        if wanted and sensor not in wanted:
            continue
        topic = graph.skeleton_topic(sensor)
        first = next(iter(bag.messages({topic})), None) if bag.topics[topic].type_name == POINT_CLOUD else None
        with contextlib.suppress(BodyTrackingError):  # a malformed message; who reads them all counts it
            if first and Skeletons().decode(first.cdr, BAG_WIRE)[0].covariances is not None:
                found.append(sensor)
    return tuple(found)


def listed(names: Sequence[str], last: str = "and") -> str:
    """``a, b and c``."""
    *others, final = names
    return f"{', '.join(others)} {last} {final}" if others else final


def is_bag(path: Path) -> bool:
    """Whether this is a rosbag2 folder, or a single mcap file."""
    return path.suffix == ".mcap" or (path / "metadata.yaml").is_file() or any(path.glob("*.mcap"))


def bags_in(folder: Path) -> tuple[Path, ...]:
    """The folder itself if it is a recording; else those in it, in its folder ``bags`` and in those of ``make demo``,
    newest first, without those of the package.
    """
    try:
        if is_bag(folder):
            return (folder,)
        places = (folder, folder / "bags", *folder.glob("demo*_output"))
        shipped = {each.parent.resolve() for each in shipped_bags()}
        places = tuple(each for each in places if each.is_dir() and each.resolve() not in shipped)
        found = [each for place in places for each in place.iterdir()]
        found = [each for each in found if is_bag(each)]
        return tuple(sorted(found, key=lambda each: (-each.stat().st_mtime, each.name)))
    except OSError:  # no permission to read a folder, or a bag was deleted meanwhile
        return ()


def shipped_bags() -> tuple[Path, ...]:
    """The recordings of the repository or of the installed package."""
    found = _shipped()
    bags = [] if found is None else filter(is_bag, (found / "bags").iterdir())
    # those of skeletons first, which need no options
    return tuple(sorted(bags, key=lambda bag: (not bag.name.startswith("tpose"), bag.name)))


def shipped_setup(bag: Path) -> Mapping[str, Value]:
    """Options of ``up`` that a shipped recording needs; none for other recordings."""
    found = _shipped()
    if found is None or bag.resolve().parent != (found / "bags").resolve():
        return {}
    own = SETUPS.get(bag.name, {})
    return {name: str(found / each) if isinstance(each, str) and "/" in each else each for name, each in own.items()}


def _shipped() -> Path | None:
    """The folder with ``bags`` and ``config``."""
    beside = Path(body_tracking.__file__).parents[1]
    places = (beside, *(each / "share" / "body_tracking" for each in (Path(sys.prefix), *beside.parents)))
    return next((place for place in places if (place / "bags").is_dir()), None)

"""``body_tracking view``: a page on which a recording or sensors are chosen, and which then shows the graph.

The start page and the graph's own page (node ``viewer``) have the same address, one after the other: a browser that is
open connects again by itself. The graph is that of ``body_tracking up``.
"""

from __future__ import annotations

import argparse
import os
import queue
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from body_tracking.core import names
from body_tracking.core.arguments import Parser
from body_tracking.core.errors import BodyTrackingError
from body_tracking.core.extras import pip_install
from body_tracking.core.parameters import Value
from body_tracking.core.skeleton import NANOSECONDS
from body_tracking.node_parameters import parameters_for
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import NodeSpec
from body_tracking.recording.finding import advice_for, bags_in, listed, shipped_bags, shipped_setup, unused
from body_tracking.recording.rig import RigReader
from body_tracking.ros import dds
from body_tracking.ros.up import NoSourceError, UpError, has_sensors, no_ros, options_for, supervise
from body_tracking.systems import OPTIONS, add_options, all_nodes_for, names_sensors, options_from, options_of

_NOT_HERE: Final = ("bag", "loop", "start", "record", "external", "viewer")
"""Options of ``up`` that are chosen on the page."""
_PORT: Final = 8080
_PERIOD_S: Final = 0.5
"""Seconds between two checks of the ROS domain."""
_FOLDER_S: Final = 5.0
"""Seconds between two checks of the folder."""
_SEEN_S: Final = 0.7
"""Seconds for the browsers to show that a graph starts, before the page is closed."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add ``view`` to the ``body_tracking`` command."""
    parser = subparsers.add_parser(
        "view",
        description="Open a page in the browser that lists recordings, sensors that publish and nodes. What is chosen "
        "there runs as with body_tracking up, and the page shows it; graph: end leads back to the list. Ctrl-C ends.",
        epilog="The options hold for all that is started from the page.",
    )
    if isinstance(parser, Parser):
        parser.about_bag = "the page lists the recordings; `body_tracking up --bag BAG --viewer` shows one at once"
    add_options(parser, *(name for name, each in OPTIONS.items() if not each.hidden and name not in _NOT_HERE))
    parser.add_argument("--log-dir", type=Path, metavar="FOLDER", help="folder for logs (default: that of ROS)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking view``."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a script's background jobs ignore SIGINT
    dds.stay_on_this_machine()
    dds.prepare()
    try:
        import rclpy  # noqa: F401
    except ImportError as error:
        raise no_ros(error) from error
    given = _viewer_parameters(args)
    host, port, said = str(given.get("host", "127.0.0.1")), int(str(given.get("port", _PORT))), ("", "")
    choice: Any = None
    try:
        while True:
            port, choice, found = _choose(args, host, port, *said, choice)
            what = choice.bag.name if choice.bag is not None else "the graph"
            try:
                settings: dict[str, dict[str, Value]] = {
                    "viewer": {"host": host, "port": port, "start_page": True},
                    "bag_player": {"on_end": "idle"},  # the curves stay
                }
                supervisor = supervise(_graph(args, choice), found, settings)
            except BodyTrackingError as error:
                said = str(error), "failed"
                continue
            if supervisor.interrupted:
                return 0
            said = (supervisor.failure, "failed") if supervisor.failure else (f"{what} has ended; choose again.", "")
    except KeyboardInterrupt:
        return 0


def _viewer_parameters(args: argparse.Namespace) -> Mapping[str, Value]:
    """The viewer's parameters in the parameters file, if there is one."""
    options = options_of(namespace=names.check_namespace(args.namespace or "/"))
    viewer = NodeSpec("viewer", "viewer", str(options["namespace"]))
    return parameters_for([viewer], args.params_file, None, all_nodes_for(options))["viewer"]


def _graph(args: argparse.Namespace, choice: Any) -> argparse.Namespace:
    """The command line of ``up`` for a choice."""
    from body_tracking.viewing.start_page import DEFAULT

    chosen: dict[str, Any] = {name: OPTIONS[name].default or None for name in _NOT_HERE}
    chosen |= {"bag": choice.bag, "loop": choice.loop, "start": 0.0, "external": False, "viewer": True}
    if choice.bag is not None and not names_sensors(options_from(args)):
        setup = dict(shipped_setup(choice.bag))
        if setup.pop("sensors", None) is not None:
            chosen["sensors"] = [graph.NO_SENSORS]
        chosen |= setup
    if choice.filter != DEFAULT:
        chosen["filter"] = choice.filter
    if choice.convention != DEFAULT:
        chosen["convention"] = choice.convention
    return argparse.Namespace(**{**vars(args), **chosen})


def _choose(
    args: argparse.Namespace, host: str, port: int, said: str, how: str, before: Any
) -> tuple[int, Any, Mapping[str, Value]]:
    """Show the start page until the user has chosen: its port, the choice, and options for the sensors.

    Without a choice ``before`` this is the first page, whose address is printed.
    """
    try:
        from body_tracking.viewing.start_page import StartPage
    except ImportError as error:
        raise UpError(f"the page needs viser ({error}): {pip_install('viewer')}") from error
    from body_tracking.filters import FILTERS
    from body_tracking.kinematics.conventions import ALL_CONVENTIONS
    from body_tracking.ros.discovery import Domain, Watch
    from body_tracking.viewing.state import GREEN, ORANGE, RED

    named = (args.params_file is not None and has_sensors(args.params_file)) or names_sensors(options_from(args))
    chosen: queue.Queue[Any] = queue.Queue()
    with (
        StartPage(host, port, tuple(FILTERS), tuple(ALL_CONVENTIONS), chosen.put, before) as page,
        Watch(args.namespace or "/") as watch,
    ):
        if before is None:
            print(f"open {page.address} in a browser; Ctrl-C ends", flush=True)
        if said:
            page.say(said, RED if how == "failed" else GREEN)
        known: dict[Path, Any] = {}
        looked, found = 0.0, Domain()
        while True:
            if time.monotonic() - looked > _FOLDER_S:
                page.draw_recordings(_recordings(args, known))
                looked = time.monotonic()
            try:
                choice = chosen.get(timeout=_PERIOD_S)
                break
            except queue.Empty:
                found = watch.now()
            sensors = "as named on the command line" if named else _in_words(found.sensors)
            page.draw_domain(sensors, found.nodes, found.runs, _absent())
        what = choice.bag.name if choice.bag is not None else "the graph"
        page.say(f"{what} starts; this page shows it in some seconds.", ORANGE)
        time.sleep(_SEEN_S)
        takes_found = choice.bag is None and not named
        return page.port, choice, found.sensors if takes_found else MappingProxyType({})


def _absent() -> str:
    domain = os.environ.get("ROS_DOMAIN_ID") or "0"
    where = "this machine" if dds.is_local() else "any machine that is reached"
    return (
        f"no sensor publishes in ROS domain {domain} on {where}. Start the sensor's driver or program; "
        "body_tracking doctor says what is missing"
    )


def _recordings(args: argparse.Namespace, known: dict[Path, Any]) -> list[Any]:
    """The recordings of the folder, then those that come with the package, each once; last results, and what cannot be
    played.
    """
    seen: dict[Path, Any] = {}
    for own, bags in ((True, bags_in(Path())), (False, shipped_bags())):
        for bag in bags:
            path = bag.resolve()
            if path in seen:
                continue
            if path not in known:
                place = "this folder" if bag.parent == Path() else str(bag.parent)
                known[path] = _described(args, bag, f"in {place}" if own else "an example")
            seen[path] = known[path]
    return sorted(seen.values(), key=lambda each: (bool(each.refusal), each.results))


def _described(args: argparse.Namespace, bag: Path, where: str) -> Any:
    """A recording in words, or the reason why it cannot be played."""
    from body_tracking.viewing.start_page import DEFAULT, Choice, Recording

    try:
        with RigReader(bag) as reader:
            types = {name: each.type_name for name, each in reader.topics.items()}
            counts = {name: each.count for name, each in reader.topics.items()}
            length = (
                f"{(reader.end_ns - reader.start_ns) / NANOSECONDS:.1f} s{', incomplete' if reader.warnings else ''}"
            )
    except BodyTrackingError as error:
        return Recording(bag, where, "cannot be read", str(error).replace(f"{bag}/", ""))
    bodies = graph.bodies_among(types)
    results = bool(bodies) and graph.DIAGNOSTICS_TOPIC not in types  # which every live recording has
    if bodies:
        length += f", results (angles of {listed(bodies)})" if results else f", angles of {listed(bodies)}"
    try:
        options = options_for(_graph(args, Choice(bag, False, DEFAULT)))
    except NoSourceError as error:
        if advice := advice_for(types, "body_tracking view"):
            return Recording(bag, where, length, f"To play it, {advice}")
        if bodies:
            return Recording(bag, where, length, "No sensors to play: body_tracking show draws the angles")
        return Recording(bag, where, length, str(error).removeprefix(f"{bag}: "))
    except BodyTrackingError as error:
        return Recording(bag, where, length, str(error).removeprefix(f"{bag}: "))
    played = options["played"]
    if isinstance(played, tuple) and not any(counts[name] for name in played if isinstance(name, str)):
        return Recording(bag, where, length, "It holds no message of a sensor")
    sources = {name: options[name] for name, each in OPTIONS.items() if each.source and options[name]}
    skeletons = {"sensors": options["sensors"]} if options["sensors"] and not options["computed"] else {}
    others = unused(types, options)
    also = f"; also in it, for {others}" if others else ""
    return Recording(bag, where, f"{length}, {_in_words({**skeletons, **sources})}{also}", results=results)


def _in_words(sources: Mapping[str, Value]) -> str:
    texts = (
        f"{name.replace('_', ' ')} {', '.join(value) if isinstance(value, tuple) else ''}"
        for name, value in sources.items()
        if value is not True
    )
    return "; ".join(map(str.strip, texts))

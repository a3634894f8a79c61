"""Playing recordings in place of sensors, and recording the graph."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from body_tracking.core.message_types import CLOCK
from body_tracking.core.parameters import Value
from body_tracking.core.qos import RELIABLE
from body_tracking.pipeline import graph
from body_tracking.pipeline.system import (
    Command,
    NodeSpec,
    NodeType,
    Option,
    Options,
    Place,
    Service,
    System,
    TopicSpec,
    asked,
)


def _recorded(parameters: Mapping[str, Value], topics: Iterable[str]) -> Iterable[str]:
    if parameters.get("start_recording", True) is False:
        return []
    whole = parameters.get("model_covariance", False)
    return [topic for topic in topics if whole or not graph.is_model_covariance(topic)]


def _specs(options: Options) -> Iterable[NodeSpec]:
    covariance: dict[str, Value] = {"model_covariance": True} if options["model_covariance"] else {}
    if options["record"]:
        yield NodeSpec("bag_recorder", "bag_recorder", parameters={"folder": options["record"], **covariance})
    elif options["viewer"]:  # waits for the button on the page
        yield NodeSpec("bag_recorder", "bag_recorder", parameters={"start_recording": False, **covariance})
    if not options["bag"]:
        return
    yield NodeSpec(
        "bag_player",
        "bag_player",
        # Every message is preceded by the clock anyway, and each tick costs time in each node.
        defaults={"clock_rate": 20.0},
        parameters={
            "bag": options["bag"],
            "rate": options["rate"],
            "topics": options["played"],
            "reliable": options["reliable"],
            **asked(options, loop="loop", start_offset="start"),
        },
    )


SYSTEM = System(
    "recording",
    heading="playing and recording",
    order=5,
    nodes=(
        NodeType("bag_player", Place.SOURCE, basic=("bag", "rate", "loop", "start_offset", "topics")),
        NodeType("bag_recorder", Place.RECORDER, takes=_recorded, basic=("folder", "topics", "exclude")),
    ),
    specs=_specs,
    options=(
        Option("bag", "", "play this bag instead of the sensors", "BAG", path=True),
        Option("rate", 1.0, "play the bag X times as fast (default 1)", "X"),
        Option("loop", False, "play the bag again from the beginning at its end, until Ctrl-C"),
        Option("start", 0.0, "skip this many seconds at the beginning of the bag", "SECONDS"),
        Option("played", (), hidden=True),
        Option("record", "", "record all topics into this new folder", "BAG", path=True, example="recording"),
        Option(
            "model_covariance",
            False,
            "also record /filtered/model_covariance, with ekf most of a recording; replay can compute it again",
            parameter=("bag_recorder", "model_covariance"),
            offline=True,
        ),
    ),
    topics=(TopicSpec(graph.CLOCK_TOPIC, CLOCK, RELIABLE, "bag_player", "the bag's time, for `use_sim_time`"),),
    services=(
        Service("recorder/start", "bag_recorder", "start recording into a new folder, or a new file of the named one"),
        Service("recorder/stop", "bag_recorder", "stop recording and close the bag"),
        Service("bag_player/pause", "bag_player", "pause"),
        Service("bag_player/resume", "bag_player", "resume"),
        Service("bag_player/toggle_paused", "bag_player", "pause or resume"),
    ),
    commands=(
        Command(
            "import",
            "body_tracking.recording.importer",
            "convert other formats into a bag: CSV, NTU RGB+D .skeleton, Xsens .mvnx, C3D, folders of the NTU motion "
            "capture data set",
        ),
        Command("bag", "body_tracking.recording.info", "list the contents of recordings, close one that was cut off"),
        Command("replay", "body_tracking.recording.replay", "run the whole graph offline over a bag"),
    ),
)

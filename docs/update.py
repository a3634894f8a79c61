"""Write what the code defines: the tables of docs/reference.md and benchmarks/README.md, and the files in config/.

The table in README.md has medians of docs/accuracy.md, which ``benchmarks/accuracy.py --write`` writes. With
``--check`` it only says whether they are up to date.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from body_tracking import cli, systems
from body_tracking.core.parameters import Numbers, Parameter, Value, grouped, to_ros
from body_tracking.core.qos import Qos
from body_tracking.kinect import simulated as kinect
from body_tracking.kinematics.conventions import ALL_CONVENTIONS, angle_names
from body_tracking.pipeline.roles import ROLES

ROOT = Path(__file__).resolve().parent.parent
REFERENCE = ROOT / "docs" / "reference.md"
README = ROOT / "README.md"
ACCURACY = ROOT / "docs" / "accuracy.md"
CONFIG = ROOT / "config" / "body_tracking.yaml"
SIMULATOR = ROOT / "config" / "simulator.yaml"
BENCHMARKS = ROOT / "benchmarks" / "README.md"
BENCHMARKS_HEADER = """\
# Benchmarks

Written by `make docs` from `benchmarks/run.py`. `python benchmarks/run.py NAME [options]` runs one of them, as
`python benchmarks/NAME.py [options]` does; `--help` says more of each, `make bench` runs all that can run here. Times
are those of a run with default options on two cores. The real recordings are looked for in `../shared/data`, or where
`BODY_TRACKING_DATA` says. `--seeds N` sets how many people there are per case, `--jobs N` how many processes compute,
`--out FILE` where all figures are written as JSON, `--json` prints these instead of tables. Exit codes: 0 every bar is
met, 1 one is missed, 2 what it needs is absent.
"""
SIMULATOR_HEADER = """\
# How much a simulated Kinect v2 errs. Written by `make docs` from the code; copy it, keep what you change:
#   body_tracking simulate --config my_errors.yaml -o bag
"""
GROUPS = {
    "Angles and commands": ("joint_angles", "robot_commands"),
    "The filtered person": ("skeleton_filter",),
    "Sensors": ("kinect_skeleton", "skeleton_adapter", "imu_skeleton"),
    "Infrared markers": (
        "marker_cameras",
        "marker_points",
        "marker_detector",
        "marker_triangulation",
        "rigid_body_tracker",
    ),
    "Depth cameras": ("mesh_tracker",),
    "Colour cameras": ("camera_skeleton", "camera_rig"),
    "Calibration and fusion": ("calibration", "fusion"),
    "Recordings": ("bag_player", "bag_recorder"),
    "Views": ("body_markers", "viewer"),
    "Diagnostics": ("every node",),
}
"""Heading -> the nodes whose topics stand below it, in the order in which a user looks for them."""
ACCURACY_COLUMNS = {
    "one sensor": "one sensor",
    "thesis": "thesis LKF2",
    "`lkf_constant_velocity`": "default (lkf_constant_velocity)",
    "`ekf`": "ekf",
}
"""Column of the table in README.md -> that of docs/accuracy.md."""
ACCURACY_ROWS = {
    "elbow flexion, RMSE, degrees": ("Elbow flexion, RMSE in degrees", 1.0, "{:.1f}"),
    "shoulder elevation, RMSE, degrees": ("Shoulder elevation, RMSE in degrees", 1.0, "{:.1f}"),
    "joint positions, mean 3D error, mm": ("Mean 3D error, mm", 1.0, "{:.0f}"),
    "the same without each joint's constant offset, mm": (
        "Mean 3D error without each joint's constant offset, mm",
        1.0,
        "{:.0f}",
    ),
    "elbow: truth within 1.96 standard deviations (ideal: 95 %)": (
        "Elbow flexion: share of errors within 1.96 standard deviations",
        100.0,
        "{:.0f} %",
    ),
    "shoulder: truth within 1.96 standard deviations": (
        "Shoulder elevation: share of errors within 1.96 standard deviations",
        100.0,
        "{:.0f} %",
    ),
}
"""Row of the table in README.md -> the heading in docs/accuracy.md, a factor and the format of a value."""
SECTION = re.compile(r"(<!-- (\w+): written by make docs -->\n).*?(<!-- end of \2 -->)", re.DOTALL)


def _cell(text: str) -> str:
    """Text in a cell; outside of code, ``<name>`` would be taken for HTML."""
    parts = text.replace("|", r"\|").split("`")
    return "`".join(part if i % 2 else part.replace("<", "&lt;") for i, part in enumerate(parts))


def table(titles: Sequence[str], rows: Iterable[Sequence[str]], *, numbers: bool = False) -> str:
    """A Markdown table; ``numbers`` aligns all columns but the first at the right."""
    lines = [titles, ["---"] + ["---:" if numbers else "---"] * (len(titles) - 1), *rows]
    return "".join("| " + " | ".join(map(_cell, line)) + " |\n" for line in lines)


def _qos(qos: Qos) -> str:
    latched = "latched, " if qos.durability == "transient_local" else ""
    return f"{latched}{qos.reliability.replace('_', ' ')}, depth {qos.depth}"


def topics() -> str:
    """Every topic of the graph, in a table per group of publishers."""
    ungrouped = {topic.publisher for topic in systems.TOPICS} - {name for group in GROUPS.values() for name in group}
    if ungrouped:
        raise SystemExit(
            f"GROUPS in {Path(__file__).name} has no place for the topics of {', '.join(sorted(ungrouped))}"
        )
    parts = []
    for heading, publishers in GROUPS.items():
        rows = [
            (
                f"`{topic.name}`",
                f"`{topic.type_name.replace('/msg/', '/')}`",
                _qos(topic.qos),
                topic.publisher,
                topic.content,
            )
            for topic in systems.TOPICS
            if topic.publisher in publishers
        ]
        if rows:
            parts.append(f"### {heading}\n\n" + table(("topic", "type", "QoS", "from", "content"), rows))
    return "\n".join(parts)


def services() -> str:
    """Every service of the graph."""
    return table(
        ("service", "node", "what it does"),
        [(f"`{each.name}`", each.executable, each.text) for each in systems.SERVICES],
    )


def angles() -> str:
    """The names of the joint angles of each convention."""
    rows = [(f"`{name}`", ", ".join(f"`{angle}`" for angle in angle_names(name))) for name in ALL_CONVENTIONS]
    return table(("convention", "angles"), rows)


def filters() -> str:
    """What each filter means for the nodes around it."""
    rows = [
        (f"`{name}`", f"`{role.input}`", f"`{role.angles_input}`", f"`{role.convention}`")
        for name, role in ROLES.items()
    ]
    return table(("filter", "`input` of skeleton_filter", "`input` of joint_angles", "`convention`"), rows)


def _default(value: Value) -> str:
    if isinstance(value, bool):
        return "`true`" if value else "`false`"
    if isinstance(value, tuple):
        return f"`[{', '.join(value)}]`"
    if isinstance(value, float):
        return f"`{value!r}`"
    if isinstance(value, Numbers):
        return f"`{to_ros(value)}`"
    return f"`{value}`" if value != "" else '`""`'


def _row(item: Parameter) -> tuple[str, ...]:
    return (f"`{item.name}`{' *' * item.live}", _default(item.default), item.unit, item.constraint, item.doc)


def parameters() -> str:
    """The parameters of every node; those that are the same in several nodes stand in the first table only."""
    titles = ("parameter", "default", "unit", "allowed", "meaning")
    of_node = {executable: systems.parameters_of(executable) for executable in systems.EXECUTABLES}
    nodes_of: dict[Parameter, list[str]] = {}
    for executable, items in of_node.items():
        for item in items:
            nodes_of.setdefault(item, []).append(executable)
    common = {item: nodes for item, nodes in nodes_of.items() if len(nodes) > 1}
    rows = [(*_row(item), ", ".join(nodes)) for item, nodes in common.items()]
    parts = ["### Several nodes\n\n" + table((*titles, "nodes"), rows)]
    for executable, items in of_node.items():
        basic, advanced = grouped(items, systems.NODES[executable].basic)
        own = table(titles, [_row(item) for item in (*basic, *advanced) if item not in common])
        if basic:
            own += f"\nBasic: {', '.join(f'`{item.name}`' for item in basic)}; all others are advanced.\n"
        shared = ", ".join(f"`{item.name}`" for item in items if item in common)
        more = f"\nAlso, as in [several nodes](#several-nodes): {shared}.\n" if shared else ""
        parts.append(f"### {executable}\n\n{own}{more}")
    return "\n".join(parts)


def _below(parser: argparse.ArgumentParser) -> Iterator[argparse._SubParsersAction[argparse.ArgumentParser]]:
    return (action for action in parser._actions if isinstance(action, argparse._SubParsersAction))


def _commands() -> Iterator[tuple[str, str]]:
    for name, command in cli.subcommands().items():
        (top,) = _below(cli.parser(name))
        verbs = [
            (f"`body_tracking {name} {verb.dest}`", verb.help or "")
            for action in _below(top.choices[name])
            for verb in action._choices_actions
        ]
        yield from verbs or [(f"`body_tracking {name}`", command.text)]


def commands() -> str:
    """The subcommands of ``body_tracking``."""
    return table(("command", "what it does"), _commands())


def _medians(heading: str) -> dict[str, str]:
    """Column -> median over the motions, of the table below a heading of docs/accuracy.md."""
    text = ACCURACY.read_text(encoding="utf-8")
    found = re.search(rf"^### {re.escape(heading)}\n\n(.*)\n.*\n(?:\|.*\n)*?(\| \*\*median\*\*.*)", text, re.MULTILINE)
    if found is None:
        raise SystemExit(f"{ACCURACY.name} has no table of medians below {heading!r}")
    titles, values = ([cell.strip(" *") for cell in line.split("|")] for line in found.groups())
    return dict(zip(titles, values, strict=True))


def accuracy() -> str:
    """The medians over the motions, of simulated people."""
    rows = []
    for title, (heading, factor, form) in ACCURACY_ROWS.items():
        values = (_medians(heading)[column] for column in ACCURACY_COLUMNS.values())
        rows.append((title, *(value if value == "-" else form.format(factor * float(value)) for value in values)))
    return table(("", *ACCURACY_COLUMNS), rows, numbers=True)


WRITERS = {
    "topics": topics,
    "services": services,
    "filters": filters,
    "angles": angles,
    "parameters": parameters,
    "commands": commands,
}


def written(path: Path, writers: Mapping[str, Callable[[], str]]) -> str:
    """The text of a page with its tables as they are now."""
    text = path.read_text(encoding="utf-8")
    missing = writers.keys() - {match[2] for match in SECTION.finditer(text)}
    if missing:
        raise SystemExit(f"{path.name} has no place for {', '.join(sorted(missing))}")
    return SECTION.sub(lambda match: f"{match[1]}{writers[match[2]]()}{match[3]}", text)


def benchmarks() -> str:
    """The text of benchmarks/README.md."""
    sys.path.insert(0, str(BENCHMARKS.parent))
    import run

    return BENCHMARKS_HEADER + "\n" + table(("benchmark", "what it shows", "needs", "takes about"), run.rows())


def files() -> dict[Path, str]:
    """The text of each file as the code defines it now."""
    simulator = f"{SIMULATOR_HEADER}\n{kinect.errors_as_yaml()}"
    return {
        README: written(README, {"accuracy": accuracy}),
        REFERENCE: written(REFERENCE, WRITERS),
        CONFIG: systems.config_text(),
        SIMULATOR: simulator,
        BENCHMARKS: benchmarks(),
    }


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--check", action="store_true", help="change nothing; exit code 1 if not up to date")
    check = parser.parse_args().check
    code = 0
    for path, text in files().items():
        if path.exists() and path.read_text(encoding="utf-8") == text:
            continue
        if check:
            print(f"{path.relative_to(ROOT)} is not up to date: make docs", file=sys.stderr)
            code = 1
        else:
            path.write_text(text, encoding="utf-8")
    return code


if __name__ == "__main__":
    sys.exit(main())

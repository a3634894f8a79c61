"""``body_tracking call``: calls a service of a running graph without ``ros2``, or lists the services."""

from __future__ import annotations

import argparse
import os
import re

from body_tracking.core import names
from body_tracking.core.errors import BodyTrackingError
from body_tracking.ros import dds


class CallError(BodyTrackingError):
    """There is no such service, or it refused or did not answer."""


def add_parser(subparsers: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """``body_tracking call``."""
    parser = subparsers.add_parser(
        "call",
        description="Call a service of a running graph and print its answer; without a name, list the services. "
        "`ros2 service call NAME std_srvs/srv/Trigger` does the same.",
        epilog="Exit codes: 0 done, 2 refused, no answer or no such service.",
    )
    parser.add_argument("service", nargs="?", metavar="SERVICE", help="such as calibration/start (default: list all)")
    parser.add_argument("--namespace", default="/", metavar="NAME", help="of the graph (default: %(default)s)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """``body_tracking call``."""
    namespace = names.check_namespace(args.namespace)
    if args.service is not None and not re.fullmatch(r"/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*", args.service, re.ASCII):
        raise CallError(f"{args.service!r} is no name of a service; body_tracking call lists them")
    dds.stay_on_this_machine()
    dds.prepare()
    try:
        from body_tracking.ros.triggers import Triggers
    except ImportError as error:
        from body_tracking.ros.up import no_ros

        raise no_ros(error) from error
    with Triggers(namespace) as triggers:
        if args.service is None:
            _list(triggers.look(), namespace)
        else:
            print(triggers.call(args.service))
    return 0


def _list(found: list[str], namespace: str) -> None:
    """Print the services with what they do; CallError without any."""
    from body_tracking.systems import SERVICES

    if not found:
        raise CallError(
            f"no service {where(namespace)}: does body_tracking up run, in a shell with the same variables?"
        )
    width = max(map(len, found))
    for name in found:
        text = next((each.text for each in SERVICES if each.is_called(name)), "of another package")
        print(f"{name:<{width}}  {text}")


def where(namespace: str) -> str:
    """The namespace and the ROS domain in words."""
    inside = "" if namespace == "/" else f"in namespace {namespace}, "
    return f"{inside}in ROS domain {os.environ.get('ROS_DOMAIN_ID') or '0'}"

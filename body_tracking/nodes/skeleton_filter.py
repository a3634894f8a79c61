"""``/fused/skeleton`` to ``/filtered/skeleton``: smoother, with velocities, and predicted where nothing is seen."""

# rclpy is only partly typed, and absent where there is no ROS.
# mypy: disable-error-code="no-untyped-call, attr-defined, misc"

from __future__ import annotations

from collections.abc import Mapping

from sensor_msgs.msg import PointCloud2

from body_tracking import graph
from body_tracking.cdr import encode_skeletons
from body_tracking.filters import FILTERS, LinearKalmanParameters, make_filter
from body_tracking.nodes.common import RELIABLE, GraphNode, run
from body_tracking.parameters import Parameter, Value, fields_of, parameters_from
from body_tracking.skeleton import Skeleton

PARAMETERS = (
    Parameter("filter", "lkf_constant_velocity", "which filter", choices=FILTERS, live=True),
    *parameters_from(LinearKalmanParameters, live=True),
    RELIABLE,
)


class SkeletonFilterNode(GraphNode):
    """Filters one skeleton per message."""

    NAME = "skeleton_filter"
    PARAMETERS = PARAMETERS

    def configure(self, values: Mapping[str, Value]) -> None:
        """A new filter starts from the next frame on."""
        self.filter = make_filter(str(values["filter"]), **fields_of(LinearKalmanParameters, values))

    def start(self) -> None:
        """Connect."""
        self.output = self.create_publisher(PointCloud2, graph.FILTERED, self.skeleton_qos())
        self.listen_to_skeletons(graph.FUSED, self.on_fused)

    def on_fused(self, skeletons: tuple[Skeleton, ...], sent_ns: int) -> None:
        """Filter and publish."""
        filtered = self.filter.update(skeletons[0])
        if filtered is not None:
            self.send(self.output, encode_skeletons([filtered]), filtered.stamp_ns, sent_ns)

    def time_jumped_back(self, topic: str) -> None:
        """Start anew."""
        self.filter.reset()

    def state(self) -> tuple[int, str, dict[str, object]]:
        """The filter's counters."""
        return 0, str(self.values["filter"]), dict(self.filter.counters)


def main() -> None:
    """The executable ``skeleton_filter``."""
    run(SkeletonFilterNode)


if __name__ == "__main__":
    main()

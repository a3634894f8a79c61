"""``/markers/points`` to ``/markers/<target>/pose`` of each target."""

from body_tracking.ros.host import main_of

main = main_of("rigid_body_tracker")

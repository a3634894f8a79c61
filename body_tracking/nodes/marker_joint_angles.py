"""``/markers/<target>/pose`` of all targets of a chain to ``/humans/bodies/markers/joint_states``."""

from body_tracking.ros.host import main_of

main = main_of("marker_joint_angles")

"""``/filtered/skeleton`` or the state of its model to ``/humans/bodies/<id>/joint_states`` and standard deviations."""

from body_tracking.ros.host import main_of

main = main_of("joint_angles")

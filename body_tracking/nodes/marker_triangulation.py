"""``/<camera>/balls`` of all cameras of a rig to ``/markers/points``."""

from body_tracking.ros.host import main_of

main = main_of("marker_triangulation")

"""Points of another motion capture system to ``/markers/points``."""

from body_tracking.ros.host import main_of

main = main_of("marker_points")

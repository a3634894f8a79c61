"""Images of drivers, of files or rendered ones to ``/<camera>/image_raw``."""

from body_tracking.ros.host import main_of

main = main_of("marker_cameras")

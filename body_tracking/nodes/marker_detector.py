"""``/<camera>/image_raw`` of each camera to ``/<camera>/balls``."""

from body_tracking.ros.host import main_of

main = main_of("marker_detector")

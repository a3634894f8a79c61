"""Colour and depth images of cameras to ``/<camera>/skeleton``."""

from body_tracking.ros.host import main_of

main = main_of("camera_skeleton")

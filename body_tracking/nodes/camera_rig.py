"""Colour images of calibrated cameras to ``/camera_rig/skeleton``."""

from body_tracking.ros.host import main_of

main = main_of("camera_rig")

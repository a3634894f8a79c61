"""All ``/<sensor>/skeleton`` and the calibration to ``/fused/skeleton``."""

from body_tracking.ros.host import main_of

main = main_of("fusion")

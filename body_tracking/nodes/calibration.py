"""All ``/<sensor>/skeleton`` to ``/calibration`` and ``/calibration/clock``: the poses and clocks of the sensors."""

from body_tracking.ros.host import main_of

main = main_of("calibration")

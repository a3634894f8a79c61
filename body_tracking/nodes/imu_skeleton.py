"""``sensor_msgs/Imu`` per segment to ``/imu/<segment>/orientation`` and ``/imu/skeleton``, with or without a camera."""

from body_tracking.ros.host import main_of

main = main_of("imu_skeleton")

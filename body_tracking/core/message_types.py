"""Names of the message types that the package uses."""

from __future__ import annotations

POINT_CLOUD = "sensor_msgs/msg/PointCloud2"
JOINT_STATE = "sensor_msgs/msg/JointState"
TRANSFORM = "geometry_msgs/msg/TransformStamped"
TIME_REFERENCE = "sensor_msgs/msg/TimeReference"
IMAGE = "sensor_msgs/msg/Image"
SEGMENTS = "sensor_msgs/msg/MultiDOFJointState"
IMU = "sensor_msgs/msg/Imu"
MAGNETIC_FIELD = "sensor_msgs/msg/MagneticField"
STRING = "std_msgs/msg/String"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
CLOCK = "rosgraph_msgs/msg/Clock"
JOINT_TRAJECTORY = "trajectory_msgs/msg/JointTrajectory"
FLOAT_ARRAY = "std_msgs/msg/Float64MultiArray"
MARKERS = "visualization_msgs/msg/MarkerArray"
TF = "tf2_msgs/msg/TFMessage"

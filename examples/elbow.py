"""Print the left elbow of the person as a controller would take it: only while it is certain enough."""

import sys
from contextlib import suppress

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from sensor_msgs.msg import JointState

TOPIC = "/humans/bodies/body1/joint_states"


class Elbow(Node):
    def __init__(self):
        super().__init__("elbow")
        self.angles = {}  # by stamp, until the deviations of that stamp arrive
        self.create_subscription(JointState, TOPIC, self.on_angles, 10)
        self.create_subscription(JointState, TOPIC + "_stddev", self.on_stddev, 10)

    def on_angles(self, message):
        self.angles[message.header.stamp.sec, message.header.stamp.nanosec] = message
        if len(self.angles) > 10:
            self.angles.pop(next(iter(self.angles)))

    def on_stddev(self, stddev):
        angles = self.angles.pop((stddev.header.stamp.sec, stddev.header.stamp.nanosec), None)
        if angles is None or "elbow_flexion_left_body1" not in angles.name:
            return
        if stddev.name != angles.name or not len(angles.name) == len(angles.position) == len(stddev.position):
            return  # malformed: no message may end a controller
        i = angles.name.index("elbow_flexion_left_body1")
        if stddev.position[i] < 0.35:  # false for infinity and NaN
            print(f"{angles.position[i]:.2f} +- {stddev.position[i]:.2f} rad", flush=True)


try:
    rclpy.init()
except RuntimeError as error:  # of a ROS_DOMAIN_ID that is no number
    sys.exit(f"elbow: {error}")
print(f"elbow: waits for {TOPIC} and {TOPIC}_stddev", file=sys.stderr)
with suppress(ExternalShutdownException, KeyboardInterrupt):  # kill, Ctrl-C
    rclpy.spin(Elbow())

"""Conversions between the library's types and ROS messages.

The same functions serve two families of message classes: those of a ROS install (``rclpy``, live nodes) and those of
``rosbags`` (recordings, without ROS). Reading needs only attributes, which both have; writing uses a
:class:`MessageTypes`, which constructs the messages of its family.
"""

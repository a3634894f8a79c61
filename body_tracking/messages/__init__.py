"""The only bridge between the library's types and ROS messages.

The same functions serve two families of message classes: those of a ROS install (``rclpy``, live nodes) and those of
``rosbags`` (recordings, read and written with no ROS at all). Reading needs only attributes, which both have; writing
goes through a :class:`MessageTypes`, which knows how its family is constructed.
"""

"""Live multi-sensor body tracking: skeletons in, joint angles with an honest uncertainty out.

The library (every package but ``nodes`` and ``ros``) knows neither rclpy nor any message package.
"""

__version__ = "0.2.0"

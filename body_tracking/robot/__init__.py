"""Driving a robot's joints by a person's joint angles: mapping files, limits of motion, and a safe stop.

Knows no ROS, no sensor and no body model: its input is named angles with velocities, standard deviations and capture
times, its output joint commands.
"""

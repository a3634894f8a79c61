"""Driving a robot's joints by a person's joint angles: mapping files, limits of motion, and a safe stop.

Knows no ROS, no sensor and no body model: angles come in by name, with velocities and standard deviations, at their
times of capture; commands go out. Imports numpy,
``parameters``, ``errors`` and the plain data of ``kinematics.angles``.
"""

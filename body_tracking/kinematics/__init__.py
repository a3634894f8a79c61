"""Kinematics: the body model, joint angles and their conventions, ranges of motion, segment lengths."""

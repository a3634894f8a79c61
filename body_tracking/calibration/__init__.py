"""Calibration of the sensors: poses in ``world``, clocks against the reference sensor's, and their uncertainty.

Estimated from one still pose as by Schlagenhauf (2017) and, by default, refined robustly over movement; ``storage``
reads and writes the files.
"""

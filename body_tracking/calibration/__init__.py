"""Where each sensor stands in ``world``, how its clock runs against the reference sensor's, and how well that is known.

``result`` holds what a calibration says, ``storage`` keeps it in a file; the rest finds it: from one still pose as
Schlagenhauf (2017) does, and, by default, refined robustly over movement. It knows ``skeleton`` and numpy, and neither
fusion nor filters nor ROS. The calibration node, ``body_tracking calibrate`` and the offline replay import it;
``messages`` and ``fusion`` import ``result`` alone.
"""

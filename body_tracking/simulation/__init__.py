"""Simulated people in front of simulated Kinects and with simulated inertial sensors, with ground truth.

``people`` are bodies of ``kinematics.upper_body`` on two legs; ``repertoire`` moves them by ``exercises`` of key
``postures`` on ``feet``. ``layouts`` places the sensors, whose errors are in ``kinect.simulated*`` and
``inertial.simulated*``. ``scene`` simulates a recording, ``bags`` writes it. ``random_people`` is separate: bodies that
obey the filter's own model, measured with white noise only.
"""

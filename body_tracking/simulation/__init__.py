"""People who move before Kinects and inertial sensors that err like real ones, and everything that is true of it.

``people`` are bodies of ``kinematics.upper_body`` on two legs, ``repertoire`` is what they do, made of
``trajectories``; ``layouts`` says where sensors stand, ``occlusion`` what they cannot see, ``kinect`` and ``imus`` what
they would have said and when. ``scene`` puts all of it together, ``bags`` writes it into recordings. ``random_people``
stand apart: bodies that obey the filter's own model, with white noise only. Knows the core types, ``kinematics``,
``calibration.result``, ``sensors`` and ``recording``; nothing imports it but the command line, benchmarks and tests.
"""

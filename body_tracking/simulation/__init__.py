"""People who move before Kinects and inertial sensors that err like real ones, and everything that is true of it.

``people`` are bodies of ``kinematics.upper_body`` on two legs; ``repertoire`` moves them, by ``exercises`` of key
``postures``, on ``feet``, along ``trajectories``. ``layouts`` says where sensors stand. The Kinect: ``kinect`` holds
its parameters, ``kinect_joints`` its tables, ``kinect_sensor`` what it reports, ``occlusion`` what it cannot see.
Inertial sensors: ``imu_errors`` holds their parameters, ``imus`` what they measure, ``imu_driver`` the orientation they
report, ``surroundings`` the magnetic field. ``scene`` puts all of it together, ``bags`` writes it into recordings.
``random_people`` stand apart: bodies that obey the filter's own model, with white noise only. Knows the core types,
``kinematics``, ``calibration.result``, ``sensors`` and ``recording``; nothing imports it but the command line,
benchmarks and tests.
"""

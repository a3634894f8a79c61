"""How inertial sensors sit on a body, which way they face, and how their clocks run.

``clock`` finds a clock's offset from motion, ``alignment`` how a sensor is turned against its segment, ``heading``
keeps that and the heading of every sensor over time, ``detection`` finds exchanged and slipped sensors, ``posture``
makes a configuration of the body model of segments' orientations. ``worn`` takes the readings of one sensor,
``timing`` brings their clocks together, ``mounting`` says how they are meant to be put on, ``held_pose`` when a pose is
held, ``body`` makes a skeleton, and ``tracking`` with its ``parameters`` a source of all of it. Arrays in, small
dataclasses out; it knows ``skeleton``, ``orientation``, ``kinematics``, the inertial readings of ``sensors`` and the
clock fit of ``calibration``, neither files nor ROS. The node ``imu_skeleton`` and the filters may import it.

Frames: *sensor*, that of the chip; *earth*, level with z up and a heading of its own for each sensor; *segment*, that
of ``UpperBody``; *world*. With the alignment A (segment to sensor) and the heading psi (about z, earth to world)::

    R_world_segment = Rz(psi) R_earth_sensor A                                                                     (1)

Errors of A and of a segment's orientation are small rotation vectors in the segment's own frame (on the right).
"""

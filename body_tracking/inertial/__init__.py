"""Inertial sensors on a body: orientation, alignment with the segments, heading, and clocks.

``worn`` takes the readings of one sensor; ``imu_orientation`` estimates its orientation from raw ones. ``alignment``
estimates the rotation between sensor and segment, and ``heading`` tracks it and every sensor's heading over time.
``held_pose`` detects a pose for the alignment, ``mounting`` has the intended mountings, ``detection`` finds exchanged
and slipped sensors. ``clock`` estimates a clock's offset by motion, ``timing`` keeps the offsets of all. ``posture``
fits the body model to orientations, ``body`` makes a skeleton. ``tracking`` with its ``parameters`` combines these for
``stage``. ``simulated`` and its helpers simulate sensors; ``imu_csv`` and ``mvnx`` read recordings.

Frames: *sensor*, that of the chip; *earth*, level with z up and a heading of its own for each sensor; *segment*, that
of ``UpperBody``; *world*. With the alignment A (segment to sensor) and the heading psi (about z, earth to world)::

    R_world_segment = Rz(psi) R_earth_sensor A                                                                     (1)

Errors of A and of a segment's orientation are small rotation vectors in the segment's own frame (on the right).
"""

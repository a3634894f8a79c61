"""What a recording says, and how far it is from the truth: numbers, tables and pictures for people.

``metrics``, ``segments`` and ``smoothing`` are functions on arrays; ``reading`` reads bags, ``c3d`` and
``plug_in_gait`` markers; ``comparison`` computes; ``report`` writes, ``pictures`` draws; ``show`` and ``evaluate`` are
the commands. Knows the core types, ``recording``, the angles of ``kinematics``, and from ``calibration`` the fits of
rigid motion and of clocks; nothing imports it but the command line, tests and benchmarks.
"""

"""Errors of a recording against the ground truth: numbers, tables and pictures.

``metrics``, ``segments`` and ``smoothing`` are functions on arrays; ``reading`` reads bags,
``plug_in_gait`` markers; ``comparison`` computes; ``report`` writes, ``pictures`` draws; ``show`` and ``evaluate`` are
the commands.

By a recording of the marker system: ``estimated_segments`` and ``marker_reference`` read, ``hand_eye`` finds mountings,
world and clock, ``reference_comparison`` compares half against half, ``reference_error`` takes the reference's own
deviation off, ``reference_report`` writes.

The thesis's baseline tests: ``balls`` finds balls in images, ``robot_arm`` and ``pendulum`` compute,
``baseline_reading`` reads bags, ``baseline`` is the command.
"""

"""Errors of a recording against the ground truth: numbers, tables and pictures.

``metrics``, ``segments`` and ``smoothing`` are functions on arrays; ``reading`` reads bags,
``plug_in_gait`` markers; ``comparison`` computes; ``report`` writes, ``pictures`` draws; ``show`` and ``evaluate`` are
the commands.

Evaluation by a recording of the marker system: ``estimated_segments`` and ``marker_reference`` read, ``hand_eye``
estimates mountings, world and clock, ``reference_comparison`` compares each half with the fit of the other,
``reference_error`` removes the reference's own deviation, ``reference_report`` writes.

Baseline tests of the thesis: ``balls`` detects balls in images, ``robot_arm`` and ``pendulum`` compute,
``baseline_reading`` reads bags, ``baseline`` is the command.
"""

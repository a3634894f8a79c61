"""Errors of a recording against the ground truth: numbers, tables and pictures.

``metrics``, ``segments`` and ``smoothing`` are functions on arrays; ``reading`` reads bags, ``c3d`` and
``plug_in_gait`` markers; ``comparison`` computes; ``report`` writes, ``pictures`` draws; ``show`` and ``evaluate`` are
the commands.
"""

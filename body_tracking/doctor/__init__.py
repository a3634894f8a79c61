"""``body_tracking doctor``: what is wrong with the machine, its ROS, the sensors or a bag, and what to do about it.

A check is a function that looks at one real thing and returns findings; none needs another. What needs ROS runs in
processes of its own (``nodes/doctor_probe.py``), so that a broken one is a finding here and not a crash. May import
``recording`` and ``graph``; only ``cli`` imports it.
"""

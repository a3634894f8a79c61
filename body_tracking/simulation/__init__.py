"""A small articulated person, a few motions, and two skeleton cameras that err like real ones.

``figure`` turns joint angles into the 25 joints, ``motions`` turns time into joint angles, ``sensors`` turns true
joints into what a sensor would have said of them and when, ``bags`` writes all of it into recordings. Knows the core
types, ``sensors`` and ``recording``; nothing imports it but the command line and tests. A full simulator grows here.
"""

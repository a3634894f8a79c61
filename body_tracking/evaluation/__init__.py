"""What a recording says: numbers, tables and pictures for people.

``summary`` computes from arrays and reads bags, ``picture`` draws, ``show`` is the command. Knows the core types and
``recording``; nothing imports it but the command line, tests and benchmarks.
"""

"""Timeout of tests that wait for an event."""

PATIENCE = 300.0
"""Seconds. Tests that compute run with the lowest priority beside those that start processes and other work of the
machine, and may stand still for many seconds. If all is well, the wait ends with the event.
"""

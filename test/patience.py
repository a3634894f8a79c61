"""How long a test waits for what has to come, before it says that it does not."""

PATIENCE = 300.0
"""Seconds. Tests that compute run with the lowest priority beside those that start processes, and beside whatever else
a machine does: they may stand still for many seconds. Where all is well they wait no longer than what comes takes.
"""

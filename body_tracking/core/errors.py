"""The base class of every error that the package raises on purpose.

A module owns its own exception, derived from this one; a caller that only shows the text catches the base.
"""


class BodyTrackingError(Exception):
    """Something outside the program is wrong; the text names the problem and its place in one line."""

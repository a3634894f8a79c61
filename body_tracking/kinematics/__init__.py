"""Bodies as geometry: joint angles and their conventions, how people move; later the body models.

Knows ``skeleton.py``, ``measurement.py`` and numpy alone; filters, nodes and the offline replay use it.
"""

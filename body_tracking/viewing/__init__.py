"""Visualisation: shapes of skeletons, sensors and uncertainty, curves of angles, and the page that shows them.

``shapes``, ``colours`` and ``curves`` are arithmetic on arrays; ``page`` and its ``handles`` draw, with viser.
"""

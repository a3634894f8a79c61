"""What people look at: shapes of skeletons, sensors and uncertainty, curves of angles, and the page that shows them.

``shapes``, ``colours`` and ``curves`` are arithmetic on arrays; ``page`` and its ``handles`` draw, with viser.
None knows of messages or of the graph; the nodes ``viewer`` and ``body_markers`` feed them.
"""

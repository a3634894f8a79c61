"""``/fused/skeleton``, or every sensor's skeletons and orientations, to ``/filtered/skeleton`` and a body's state."""

from body_tracking.ros.host import main_of

main = main_of("skeleton_filter")

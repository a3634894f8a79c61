"""``/<sensor>/depth/image_raw`` to ``/<sensor>_mesh/skeleton`` and the mesh."""

from body_tracking.ros.host import main_of

main = main_of("mesh_tracker")

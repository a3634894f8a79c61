"""The nodes: one file each, which reads parameters, converts messages, calls the library and publishes.

Nobody imports them but the launch files, ``body_tracking up`` and the tests; they import everything.
"""

import os

# Matrices as small as a filter's gain nothing by a second thread, and OpenBLAS's threads spin while they wait for each
# other: where processors are shared, the filter took six times as long. It has to be said before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

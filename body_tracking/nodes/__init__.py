"""The nodes, one file each: parameters, conversion of messages, calls of the library, publishing."""

import os

# Small matrices gain nothing by a second thread, and OpenBLAS's threads spin while they wait for each other: on shared
# processors the filter took six times as long. The variable has to be set before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

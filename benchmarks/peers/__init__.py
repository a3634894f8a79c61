"""Other people's estimators on the body of ``upper_body``, for ``benchmarks/estimators.py``.

``tree.py`` describes the body as a tree of successive rotations, ``biorbd_ekf.py`` and ``opensim_ik.py`` write it in
each peer's format and run the peer. Needs the wheels of the extra ``peers``.
"""

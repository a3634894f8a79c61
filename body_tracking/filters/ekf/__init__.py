"""The extended Kalman filter on a body model, with a consistent covariance: ``ekf``.

State: the model's configuration, its segment lengths and its tangent velocities. The error of the configuration is in
the tangent space (an error-state filter, Sola 2017), because base and shoulders rotate freely; filterpy's
ExtendedKalmanFilter has a plain vector as state, and inverts the matrices that are factored here.

- Motion: each velocity is an Ornstein-Uhlenbeck process with time constant ``velocity_time``, driven by white noise.
- Measurement noise: a sensor's white noise is estimated from the third differences of each point over time, in which
  smooth motion nearly cancels; no tuning per sensor. Systematic errors that persist for seconds (a joint offset from
  the anatomical one) are a state that is considered but not estimated (Schmidt 1966), with the deviation of
  ``body_tracking.core.measurement`` scaled to match the innovations.
- Lengths are estimated in the state for the first seconds, then from the distances between points over many poses
  (``lengths``), and only considered here: otherwise persistent errors would be learnt as lengths. They are updated
  every second until they are known to some millimetres, or for a minute, and are constant then.
- Ranges of motion bound unobserved directions. They are applied only as often as they would be new information.
- A sensor's constant offsets of the joint centres are the same for all sensors of a kind, so no innovation shows them.
  Their effect on the pose is added to the output covariance.
- Orientations of segments by inertial sensors come at their own times; the errors of their sources are estimated in
  additional states (``sources``), which exist only with such sources.
- Optional fixed-lag smoothing (``smoothing``) reads states and changes none.

Modules: settings (``parameters``), state vector (``state``), motion model (``motion``), errors of cameras and of
sources of orientations (``sensor_errors``, ``sources``), updates by frames (``skeletons``) and orientations
(``orientations``), prior knowledge (``priors``), search for another pose (``poses``), output (``displacement``,
``output``), small matrices (``algebra``), and the filter over time (``filter``).
"""

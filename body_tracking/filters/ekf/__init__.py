"""The extended Kalman filter on a body model whose covariance is meant: ``ekf``.

State: the model's configuration, its segment lengths and its tangent velocities. The error of the configuration lives
in the tangent space (an error-state filter, Sola 2017), because base and shoulders turn freely; filterpy's
ExtendedKalmanFilter, whose state is a plain vector and whose update inverts what is factored here, does not fit.

- Motion: each velocity is an Ornstein-Uhlenbeck process (it fades with ``velocity_time``), driven by white noise whose
  density each joint finds for itself: as long as it is right, the corrections of the velocities are white and as large
  as the covariance says; where they lean to one side, the person moves more briskly than assumed.
- Measurement noise: a sensor's white noise is read off the third differences of each point over time, in which smooth
  motion all but cancels; no tuning for a sensor. What its points are wrong by for seconds (a joint placed beside the
  anatomical one) is a state of its own that is considered but not estimated (Schmidt 1966), with the deviation of
  ``body_tracking.core.measurement`` scaled until the innovations are as large as expected.
- Lengths are estimated for the first seconds. From then on they are what the distances between points say over many
  poses (``lengths``), and only considered here: what errs for seconds would otherwise be learnt as a length. They are
  brought in every second, until they are known to some millimetres or for a minute, and then stay as they are.
- Ranges of motion bound what nothing observes. They enter as rarely as they would be new information.
- Where a sensor takes the centres of the joints to be, beside the anatomical ones, never changes, is the same for all
  sensors of a kind, and so shows in no innovation. What it does to the pose is added to what is handed out.
- Orientations of segments by inertial sensors come at their own times, and what their sources err by is estimated
  behind the state of the body (``sources``); without any of them nothing is there, and nothing is different.

One module each: the settings (``parameters``), what is estimated (``state``), how it moves (``motion``), what cameras
and sources of orientations err by (``sensor_errors``, ``sources``), what frames (``skeletons``) and orientations
(``orientations``) say, what is known without any measurement (``priors``), the search for another pose (``poses``),
what is handed out (``displacement``, ``output``), small matrices (``algebra``), and all of it in the order of time
(``filter``).
"""

from body_tracking.filters.ekf.filter import ExtendedKalmanFilter
from body_tracking.filters.ekf.parameters import EkfParameters

__all__ = ["EkfParameters", "ExtendedKalmanFilter"]

"""Named joint angles of one body at one instant, whatever computed them."""

from __future__ import annotations

from dataclasses import dataclass

from body_tracking.core.skeleton import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class JointAngles:
    """Angles with their rates and standard deviations.

    Attributes:
        stamp_ns: capture time, nanoseconds.
        names: n names, without the body's id.
        position: (n,) radians; NaN where the angle cannot be computed at all.
        velocity: (n,) radians per second.
        position_stddev: (n,) radians; infinity where there is no estimate.
        velocity_stddev: (n,) radians per second.
    """

    stamp_ns: int
    names: tuple[str, ...]
    position: FloatArray
    velocity: FloatArray
    position_stddev: FloatArray
    velocity_stddev: FloatArray

"""Curves of joint angles beside the scene: those of a limb, or each as the user chooses."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import viser
from viser import uplot

from body_tracking.core.skeleton import FloatArray
from body_tracking.kinematics.labels import by_limb, label_of
from body_tracking.viewing.curves import AngleHistory, Curve, first_choice, heading_of

PLOTS: Final = 4
"""Number of plots."""
POINTS: Final = 200
"""Largest number of points of a plotted curve: about one per two pixels."""
HEIGHT: Final = 92
"""Height of a plot, pixels: all plots fit a window of 720."""
FONT: Final = "10px sans-serif"
SPACE: Final = 12
"""Least distance between two labels of the vertical axis, pixels: low enough that there are always two."""
LEAST: Final = 2.0
"""Smallest range of the vertical axis, degrees: of a smaller one the labels have no room for their decimals."""
NONE: Final = "none yet"


class Plots:
    """The plots; only angles that are known can be chosen.

    Args:
        gui: of the page.
        window: seconds that the plots show.
    """

    def __init__(self, gui: viser.GuiApi, window: float) -> None:
        self._usual = NONE
        """Heading of the first choice."""
        self._limb: Any = gui.add_dropdown("show", (NONE,))
        self._shown = ""
        self._known: tuple[str, ...] = ()
        self._plots = [_Plot(gui, window) for _ in range(PLOTS)]

    def draw(self, history: AngleHistory, age: float = 0.0) -> None:
        """Show the chosen angles, which came last this many seconds ago."""
        known = history.known()
        # an angle that is lost stays in the lists until others come
        if not set(known) <= set(self._known) or set(self._known) - set(history.names):
            self._known = tuple(name for own in by_limb(known).values() for name in own)
            before, self._usual = self._usual, heading_of(first_choice(self._known, PLOTS))
            limbs = tuple(dict.fromkeys((self._usual, *by_limb(known))))
            if self._limb.options != limbs:
                kept = self._limb.value
                self._limb.options = limbs
                self._limb.value = kept if kept in limbs and kept != before else self._usual
            self._shown = ""
        limb = self._limb.value
        if limb != self._shown:
            own = first_choice(self._known, PLOTS) if limb == self._usual else by_limb(self._known).get(limb, ())
            for place, plot in enumerate(self._plots):
                plot.offer(self._known, own[place] if place < len(own) else "")
            self._shown = limb
        for plot in self._plots:
            plot.draw(history, age)


class _Plot:
    """A plot of an angle chosen by the user, with its band.

    Args:
        gui: to add it to.
        window: seconds.
    """

    def __init__(self, gui: viser.GuiApi, window: float) -> None:
        self._names: dict[str, str] = {}
        self._choice: Any = gui.add_dropdown("angle", (NONE,))
        empty = np.array([-window, 0.0])
        nothing = np.zeros(2)
        hidden = uplot.Series(label="", stroke="rgba(0,0,0,0)", width=0.0, points={"show": False})
        self._plot = gui.add_uplot(
            (empty, nothing, nothing, nothing, nothing),
            (
                uplot.Series(label="s"),
                uplot.Series(label="deg", stroke="rgb(38,108,190)", width=1.6, points={"show": False}),
                hidden,
                hidden,
                hidden,
            ),
            bands=(uplot.Band(series=(3, 2), fill="rgba(38,108,190,0.18)"),),
            scales={"x": uplot.Scale(time=False, range=(-window, 0.0)), "y": uplot.Scale(auto=True)},
            axes=(
                uplot.Axis(size=20, label="s", labelSize=12, labelFont=FONT, labelGap=-2),
                uplot.Axis(
                    size=38,
                    label="degrees",
                    labelSize=14,
                    labelFont=FONT,
                    font=FONT,
                    space=SPACE,
                    gap=3,
                    ticks={"size": 4},
                ),
            ),
            legend=uplot.Legend(show=False),
            height=HEIGHT,
            padding=(7, 8, 0, 0),  # above: half a label, which was cut off where a tick is at the top
        )
        self._choice.visible = self._plot.visible = False  # until there is an angle

    def offer(self, names: tuple[str, ...], chosen: str) -> None:
        """Offer these angles, and show the chosen one; hide the plot without a chosen one."""
        self._names = {label_of(name): name for name in names} or {NONE: ""}
        self._choice.options = tuple(self._names)
        self._choice.visible = self._plot.visible = bool(chosen)
        if chosen:
            self._choice.value = label_of(chosen)

    def draw(self, history: AngleHistory, age: float) -> None:
        """Show the chosen angle; its age in seconds."""
        curve = history.curve(self._names.get(self._choice.value, ""), POINTS)
        if curve is not None:
            self._plot.data = (curve.times, curve.values, curve.low, curve.high, widened(curve))
            self._choice.label = curve.latest(age)


def widened(curve: Curve) -> FloatArray:
    """(n,) values of an invisible series, degrees, that gives the vertical axis its smallest range."""
    middle = 0.5 * (curve.low.min() + curve.high.max())
    ends: FloatArray = middle + np.linspace(-0.5, 0.5, len(curve.times)) * LEAST
    return ends

"""Pictures of sensor placements."""

import numpy as np
from matplotlib.artist import Artist
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from skin.plot.figures import COLOURS

_SHADE = "#BBBBBB"


def placement(
    chosen: np.ndarray,
    before: np.ndarray,
    sites: np.ndarray,
    size: tuple[float, float],
    forbidden: np.ndarray | None,
    title: str,
) -> Figure:
    """Draw the surface with its keep-out zones, the candidate sites, and the sensors before and after.

    Args:
        chosen: (k, 2), m, the placed sensors.
        before: (S, 2), m, those of the configured layout.
        sites: (C, 2), m.
        size: extent (x, y) of the surface, m.
        forbidden: (h, w), bool, the keep-out zones, row by row from the upper left; or None.
        title: of the figure.
    """
    # A margin for labels and the legend is added to a sheet whose longer side is 5 inches.
    scale = 5 / max(size)
    figure = Figure(figsize=(scale * size[0] + 2.8, max(scale * size[1], 1.8) + 0.9), layout="constrained")
    axis = figure.add_subplot()
    extent = (0, 1e3 * size[0], 1e3 * size[1], 0)
    marks: list[Artist] = []
    if forbidden is not None:
        shade = np.ma.masked_equal(forbidden, False)
        axis.imshow(shade, extent=extent, cmap=ListedColormap([_SHADE]), interpolation="nearest")
        marks.append(Patch(color=_SHADE, label="keep-out zone"))
    x, y = 1e3 * sites.T
    marks += axis.plot(x, y, ".", color=_SHADE, markersize=2, label=f"{len(sites)} sites")
    x, y = 1e3 * before.T
    (old,) = axis.plot(x, y, "s", color=COLOURS[1], label=f"configured layout, {len(before)}")
    old.set(markersize=9, markerfacecolor="none")
    marks.append(old)
    x, y = 1e3 * chosen.T
    marks += axis.plot(x, y, "o", color=COLOURS[0], markersize=6, label=f"placed, {len(chosen)}")
    axis.set(xlabel="x, mm", ylabel="y, mm", xlim=extent[:2], ylim=extent[2:], aspect="equal", title=title)
    axis.legend(handles=marks, loc="upper left", bbox_to_anchor=(1.01, 1), frameon=False)
    return figure

"""The base of every animated view: the touch that is shown, and its readings over time."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.axes3d import Axes3D

from skin.body.base import AbstractBody
from skin.errors import InputError

FORCE = "viridis"  # colours of forces


@dataclass(frozen=True)
class Scene:
    """One touch, with what is known of it.

    Attributes:
        readings: (T, S), N, 0 where not valid.
        positions: (T, S, 3), m.
        size: extent (x, y) of the sheet, m.
        rate: frames per second, Hz.
        title: of the picture.
        pressure: (T, H, W), Pa; None where nobody knows it.
        moved: (T, ny + 1, nx + 1), m, of the surface into the skin; None where nobody asked for it or knows.
        body: what is touched, if it is not flat; None: a sheet.
    """

    readings: np.ndarray
    positions: np.ndarray
    size: tuple[float, float]
    rate: float
    title: str
    pressure: np.ndarray | None = None
    moved: np.ndarray | None = None
    body: AbstractBody | None = None

    @property
    def strongest(self) -> float:
        """The largest reading, N; 1 where there is none above 0."""
        most = float(self.readings.max(initial=0))
        return most if most > 0 else 1.0

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Where a picture of the sheet lies, mm, y downwards."""
        return 0, 1e3 * self.size[0], 1e3 * self.size[1], 0

    @staticmethod
    def known(values: np.ndarray | None) -> np.ndarray:
        """Return the movement of the surface, or its pressure.

        Raises:
            InputError: nobody knows them.
        """
        if values is None:
            raise InputError(
                "view=skin3d needs the pressure on the skin, which only device=simulated knows: "
                "give view=flat or view=sensors3d"
            )
        return values


Draw = Callable[[int], None]


def space_and_traces(figure: Figure) -> tuple[Axes3D, Axes]:
    grid = figure.add_gridspec(1, 2, width_ratios=(1.4, 1))
    return figure.add_subplot(grid[0], projection="3d"), figure.add_subplot(grid[1])


def clear(axis: Axes3D) -> None:
    for shown in list(axis.collections):
        shown.remove()


def draw_traces(axis: Axes, scene: Scene) -> Draw:
    """Draw all readings over time, with a line that says when the rest of the picture is."""
    axis.plot(np.arange(len(scene.readings)) / scene.rate, scene.readings, linewidth=0.8)
    line = axis.axvline(0, color="black", linewidth=0.8, linestyle=":")
    axis.set(xlabel="time, s", ylabel="readings, N", xlim=(0, max(1, len(scene.readings) - 1) / scene.rate))

    def draw(frame: int) -> None:
        line.set_xdata([frame / scene.rate] * 2)

    return draw


def places(scene: Scene, frame: int) -> np.ndarray:
    """Return where the sensors are, x and y, (2, S), mm."""
    return 1e3 * scene.positions[frame, :, :2].T


def norm(scene: Scene) -> Normalize:
    return Normalize(0, scene.strongest)

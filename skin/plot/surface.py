"""Displacement of the whole skin under a pressure (report, figures 2 and 3)."""

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.simulator._assembly import Constraint, Structure
from skin.simulator._factors import factorised
from skin.simulator.base import AbstractSimulator


def deflection(body: AbstractBody, pressure: Tensor, constraint: Constraint = "vertical") -> np.ndarray:
    """Return the inward displacement of each node, (F, layers, ny + 1, nx + 1), m, from the base up.

    The plates and beams of :class:`skin.simulator.fem.PlatesAndBeams`, solved for the frames themselves and
    not for the sensors: one factorisation, one solve per frame. The table, which does not move, is left out.

    Args:
        body: the sheet.
        pressure: (F, H, W), Pa, on the cells of its surface.
        constraint: as in :class:`skin.simulator._assembly.Structure`.
    """
    structure = Structure(body, constraint)
    factors = factorised(structure.stiffness())
    loads = structure.load() @ pressure.flatten(1).double().numpy().T
    down = -factors.solve(loads).reshape(-1, len(structure.free), len(pressure))[:, structure.free.index(2)]
    return np.moveaxis(down.reshape(*structure.grid, len(pressure)), -1, 0)


def surface_motion(model: AbstractSimulator, body: AbstractBody, pressure: Tensor) -> np.ndarray | None:
    """Return how far the surface moves into the skin, (F, ny + 1, nx + 1), m, or None where nobody knows.

    By the simulator's own compliance if it has one, else by plates and beams if the body is flat.

    Args:
        model: the simulator.
        body: what is pressed.
        pressure: (F, H, W), Pa; friction is left out.
    """
    try:
        compliance = model.compliance()
    except InputError:
        return deflection(body, pressure)[:, -1] if body.flat else None
    cells = (pressure.flatten(1).to(compliance) @ compliance).reshape(pressure.shape).numpy()
    around = np.pad(cells, ((0, 0), (1, 1), (1, 1)), mode="edge")
    return (around[:, 1:, 1:] + around[:, :-1, 1:] + around[:, 1:, :-1] + around[:, :-1, :-1]) / 4


def draw_surface(
    axis: Axes3D, moved: np.ndarray, depth: float, size: tuple[float, float], most: float
) -> None:
    """Draw a face of the deformed skin in space, its height stretched to be seen.

    Args:
        axis: what to draw on.
        moved: (ny + 1, nx + 1), m, into the skin.
        depth: of the face below the surface where nothing presses, m.
        size: extent (x, y) of the sheet, m.
        most: the movement that takes the last colour and the whole height, m.
    """
    most = max(most, 1e-9)
    places = np.meshgrid(*(np.linspace(0, 1e3 * size[axis], moved.shape[1 - axis]) for axis in (0, 1)))
    height = -1e3 * (moved + depth)
    colours = colormaps["viridis"](moved / most)
    axis.plot_surface(*places, height, facecolors=colours, rcount=50, ccount=50, shade=False)
    axis.set(xlabel="x, mm", ylabel="y, mm", zlabel="height, mm", zlim=(-1e3 * (depth + most), -1e3 * depth))
    axis.set(xlim=(0, 1e3 * size[0]), ylim=(1e3 * size[1], 0))
    axis.zaxis.set_major_locator(MaxNLocator(4))
    axis.set_box_aspect((size[0], size[1], 0.3 * max(size)))
    axis.view_init(elev=48, azim=-65)


def surface(moved: np.ndarray, depth: float, size: tuple[float, float], title: str) -> Figure:
    """Draw one face of the deformed skin in space, and as a map (report, figures 2 and 3).

    Args:
        moved: (ny + 1, nx + 1), m, into the skin.
        depth: of the face below the surface where nothing presses, m.
        size: extent (x, y) of the sheet, m.
        title: of the figure.
    """
    figure = Figure(figsize=(9.5, 3.8), layout="constrained")
    figure.suptitle(title)
    space = figure.add_subplot(1, 2, 1, projection="3d")
    draw_surface(space, moved, depth, size, float(moved.max()))
    flat = figure.add_subplot(1, 2, 2)
    extent = (0, 1e3 * size[0], 1e3 * size[1], 0)
    shown = flat.imshow(1e3 * moved, cmap="viridis", extent=extent, interpolation="bilinear")
    figure.colorbar(shown, ax=flat, label="into the skin, mm")
    flat.set(xlabel="x, mm", ylabel="y, mm")
    return figure

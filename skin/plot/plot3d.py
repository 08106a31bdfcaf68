"""Touches on a curved body, drawn in three dimensions (report, figure 9)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d.art3d import Line3DCollection, Poly3DCollection
from mpl_toolkits.mplot3d.axes3d import Axes3D
from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.mechanics.simulator.base import AbstractSimulator, factorised
from skin.mechanics.simulator.fem import Constraint, Structure

# The base of every animated view: the touch that is shown, and its readings over time.


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
        maximum = float(self.readings.max(initial=0))
        return maximum if maximum > 0 else 1.0

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


def draw_traces(axis: Axes, scene: Scene) -> Draw:
    """Draw all readings over time, with a line that says when the rest of the picture is."""
    axis.plot(np.arange(len(scene.readings)) / scene.rate, scene.readings, linewidth=0.8)
    line = axis.axvline(0, color="black", linewidth=0.8, linestyle=":")
    axis.set(xlabel="time, s", ylabel="readings, N", xlim=(0, max(1, len(scene.readings) - 1) / scene.rate))

    def draw(frame: int) -> None:
        line.set_xdata([frame / scene.rate] * 2)

    return draw


def sensor_points(scene: Scene, frame: int) -> np.ndarray:
    """Return where the sensors are, x and y, (2, S), mm."""
    return 1e3 * scene.positions[frame, :, :2].T


def beside_traces(
    sheet: Callable[[Axes3D, Scene], Draw], curved: Callable[[Axes3D, Scene, AbstractBody], Draw]
) -> Callable[[Figure, Scene], Draw]:
    """Return a view in space, of a sheet or of another body, beside all readings over time."""

    def show(figure: Figure, scene: Scene) -> Draw:
        grid = figure.add_gridspec(1, 2, width_ratios=(1.4, 1))
        axis, right = figure.add_subplot(grid[0], projection="3d"), figure.add_subplot(grid[1])
        now = draw_traces(right, scene)
        paint = sheet(axis, scene) if scene.body is None else curved(axis, scene, scene.body)

        def draw(frame: int) -> None:
            for artist in list(axis.collections):
                artist.remove()
            paint(frame)
            now(frame)

        return draw

    return show


# Displacement of the whole skin under a pressure (report, figures 2 and 3).


def deflection(body: AbstractBody, pressure: Tensor, constraint: Constraint = "vertical") -> np.ndarray:
    """Return the inward displacement of each node, (F, layers, ny + 1, nx + 1), m, from the base up.

    The plates and beams of :class:`skin.mechanics.simulator.fem.PlatesAndBeams`, solved for the frames
    themselves and
    not for the sensors: one factorisation, one solve per frame. The table, which does not move, is left out.

    Args:
        body: the sheet.
        pressure: (F, H, W), Pa, on the cells of its surface.
        constraint: as in :class:`skin.mechanics.simulator.fem.Structure`.
    """
    structure = Structure(body, constraint)
    factors = factorised(structure.stiffness())
    loads = structure.load() @ pressure.flatten(1).double().numpy().T
    down = -factors.solve(loads).reshape(-1, len(structure.free), len(pressure))[:, structure.free.index(2)]
    return np.moveaxis(down.reshape(*structure.grid, len(pressure)), -1, 0)


def surface_motion(model: AbstractSimulator, body: AbstractBody, loads: Tensor) -> np.ndarray | None:
    """Return how far the surface moves into the skin, (F, ny + 1, nx + 1), m, or None where nobody knows.

    By the simulator if it computes it, else by plates and beams if the body is flat.

    Args:
        model: the simulator.
        body: what is pressed.
        loads: (F, H, W), of the simulator, Pa; friction is left out.
    """
    moved = model.surface(loads)
    if moved is not None:
        return moved.numpy()
    return deflection(body, loads)[:, -1] if body.flat else None


def draw_surface(
    axis: Axes3D, moved: np.ndarray, depth: float, size: tuple[float, float], maximum: float
) -> None:
    """Draw a face of the deformed skin in space, its height stretched to be seen.

    Args:
        axis: what to draw on.
        moved: (ny + 1, nx + 1), m, into the skin.
        depth: of the face below the surface where nothing presses, m.
        size: extent (x, y) of the sheet, m.
        maximum: the movement that takes the last colour and the whole height, m.
    """
    maximum = max(maximum, 1e-9)
    positions = np.meshgrid(*(np.linspace(0, 1e3 * size[axis], moved.shape[1 - axis]) for axis in (0, 1)))
    height = -1e3 * (moved + depth)
    colours = colormaps["viridis"](moved / maximum)
    axis.plot_surface(*positions, height, facecolors=colours, rcount=50, ccount=50, shade=False)
    axis.set(
        xlabel="x, mm",
        ylabel="y, mm",
        zlabel="height, mm",
        xlim=(0, 1e3 * size[0]),
        ylim=(1e3 * size[1], 0),
        zlim=(-1e3 * (depth + maximum), -1e3 * depth),
    )
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
    image = flat.imshow(1e3 * moved, cmap="viridis", extent=extent, interpolation="bilinear")
    figure.colorbar(image, ax=flat, label="into the skin, mm")
    flat.set(xlabel="x, mm", ylabel="y, mm")
    return figure


_ELEVATION, _AZIMUTH = 38.0, -62.0  # degrees, of the eye
# Towards the eye; y is drawn upside down, so that the chart is seen from outside as it is in flat pictures.
_EYE = np.array(
    [
        np.cos(np.radians(_ELEVATION)) * np.cos(np.radians(_AZIMUTH)),
        -np.cos(np.radians(_ELEVATION)) * np.sin(np.radians(_AZIMUTH)),
        np.sin(np.radians(_ELEVATION)),
    ]
)
_LIGHT, _SHADE = np.array([-0.3, 0.4, 0.87]), 0.45  # towards it; what it takes away where it does not shine
_SKIN = (0.91, 0.81, 0.75, 1.0)
_LAYERS = ("#B98F76", "#DDBBA6")  # of the rim, by turns from the core outwards
_LONGEST = 0.4  # longest bar, of the body's smaller extent


@dataclass(frozen=True)
class _Shell:
    """A body's surface in space, mm.

    Attributes:
        body: whose.
    """

    body: AbstractBody

    @cached_property
    def lines(self) -> tuple[np.ndarray, ...]:
        """The (ny + 1, nx + 1) nodes in the chart, m: x and y."""
        return np.meshgrid(
            *(np.linspace(0, self.body.size[axis], self.body.cells[axis] + 1) for axis in (0, 1))
        )

    def surface(self, depth: np.ndarray) -> np.ndarray:
        """Return where the surface is, (ny + 1, nx + 1, 3), mm, pushed in by a depth (ny + 1, nx + 1), m."""
        return 1e3 * self.body.locate(np.stack([*self.lines, depth], axis=-1))

    def rims(self) -> list[np.ndarray]:
        """Return the layers' faces where y ends, from the core outwards, (2, nx + 1, 3) each, mm."""
        depths = (self.body.thickness, *self.body.interfaces)
        x, y = (line[-1] for line in self.lines)
        return [
            1e3 * self.body.locate(np.stack([np.stack([x, y, 0 * x + depth], axis=-1) for depth in pair]))
            for pair in pairwise(depths)
        ]


def skin_in_space(axis: Axes3D, scene: Scene, body: AbstractBody) -> Draw:
    """Show the surface as it moves and the sensors; where nobody knows the movement, the pressure."""
    frames = scene.known(scene.pressure if scene.moved is None else scene.moved)
    shell, maximum, stretch = _Shell(body), max(float(frames.max()), 1e-9), 1.0
    if scene.moved is None:
        scale, what = Normalize(0, maximum / 1e3), "pressure, kPa"
    else:
        stretch = max(1.0, float(round(0.5 * body.thickness / maximum)))
        scale, what = Normalize(0, 1e3 * maximum), f"into the skin, mm (drawn {stretch:g} times)"
    axis.figure.colorbar(ScalarMappable(scale, FORCE), ax=axis, label=what, shrink=0.6, pad=0.02)
    _stand(axis, shell)

    def draw(frame: int) -> None:
        if scene.moved is None:
            _skin(
                axis, shell.surface(np.zeros_like(shell.lines[0])), colormaps[FORCE](frames[frame] / maximum)
            )
        else:
            moved = scene.moved[frame]
            _skin(axis, shell.surface(stretch * moved), colormaps[FORCE](_mean(moved) / maximum))
        _rims(axis, shell)
        _dots(axis, body, scene.positions[frame])

    return draw


def sensors_in_space(axis: Axes3D, scene: Scene, body: AbstractBody) -> Draw:
    """Show each sensor's reading as a bar that stands out of the surface over its position."""
    colour, shell, longest = Normalize(0, scene.strongest), _Shell(body), _LONGEST * min(body.size)
    bare = np.broadcast_to(_SKIN, (*body.shape, 4))
    surface = shell.surface(np.zeros_like(shell.lines[0]))
    axis.figure.colorbar(ScalarMappable(colour, FORCE), ax=axis, label="reading, N", shrink=0.6, pad=0.02)
    _stand(axis, shell, longest)

    def draw(frame: int) -> None:
        _skin(axis, surface, bare)
        height = np.maximum(scene.readings[frame], 0)
        foot = scene.positions[frame] * [1.0, 1.0, 0.0]
        tip = foot - np.outer(longest * height / scene.strongest, [0.0, 0.0, 1.0])
        ends = 1e3 * np.stack([body.locate(foot), body.locate(tip)], axis=1)
        _rims(axis, shell)
        _dots(axis, body, foot)
        seen, colours = _faces_eye(body, foot), colormaps[FORCE](colour(height))
        for side, order in ((~seen, 0), (seen, 4)):
            bars = Line3DCollection(list(ends[side]), colors=colours[side], linewidths=4, zorder=order)
            axis.add_collection(bars)

    return draw


def _stand(axis: Axes3D, shell: _Shell, above: float = 0.0) -> None:
    """Set the axes around a body out of which something may stand, m."""
    # Matplotlib would order whole surfaces by their middles, and hide the sensors below.
    axis.computed_zorder = False
    flat = np.zeros_like(shell.lines[0])
    reached = np.concatenate(
        [shell.surface(flat - above).reshape(-1, 3), *(rim.reshape(-1, 3) for rim in shell.rims())]
    )
    low, high = reached.min(axis=0), reached.max(axis=0)
    axis.set(xlim=(low[0], high[0]), ylim=(high[1], low[1]), zlim=(low[2], high[2]))
    axis.set_box_aspect(tuple(high - low), zoom=1.15)
    axis.view_init(elev=_ELEVATION, azim=_AZIMUTH)
    axis.set_axis_off()


def _skin(axis: Axes3D, positions: np.ndarray, colours: np.ndarray) -> None:
    """Draw a surface (ny + 1, nx + 1, 3), mm, with the colours (ny, nx, 4) of its faces, lit from above."""
    across = positions[1:, 1:] - positions[:-1, :-1], positions[1:, :-1] - positions[:-1, 1:]
    outwards = np.cross(*across)
    outwards /= np.linalg.norm(outwards, axis=-1, keepdims=True)
    light = 1 - _SHADE + _SHADE * np.clip(outwards @ _LIGHT, 0, 1)[..., None]
    lit = np.concatenate([colours[..., :3] * light, colours[..., 3:]], axis=-1)
    x, y, z = np.moveaxis(positions, -1, 0)
    axis.plot_surface(x, y, z, facecolors=lit, rcount=200, ccount=200, shade=False, zorder=1)


def _rims(axis: Axes3D, shell: _Shell) -> None:
    """Draw the layers where the body ends towards the eye."""
    for number, rim in enumerate(shell.rims()):
        faces = np.stack([rim[0, :-1], rim[0, 1:], rim[1, 1:], rim[1, :-1]], axis=1)
        colour = _LAYERS[number % 2]
        axis.add_collection(Poly3DCollection(list(faces), facecolors=colour, edgecolors=colour, zorder=2))


def _dots(axis: Axes3D, body: AbstractBody, positions: np.ndarray) -> None:
    """Draw the sensors (S, 3), m, that lie on the side of the eye."""
    x, y, z = 1e3 * body.locate(positions[_faces_eye(body, positions)]).T
    axis.scatter(x, y, z, s=9, c="black", depthshade=False, zorder=3)


def _faces_eye(body: AbstractBody, positions: np.ndarray) -> np.ndarray:
    return body.frame(positions)[:, 2] @ _EYE < 0


def _mean(nodes: np.ndarray) -> np.ndarray:
    """Return the means (ny, nx) over each face of values (ny + 1, nx + 1) at nodes."""
    return (nodes[1:, 1:] + nodes[:-1, 1:] + nodes[1:, :-1] + nodes[:-1, :-1]) / 4

"""Touches as animated pictures: from above, as bars over sensors, as the deformed skin (report, 2.1.1)."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.axes3d import Axes3D
from PIL.Image import Dither, Image, fromarray, new

from skin.errors import InputError
from skin.representation._pixels import centres
from skin.representation.interp import weights
from skin.results.surface import draw_surface

__all__ = ["VIEWS", "Scene", "thinning", "write"]

_FASTEST, _LONGEST = 25.0, 100  # frames per second, frames
_PIXELS = 48
_COLOURS = 96
_NAMED = 40  # sensors whose readings can be read as numbers beside them
_SHOWN = 0.15  # share of the strongest reading
_FORCE = "viridis"
_HALO = (withStroke(linewidth=2, foreground="white"),)


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
        moved: (T, ny + 1, nx + 1), m, of the surface into the skin; None where nobody asked for it.
    """

    readings: np.ndarray
    positions: np.ndarray
    size: tuple[float, float]
    rate: float
    title: str
    pressure: np.ndarray | None = None
    moved: np.ndarray | None = None

    @property
    def strongest(self) -> float:
        """The largest reading, N; 1 where there is none above 0."""
        most = float(self.readings.max(initial=0))
        return most if most > 0 else 1.0

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """Where a picture of the sheet lies, mm, y downwards."""
        return 0, 1e3 * self.size[0], 1e3 * self.size[1], 0


Draw = Callable[[int], None]


def write(scene: Scene, view: str, path: Path) -> Path:
    """Write the animation of a touch as GIF, whole: under a temporary name, then in place of what was there.

    It plays in real time; more than 100 frames, or more than 25 a second, are thinned out.

    Args:
        scene: the touch.
        view: ``flat``, ``sensors3d`` or ``skin3d``.
        path: ``x.gif``.

    Raises:
        InputError: an unknown view, one that needs what the scene does not have, or a folder that cannot be
            written.
    """
    if view not in VIEWS:
        raise InputError(f"unknown view {view}: give view={' or '.join(VIEWS)}")
    step = thinning(len(scene.readings), scene.rate)
    pictures = _pictures(scene, view, range(0, len(scene.readings), step))
    unfinished = path.with_suffix(".part.gif")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        more, pause = pictures[1:], round(1e3 * step / scene.rate)
        pictures[0].save(unfinished, save_all=True, append_images=more, duration=pause, loop=0)
        return unfinished.replace(path)
    except OSError as error:
        raise InputError(f"cannot write {path}: {error}") from error
    finally:
        unfinished.unlink(missing_ok=True)


def thinning(frames: int, rate: float) -> int:
    """Return which share of the frames is shown: every first, second, ... one."""
    return max(math.ceil(frames / _LONGEST), math.ceil(rate / _FASTEST))


def _pictures(scene: Scene, view: str, frames: Sequence[int]) -> list[Image]:
    """Return the frames as pictures of one palette."""
    figure = Figure(figsize=(7.6, 3.6), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    figure.suptitle(scene.title, fontsize=10)
    draw = VIEWS[view](figure, scene)

    def shot(frame: int) -> Image:
        draw(frame)
        canvas.draw()
        return fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

    strongest = max(frames, key=lambda frame: scene.readings[frame].sum())
    palette = _palette(shot(strongest))
    figure.set_layout_engine("none")  # else it is solved again for every frame, and the picture trembles
    return [shot(frame).quantize(palette=palette, dither=Dither.NONE) for frame in frames]


def _palette(picture: Image) -> Image:
    """Return an empty picture with a palette of all readings' colours, greys, and a frame's commonest."""
    readings = colormaps[_FORCE](np.linspace(0, 1, _COLOURS), bytes=True)[:, :3]
    greys = np.linspace(0, 255, 256 - 2 * _COLOURS).astype(np.uint8)[:, None].repeat(3, axis=1)
    common = picture.quantize(_COLOURS, dither=Dither.NONE).getpalette() or []
    empty = new("P", (1, 1))
    empty.putpalette([*readings.ravel().tolist(), *greys.ravel().tolist(), *common])
    return empty


def _flat(figure: Figure, scene: Scene) -> Draw:
    """Show pressure and readings from above, and all readings over time."""
    left, right = figure.subplots(1, 2, width_ratios=(1.15, 1))
    movie, what = _between(scene), "between the sensors, N"
    if scene.pressure is not None:
        movie, what = scene.pressure / 1e3, "pressure, kPa"
    picture = left.imshow(
        movie[0], cmap="Greys", extent=scene.extent, norm=Normalize(0, max(1.6 * float(movie.max()), 1e-9))
    )
    figure.colorbar(picture, ax=left, label=what, shrink=0.8)
    dots = left.scatter(
        *_places(scene, 0), s=60, cmap=_FORCE, norm=_norm(scene), c=scene.readings[0], zorder=3
    )
    few = range(scene.readings.shape[1]) if scene.readings.shape[1] <= _NAMED else range(0)
    numbers = [left.text(0, 0, "", fontsize=7, color="#B03A00", ha="center", path_effects=_HALO) for _ in few]
    left.set(xlabel="x, mm", ylabel="y, mm", xlim=scene.extent[:2], ylim=scene.extent[2:])
    now = _traces(right, scene)

    def draw(frame: int) -> None:
        picture.set_data(movie[frame])
        dots.set_array(scene.readings[frame])
        places = _places(scene, frame)
        dots.set_offsets(places.T)
        for sensor, number in enumerate(numbers):
            number.set_position((places[0, sensor], places[1, sensor] - 0.03 * scene.extent[2]))
            reading = scene.readings[frame, sensor]
            # what is nearly nothing would only flicker
            number.set_text(f"{reading:.1f}" if reading > _SHOWN * scene.strongest else "")
        now(frame)

    return draw


def _sensors3d(figure: Figure, scene: Scene) -> Draw:
    """Show each sensor's reading as a bar over its place."""
    axis, right = _space_and_traces(figure)
    now, norm = _traces(right, scene), _norm(scene)
    width = 450 * math.sqrt(scene.size[0] * scene.size[1] / scene.readings.shape[1])
    axis.set(xlabel="x, mm", ylabel="y, mm", zlabel="reading, N", zlim=(0, scene.strongest))
    axis.set(xlim=scene.extent[:2], ylim=scene.extent[2:])
    axis.set_box_aspect((*scene.size, 0.6 * max(scene.size)))

    def draw(frame: int) -> None:
        _clear(axis)
        height = np.maximum(scene.readings[frame], 0)
        x, y = _places(scene, frame)
        colours = colormaps[_FORCE](norm(height))
        axis.bar3d(x - width / 2, y - width / 2, 0, width, width, height, color=colours)
        now(frame)

    return draw


def _skin3d(figure: Figure, scene: Scene) -> Draw:
    """Show the surface of the whole skin as it moves."""
    if scene.moved is None:
        raise InputError(
            "view=skin3d needs the pressure on the skin, which only device=simulated knows: "
            "give view=flat or view=sensors3d"
        )
    moved = scene.moved
    axis, right = _space_and_traces(figure)
    now = _traces(right, scene)

    def draw(frame: int) -> None:
        _clear(axis)
        draw_surface(axis, moved[frame], 0.0, scene.size, float(moved.max()))
        now(frame)

    return draw


VIEWS = {"flat": _flat, "sensors3d": _sensors3d, "skin3d": _skin3d}


def _space_and_traces(figure: Figure) -> tuple[Axes3D, Axes]:
    grid = figure.add_gridspec(1, 2, width_ratios=(1.4, 1))
    return figure.add_subplot(grid[0], projection="3d"), figure.add_subplot(grid[1])


def _clear(axis: Axes3D) -> None:
    for shown in list(axis.collections):
        shown.remove()


def _traces(axis: Axes, scene: Scene) -> Draw:
    """Draw all readings over time, with a line that says when the rest of the picture is."""
    axis.plot(np.arange(len(scene.readings)) / scene.rate, scene.readings, linewidth=0.8)
    line = axis.axvline(0, color="black", linewidth=0.8, linestyle=":")
    axis.set(xlabel="time, s", ylabel="readings, N", xlim=(0, max(1, len(scene.readings) - 1) / scene.rate))

    def draw(frame: int) -> None:
        line.set_xdata([frame / scene.rate] * 2)

    return draw


def _between(scene: Scene) -> np.ndarray:
    """Return readings interpolated over the sheet, (T, pixels, pixels), N."""
    points = scene.positions.mean(axis=0)[:, :2]
    try:
        matrix = weights(points, centres(scene.size, _PIXELS), "linear")
    except InputError:  # sensors on one line make no triangle
        matrix = weights(points, centres(scene.size, _PIXELS), "nearest")
    return np.maximum(scene.readings @ matrix.T, 0).reshape(-1, _PIXELS, _PIXELS)


def _places(scene: Scene, frame: int) -> np.ndarray:
    """Return where the sensors are, x and y, (2, S), mm."""
    return 1e3 * scene.positions[frame, :, :2].T


def _norm(scene: Scene) -> Normalize:
    return Normalize(0, scene.strongest)

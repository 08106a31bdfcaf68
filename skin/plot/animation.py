"""Animations of touches: from above, as bars over sensors, as the deformed skin (report, 2.1.1)."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL.Image import Dither, Image, fromarray, new

from skin.errors import InputError
from skin.files import whole
from skin.plot.figures import save_figure
from skin.plot.plot3d import sensors_in_space, skin_in_space
from skin.plot.surface import draw_surface
from skin.plot.view import FORCE, Draw, Scene, clear, draw_traces, norm, places, space_and_traces
from skin.representation._interpolation import weights
from skin.representation._pixels import centres

_FASTEST, _LONGEST = 25.0, 100  # frames per second, frames
_PIXELS = 48
_COLOURS = 96
_NAMED = 40  # sensors whose readings can be read as numbers beside them
_SHOWN = 0.15  # share of the strongest reading
_HALO = (withStroke(linewidth=2, foreground="white"),)


def write_animation(scene: Scene, view: str, path: Path) -> Path:
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
    step = thinning(len(scene.readings), scene.rate)
    pictures = _pictures(scene, view, range(0, len(scene.readings), step))
    more, pause = pictures[1:], round(1e3 * step / scene.rate)
    with whole(path) as partial:
        pictures[0].save(partial, save_all=True, append_images=more, duration=pause, loop=0)
    return path


def still(scene: Scene, view: str, path: Path) -> Path:
    """Write the frame with the largest sum of readings as PNG, whole.

    Args:
        scene, view: as in :func:`write_animation`.
        path: ``x.png``.

    Raises:
        InputError: as in :func:`write_animation`.
    """
    figure = Figure(figsize=(9.5, 4.5), layout="constrained")
    _stage(figure, scene, view)(int(scene.readings.sum(axis=1).argmax()))
    return save_figure(figure, path)


def thinning(frames: int, rate: float) -> int:
    """Return which share of the frames is shown: every first, second, ... one."""
    return max(math.ceil(frames / _LONGEST), math.ceil(rate / _FASTEST))


def _pictures(scene: Scene, view: str, frames: Sequence[int]) -> list[Image]:
    """Return the frames as pictures of one palette."""
    figure = Figure(figsize=(7.6, 3.6), dpi=80, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    draw = _stage(figure, scene, view)

    def shot(frame: int) -> Image:
        draw(frame)
        canvas.draw()
        return fromarray(np.asarray(canvas.buffer_rgba())[..., :3])

    strongest = max(frames, key=lambda frame: scene.readings[frame].sum())
    palette = _palette(shot(strongest))
    figure.set_layout_engine("none")  # else it is solved again for every frame, and the picture trembles
    return [shot(frame).quantize(palette=palette, dither=Dither.NONE) for frame in frames]


def _stage(figure: Figure, scene: Scene, view: str) -> Draw:
    if view not in VIEWS:
        raise InputError(f"unknown view {view}: give view={' or '.join(VIEWS)}")
    figure.suptitle(scene.title, fontsize=10)
    return VIEWS[view](figure, scene)


def _palette(picture: Image) -> Image:
    """Return an empty picture with a palette of all readings' colours, greys, and a frame's commonest."""
    readings = colormaps[FORCE](np.linspace(0, 1, _COLOURS), bytes=True)[:, :3]
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
    dots = left.scatter(*places(scene, 0), s=60, cmap=FORCE, norm=norm(scene), c=scene.readings[0], zorder=3)
    few = range(scene.readings.shape[1]) if scene.readings.shape[1] <= _NAMED else range(0)
    numbers = [left.text(0, 0, "", fontsize=7, color="#B03A00", ha="center", path_effects=_HALO) for _ in few]
    left.set(xlabel="x, mm", ylabel="y, mm", xlim=scene.extent[:2], ylim=scene.extent[2:])
    now = draw_traces(right, scene)

    def draw(frame: int) -> None:
        picture.set_data(movie[frame])
        dots.set_array(scene.readings[frame])
        where = places(scene, frame)
        dots.set_offsets(where.T)
        for sensor, number in enumerate(numbers):
            number.set_position((where[0, sensor], where[1, sensor] - 0.03 * scene.extent[2]))
            reading = scene.readings[frame, sensor]
            # what is nearly nothing would only flicker
            number.set_text(f"{reading:.1f}" if reading > _SHOWN * scene.strongest else "")
        now(frame)

    return draw


def _sensors3d(figure: Figure, scene: Scene) -> Draw:
    """Show each sensor's reading as a bar over its place."""
    if scene.body is not None:
        return sensors_in_space(figure, scene, scene.body)
    axis, right = space_and_traces(figure)
    now, colour = draw_traces(right, scene), norm(scene)
    width = 450 * math.sqrt(scene.size[0] * scene.size[1] / scene.readings.shape[1])
    axis.set(xlabel="x, mm", ylabel="y, mm", zlabel="reading, N", zlim=(0, scene.strongest))
    axis.set(xlim=scene.extent[:2], ylim=scene.extent[2:])
    axis.set_box_aspect((*scene.size, 0.6 * max(scene.size)))

    def draw(frame: int) -> None:
        clear(axis)
        height = np.maximum(scene.readings[frame], 0)
        x, y = places(scene, frame)
        colours = colormaps[FORCE](colour(height))
        axis.bar3d(x - width / 2, y - width / 2, 0, width, width, height, color=colours)
        now(frame)

    return draw


def _skin3d(figure: Figure, scene: Scene) -> Draw:
    """Show the surface of the whole skin as it moves."""
    if scene.body is not None:
        return skin_in_space(figure, scene, scene.body)
    moved = scene.known(scene.moved)
    axis, right = space_and_traces(figure)
    now = draw_traces(right, scene)

    def draw(frame: int) -> None:
        clear(axis)
        draw_surface(axis, moved[frame], 0.0, scene.size, float(moved.max()))
        now(frame)

    return draw


VIEWS = {"flat": _flat, "sensors3d": _sensors3d, "skin3d": _skin3d}


def _between(scene: Scene) -> np.ndarray:
    """Return readings interpolated over the sheet, (T, pixels, pixels), N."""
    points = scene.positions.mean(axis=0)[:, :2]
    try:
        matrix = weights(points, centres(scene.size, _PIXELS), "linear")
    except InputError:  # sensors on one line make no triangle
        matrix = weights(points, centres(scene.size, _PIXELS), "nearest")
    return np.maximum(scene.readings @ matrix.T, 0).reshape(-1, _PIXELS, _PIXELS)

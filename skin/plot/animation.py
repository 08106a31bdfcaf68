"""Animations of touches: from above, as bars over sensors, as the deformed skin (report, 2.1.1)."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from mpl_toolkits.mplot3d.axes3d import Axes3D
from PIL.Image import Dither, Image, fromarray, new

from skin.body.base import AbstractBody
from skin.core.files import whole
from skin.device.base import AbstractDevice
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.learning.representation import centres, weights
from skin.plot.figures import save_figure
from skin.plot.plot3d import (
    FORCE,
    Draw,
    Scene,
    beside_traces,
    draw_surface,
    draw_traces,
    sensor_points,
    sensors_in_space,
    skin_in_space,
    surface_motion,
)
from skin.touch.labels import TOUCH

_FASTEST, _LONGEST = 25.0, 100  # frames per second, frames
_PIXELS = 48
_COLOURS = 96
_NAMED = 40  # sensors whose readings can be read as numbers beside them
_SHOWN_LABELS = ("big", "dynamic", "press")
_SHOWN = 0.15  # fraction of the strongest reading
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
    with whole(path) as partial:
        pictures[0].save(
            partial,
            save_all=True,
            append_images=pictures[1:],
            duration=round(1e3 * step / scene.rate),
            loop=0,
        )
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
    """Return the step between two frames that are shown: every first, second, ... one."""
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
    movie = _between(scene) if scene.pressure is None else scene.pressure / 1e3
    what = "between the sensors, N" if scene.pressure is None else "pressure, kPa"
    picture = left.imshow(
        movie[0], cmap="Greys", extent=scene.extent, norm=Normalize(0, max(1.6 * float(movie.max()), 1e-9))
    )
    figure.colorbar(picture, ax=left, label=what, shrink=0.8)
    dots = left.scatter(
        *sensor_points(scene, 0),
        s=60,
        cmap=FORCE,
        norm=Normalize(0, scene.strongest),
        c=scene.readings[0],
        zorder=3,
    )
    few = range(scene.readings.shape[1]) if scene.readings.shape[1] <= _NAMED else range(0)
    numbers = [left.text(0, 0, "", fontsize=7, color="#B03A00", ha="center", path_effects=_HALO) for _ in few]
    left.set(xlabel="x, mm", ylabel="y, mm", xlim=scene.extent[:2], ylim=scene.extent[2:])
    now = draw_traces(right, scene)

    def draw(frame: int) -> None:
        picture.set_data(movie[frame])
        dots.set_array(scene.readings[frame])
        where = sensor_points(scene, frame)
        dots.set_offsets(where.T)
        for number, x, y, reading in zip(numbers, *where, scene.readings[frame], strict=False):
            number.set_position((x, y - 0.03 * scene.extent[2]))
            # what is nearly nothing would only flicker
            number.set_text(f"{reading:.1f}" if reading > _SHOWN * scene.strongest else "")
        now(frame)

    return draw


def _bars(axis: Axes3D, scene: Scene) -> Draw:
    """Show each sensor's reading as a bar over its position."""
    colour = Normalize(0, scene.strongest)
    width = 450 * math.sqrt(scene.size[0] * scene.size[1] / scene.readings.shape[1])
    axis.set(
        xlabel="x, mm",
        ylabel="y, mm",
        zlabel="reading, N",
        xlim=scene.extent[:2],
        ylim=scene.extent[2:],
        zlim=(0, scene.strongest),
    )
    axis.set_box_aspect((*scene.size, 0.6 * max(scene.size)))

    def draw(frame: int) -> None:
        height = np.maximum(scene.readings[frame], 0)
        x, y = sensor_points(scene, frame)
        colours = colormaps[FORCE](colour(height))
        axis.bar3d(x - width / 2, y - width / 2, 0, width, width, height, color=colours)

    return draw


def _surface(axis: Axes3D, scene: Scene) -> Draw:
    """Show the surface of the whole skin as it moves."""
    moved = scene.known(scene.moved)
    return lambda frame: draw_surface(axis, moved[frame], 0.0, scene.size, float(moved.max()))


VIEWS = {
    "flat": _flat,
    "sensors3d": beside_traces(_bars, sensors_in_space),
    "skin3d": beside_traces(_surface, skin_in_space),
}


def _between(scene: Scene) -> np.ndarray:
    """Return readings interpolated over the sheet, (T, pixels, pixels), N."""
    points = scene.positions.mean(axis=0)[:, :2]
    try:
        matrix = weights(points, centres(scene.size, _PIXELS), "linear")
    except InputError:  # sensors on one line make no triangle
        matrix = weights(points, centres(scene.size, _PIXELS), "nearest")
    return np.maximum(scene.readings @ matrix.T, 0).reshape(-1, _PIXELS, _PIXELS)


# The touches that animations show: drawn on request, or taken from a device.


@torch.no_grad()
def simulate_scene(
    device: Simulated, labels: Sequence[str] | None, shape: str | None, seed: int, field: bool
) -> Scene:
    """Draw a touch as a simulated device measures it.

    Args:
        device: whose skin, sensors and imperfections are shown.
        labels: those of ``skin.touch.labels.TOUCH`` that hold; the others do not. None: those of a press
            that slides, of a big object where the touches are drawn to be big.
        shape: what presses, a name in ``data/shapes`` or the path of a picture; None: any of the device's.
        seed: of the touch.
        field: solve for the movement of the whole surface too (``skin.plot.plot3d.surface_motion``).

    Raises:
        InputError: an unknown label, or a shape of which no such touch can be made.
    """
    if labels is None:
        labels = [name for name in _SHOWN_LABELS if name in device.sampler.chosen]
    if unknown := sorted(set(labels) - set(TOUCH.names)):
        raise InputError(f"no label {', '.join(unknown)}: labels may list {', '.join(TOUCH.names)}")
    if shape is not None:
        device = device.replace(touch=replace(device.sampler.settings, shapes=(shape,)))
    generator = np.random.default_rng(seed)
    holds = np.array([[name in labels for name in TOUCH.names]])
    movie = device.sampler.sample(1, generator, holds)
    true = device.model.respond(movie).readings
    readings, *_ = device.imperfection.apply(true, device.constants, generator)
    moved = surface_motion(device.model, device.body, movie.frames) if field else None
    if moved is not None:
        moved = moved[movie.index[0]] * movie.scale[0, :, None, None].numpy()
    name = device.sampler.shapes.names[int(movie.parameters["shape"][0])]
    positions = np.broadcast_to(device.sensors.positions, (*readings.shape[1:], 3))
    return Scene(
        readings[0].numpy(), positions, device.size, device.model_rate, _title(name, holds[0], TOUCH.names),
        movie.pressure()[0].numpy(), moved, _round(device.body),
    )  # fmt: skip


def read_scene(device: AbstractDevice, index: int) -> Scene:
    """Return one touch of a device: of a whole recording, or of another device's test touches.

    Raises:
        InputError: there is no touch of that number.
    """
    touches = device.all_touches()
    if not 0 <= index < len(touches):
        raise InputError(
            f"there are {len(touches)} touches, got index={index}: give index=0 to {len(touches) - 1}"
        )
    touch = touches[index : index + 1]
    readings = touch.readings.where(touch.valid, 0)[0].numpy()
    positions = np.broadcast_to(touch.positions.numpy(), (1, *readings.shape, 3))[0]
    heading = "" if touch.labels is None else _title("", touch.labels[0].bool().numpy(), device.task.names)
    return Scene(
        readings, positions, device.size, touch.rate, f"touch {index}{heading}", body=_round(device.surface)
    )


def _round(body: AbstractBody | None) -> AbstractBody | None:
    """Return a body whose pictures need to know where it is in space."""
    return None if body is None or body.flat else body


def _title(name: str, holds: np.ndarray, names: Sequence[str]) -> str:
    """Return what presses and which labels hold."""
    text = ", ".join(label for label, on in zip(names, holds, strict=True) if on) or "no label holds"
    return f"{name}: {text}"

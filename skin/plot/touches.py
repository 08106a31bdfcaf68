"""The touches that animations show: drawn on request, or taken from a device."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.errors import InputError
from skin.labels import TOUCH
from skin.plot.surface import surface_motion
from skin.plot.view import Scene
from skin.recording import Touches


@torch.no_grad()
def simulated(
    device: AbstractSimulated, labels: Sequence[str], shape: str | None, seed: int, field: bool
) -> Scene:
    """Draw a touch as a simulated device feels it.

    Args:
        device: whose skin, sensors and imperfections are shown.
        labels: those of ``skin.labels.TOUCH`` that hold; the others do not.
        shape: what presses, a name in ``data/shapes`` or the path of a picture; None: any of the device's.
        seed: of the touch.
        field: solve for the movement of the whole surface too (``skin.plot.surface.surface_motion``).

    Raises:
        InputError: an unknown label, or a shape of which no such touch can be made.
    """
    if unknown := sorted(set(labels) - set(TOUCH.names)):
        raise InputError(f"no label {', '.join(unknown)}: labels may list {', '.join(TOUCH.names)}")
    if shape is not None:
        device = device.replace(touch=replace(device.sampler.settings, shapes=(shape,)))
    generator = np.random.default_rng(seed)
    wanted = np.array([[name in labels for name in TOUCH.names]])
    movie = device.sampler.sample(1, generator, wanted)
    true = device.model.respond(movie, displacement=False).readings
    readings, *_ = device.imperfection.apply(true, device.constants, generator)
    pressure = movie.pressure()[0]
    moved = None
    found = surface_motion(device.model, device.body, movie.frames) if field else None
    if found is not None:
        moved = found[movie.index[0]] * movie.scale[0, :, None, None].numpy()
    name = device.sampler.shapes.names[int(movie.parameters["shape"][0])]
    positions = np.broadcast_to(device.sensors.positions, (len(pressure), *device.sensors.positions.shape))
    return Scene(
        readings[0].numpy(), positions, device.size, device.model_rate, _title(name, wanted[0], TOUCH.names),
        pressure.numpy(), moved, _round(device.body),
    )  # fmt: skip


def recorded(device: AbstractDevice, index: int) -> Scene:
    """Return one touch of a device: of a whole recording, or of another device's test touches.

    Raises:
        InputError: there is no touch of that number.
    """
    touches = device.all_touches()
    if not 0 <= index < len(touches):
        raise InputError(
            f"there are {len(touches)} touches, got index={index}: give index=0 to {len(touches) - 1}"
        )
    one: Touches = touches[index : index + 1]
    readings = one.readings.where(one.valid, 0)[0].numpy()
    positions = np.broadcast_to(one.positions.numpy(), (1, *readings.shape, 3))[0]
    said = "" if one.labels is None else _title("", one.labels[0].bool().numpy(), device.task.names)
    return Scene(
        readings, positions, device.size, one.rate, f"touch {index}{said}", body=_round(device.surface)
    )


def _round(body: AbstractBody | None) -> AbstractBody | None:
    """Return a body whose pictures need to know where it is in space."""
    return None if body is None or body.flat else body


def _title(name: str, holds: np.ndarray, names: Sequence[str]) -> str:
    """Return what presses and which labels hold."""
    said = ", ".join(label for label, on in zip(names, holds, strict=True) if on) or "no label holds"
    return f"{name}: {said}"

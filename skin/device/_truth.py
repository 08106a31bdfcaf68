"""The true sensors and true readings of a simulated device, before imperfections."""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import torch

from skin.errors import InputError
from skin.labels import TOUCH
from skin.recording import Recording, Touches
from skin.rng import Stream, generator
from skin.sensors import Sensors
from skin.simulator._relaxation import Relaxing, relaxes
from skin.simulator.base import AbstractSimulator
from skin.touch.sampler import Movie

if TYPE_CHECKING:
    from skin.device.simulated import Simulated

__all__ = ["true_model", "true_readings", "true_sensors"]


def true_sensors(device: "Simulated") -> Sensors:
    """Return the sensors where they are, which is not quite where touches say."""
    moves = generator(Stream.POSITION, device.seed).standard_normal((len(device.sensors), 2))
    positions = device.sensors.positions.copy()
    positions[:, :2] = np.clip(positions[:, :2] + device.position_error * moves, 0, device.size)
    return replace(device.sensors, positions=positions)


def true_model(device: "Simulated", sensors: Sensors) -> AbstractSimulator:
    """Return the device's simulator of its body with sensors, in time where a material relaxes.

    Raises:
        InputError: materials that relax in streams, or with sensors that are tracked.
    """
    if not relaxes(device.body):
        return device.simulator(device.body, sensors)
    if device.stream or device.track != "none":
        what = "data.stream=true" if device.stream else f"device.track={device.track}"
        raise InputError(
            f"a skin that relaxes is simulated touch by touch from rest, where it stays, got {what}: leave "
            "that out, or the materials' relaxation"
        )
    return Relaxing(device.simulator, device.body, sensors, device.rate)


def true_readings(device: "Simulated", movie: Movie, complete: bool) -> Recording:
    """Return gestures as perfect sensors read them.

    Args:
        device: its body, sensors, simulator and labels.
        movie: of the gestures.
        complete: with the displacements and, where mechanics tell it, each gesture's largest ``strain``.
    """
    readings, displacement = device.model.respond(movie, displacement=complete)
    positions = torch.from_numpy(device.sensors.positions).float()
    valid = torch.ones_like(readings, dtype=torch.bool)
    labels = torch.cat([movie.labels, movie.slides], dim=1) if device.direction else movie.labels
    motion = device.tracker.known(movie)
    touches = Touches(readings, valid, positions, labels, float(device.rate), motion)
    # A stream's windows have labels of their own.
    task = TOUCH if device.stream else device.task
    about = task, device.size, device.sensors.footprint
    strain = device.model.strain(movie.frames, movie.drag) if complete else None
    known = {} if strain is None else {"strain": (strain[movie.index] * movie.scale).amax(1)}
    return Recording(touches, *about, movie.force, displacement, movie.parameters | known)

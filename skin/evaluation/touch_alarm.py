"""The alarm of a touch: the highest score of the decisions that the live view makes while it lasts."""

from dataclasses import dataclass
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from skin.device.base import AbstractSimulated
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.signal.decisions import DECISIONS, RELEASE, as_press, held_frames
from skin.signal.device_sampling import between_frames, draw_constants
from skin.touch.sampler import balanced

if TYPE_CHECKING:
    from skin.evaluation.report import Predictor

_BATCH = 64  # touches
_WINDOWS = 512  # windows that are classified at once
_AFTER = 1.0  # s simulated behind the window of a touch


@dataclass(frozen=True)
class Watching:
    """How a live view watches a skin.

    Attributes:
        rate: of the device, Hz, rounded to a multiple of the model's.
        contact: N above the baseline that count as contact.
        longest: s, longest touch of the training.
        patience: consecutive decisions that raise the alarm together.
    """

    rate: float
    contact: float
    longest: float
    patience: int = 1
    tail: float = RELEASE


@torch.inference_mode()
def touch_scores(
    learner: "Predictor", device: AbstractSimulated, watching: Watching, count: int, seed: int
) -> tuple[Tensor, Tensor]:
    """Return the highest probability of ``dangerous`` among the decisions of each touch.

    Args:
        learner: trained.
        device: simulates and measures the touches; with ``randomise``, each with another device.
        watching: how they are watched.
        count: B, number of touches, balanced over the labels.
        seed: of the touches.

    Returns:
        scores (B,), 0 for a touch without contact, and labels (B, L).
    """
    scores, labels = list[Tensor](), list[Tensor]()
    wanted = balanced(count, generator(Stream.ALARM, seed, 1))
    for number, first in enumerate(range(0, count, _BATCH)):
        batch = wanted[first : first + _BATCH]
        draw = generator(Stream.ALARM, seed, 2, number)
        movie = device.replace(padded=False).sampler.sample(len(batch), draw, batch)
        force = device.model.respond(movie, displacement=False).readings
        windows, touch = decision_windows(device, force, watching, draw)
        chances = _chances(learner, device, windows)
        best = torch.zeros(len(batch)).scatter_reduce(0, touch, chances, "amax")
        scores.append(best)
        labels.append(movie.labels)
    return torch.cat(scores), torch.cat(labels)


def decision_windows(
    device: AbstractSimulated, force: Tensor, watching: Watching, draw: np.random.Generator
) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Return the windows on which the live view decides while touches last.

    Args:
        device: measures the touches.
        force: (B, T, S), true readings, N, at the model's rate; the touch begins with the first frame.
        watching: how they are watched.
        draw: source of the device, its noise, and when it reads.

    Returns:
        readings (W, T, S), N, and valid (W, T, S); the touch (W,) of each, as an index.
    """
    batch, window, sensors = force.shape
    ratio = max(1, round(watching.rate / device.model_rate))
    rate, after = ratio * device.model_rate, ceil(_AFTER * device.model_rate)
    imperfection = device.imperfection
    padded = pad(force, (0, 0, window, after))
    phase = draw.random(batch)
    fine = between_frames(padded, device.model_rate, rate, phase)
    gestures = batch if getattr(device, "randomise", False) else None
    from dataclasses import replace

    imperfection = replace(imperfection, rate=rate)
    constants = draw_constants(imperfection, sensors, device.model_rate, draw, gestures)
    readings, valid, _ = imperfection.apply(fine, constants, draw)
    valid = valid[:, 0]
    highest = max_pool1d(
        readings.transpose(1, 2), ratio, 1
    )  # [..., f]: of the interval that ends at f + ratio
    # Decisions at the first frame after each tick of a grid that has any phase relative to the touch.
    step = max(1.0, rate / DECISIONS)
    ends = [
        np.arange(window * ratio + step * draw.random(), fine.shape[1] - 1, step).astype(int)
        for _ in range(batch)
    ]
    fewest = min(map(len, ends))
    end = torch.from_numpy(np.stack([row[:fewest] for row in ends]))  # (B, J)
    back = ratio * torch.arange(window - 1, -1, -1)
    place = end[:, :, None] - back - (ratio - 1)  # (B, J, T)
    row = torch.arange(batch)[:, None, None]
    windows = highest.transpose(1, 2)[row, place]  # (B, J, T, S)
    recent = max(1, ceil(watching.tail * device.model_rate - 1e-9))
    risen = (windows >= watching.contact) & valid[:, None, None]
    contact = risen[:, :, -recent:].any(dim=3).any(dim=2)  # (B, J)
    c3 = risen[:, :, -3:].any(dim=3).any(dim=2)
    held = held_frames(watching.longest, device.model_rate, window)
    begun = torch.where(contact, end, 10**9).amin(dim=1, keepdim=True)
    lasted = (end - begun) / rate + 1 / device.model_rate
    long = c3 & (lasted * device.model_rate > held + 4)
    touch, decision = contact.nonzero(as_tuple=True)
    chosen = windows[touch, decision].clone()
    late = long[touch, decision].nonzero().flatten().tolist()
    idle = windows[:, 0]
    for number in late:
        chosen[number] = torch.from_numpy(as_press(idle[touch[number]].numpy(), chosen[number].numpy(), held))
    mask = valid[touch][:, None].expand(chosen.shape)
    return (chosen * mask, mask), touch


def _chances(learner: "Predictor", device: AbstractSimulated, windows: tuple[Tensor, Tensor]) -> Tensor:
    positions = torch.from_numpy(device.sensors.positions).float()
    column = device.task.names.index("dangerous")
    parts = [
        learner.probabilities(Touches(readings, valid, positions, None, device.model_rate))[:, column]
        for readings, valid in zip(*(part.split(_WINDOWS) for part in windows), strict=True)
    ]
    return torch.cat(parts) if parts else torch.zeros(0)

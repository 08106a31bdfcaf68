"""The alarm of a touch, as the live view raises it: highest score of the decisions while the touch lasts."""

from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from skin.device.base import AbstractSimulated
from skin.evaluation.operating_point import LABEL, OperatingPoint, lowest_threshold
from skin.labels import TOUCH
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.signal.decisions import DECISIONS, RELEASE, as_press, held_frames, longest_shown
from skin.signal.device_sampling import between_frames, draw_constants
from skin.touch.movie import Movie
from skin.touch.sampler import balanced

if TYPE_CHECKING:
    from skin.evaluation.report import Predictor

SAFE = 2000
"""Safe touches on which a threshold is chosen: where 2 % are wanted, the rate is then 1.4 to 2.7 % (95 %)."""
_BATCH = 50  # touches
_WINDOWS = 500  # windows that are classified at once
_AFTER = 1.0  # s that are simulated behind the window of a touch


@dataclass(frozen=True)
class Watching:
    """How a live view watches a skin.

    Attributes:
        rate: of the device, Hz.
        contact: N above the baseline that count as contact.
        longest: s, longest touch of the training.
        patience: s for which decisions must be dangerous before the alarm is raised.
        column: of ``dangerous`` among the labels of the learner.
        aligned: a device at the model's rate gives the frames of the model, as the simulator does; otherwise
            it reads at any phase of their intervals.
    """

    rate: float
    contact: float
    longest: float
    patience: float
    column: int
    aligned: bool = False

    def decisions(self, rate: float) -> int:
        """Return how many decisions in a row raise the alarm, for a device of ``rate``, Hz."""
        return max(1, ceil(self.patience * min(DECISIONS, rate) - 1e-6))


@torch.inference_mode()
def choose_for_touches(
    learner: "Predictor",
    device: AbstractSimulated,
    watching: Watching,
    target: float,
    count: int = SAFE,
) -> OperatingPoint:
    """Return the threshold at which a share of safe touches raises the alarm of the live view.

    Args:
        learner: trained.
        device: simulates and measures the touches; with ``randomise``, each with another device.
        watching: how they are watched.
        target: largest share of safe touches that raise the alarm.
        count: number of safe touches.
    """
    wanted = balanced(2 * count, generator(Stream.ALARM, device.data_seed, 1))
    safe = wanted[~wanted[:, TOUCH.names.index(LABEL)]][:count]
    scores = touch_scores(learner, device, watching, safe, device.data_seed)
    point = OperatingPoint(lowest_threshold(scores, target), target, len(scores), 0, device.data_seed)
    return replace(point, raised=int(point.alarm(scores).sum()))


@torch.inference_mode()
def touch_scores(
    learner: "Predictor",
    device: AbstractSimulated,
    watching: Watching,
    wanted: np.ndarray,
    seed: int,
) -> Tensor:
    """Return the score of each touch: it raises the alarm at thresholds below.

    Args:
        learner, device, watching: as in :func:`choose_for_touches`.
        wanted: (B, 4), bool, labels of the touches.
        seed: of the touches and their devices.

    Returns:
        (B,), the largest over the decisions of the smallest probability of ``dangerous`` among as many
        decisions in a row as the patience needs; 0 without contact.
    """
    device = device.replace(padded=False, stream=False)
    scores = list[Tensor]()
    for first in range(0, len(wanted), _BATCH):
        batch, draw = wanted[first : first + _BATCH], generator(Stream.ALARM, seed, 2, first)
        movie = device.sampler.sample(len(batch), draw, batch)
        readings, valid, contact = _decision_windows(device, movie, watching, draw)
        chances = torch.zeros(contact.shape)
        chances[contact] = _chances(
            learner, device, watching, readings[contact], valid[contact.nonzero()[:, 0]]
        )
        row = watching.decisions(_rate(device, watching))
        least = -max_pool1d(-pad(chances, (row - 1, 0)), row, 1) if row > 1 else chances
        scores.append(least.amax(dim=1))
    return torch.cat(scores)


def _rate(device: AbstractSimulated, watching: Watching) -> float:
    """Return the rate of the device, rounded to a multiple of the model's, Hz."""
    return max(1, round(watching.rate / device.model_rate)) * device.model_rate


def _decision_windows(
    device: AbstractSimulated, movie: Movie, watching: Watching, draw: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the windows (B, J, T, S), N, of J decisions about each touch, as the model sees them.

    Returns:
        windows; valid (B, S); contact (B, J), whether something touches the skin at each decision.
    """
    readings, valid = _measured(device, movie, watching, draw)
    rate, window = _rate(device, watching), device.window
    ratio = round(rate / device.model_rate)
    # Each place holds the maximum over the interval of the model that begins there.
    highest = max_pool1d(readings.transpose(1, 2), ratio, 1).transpose(1, 2)
    end = _decided(readings.shape, ratio * window, max(1.0, rate / DECISIONS), draw)
    place = end[:, :, None] - ratio * torch.arange(window, 0, -1) + 1
    windows = highest[torch.arange(len(end))[:, None, None], place]
    risen = (windows >= watching.contact) & valid[:, None, None]
    recent = max(1, ceil(RELEASE * device.model_rate - 1e-9))
    contact = risen[:, :, -recent:].flatten(2).any(dim=2)
    held = held_frames(watching.longest, device.model_rate, window)
    begun = torch.where(contact, end, torch.iinfo(end.dtype).max).amin(dim=1, keepdim=True)
    lasted = (end - begun) / ratio + 1
    for touch, decision in (contact & (lasted > longest_shown(held, recent, window))).nonzero().tolist():
        shown = as_press(windows[touch, 0].numpy(), windows[touch, decision].numpy(), held)
        windows[touch, decision] = torch.from_numpy(shown)
    return windows * valid[:, None, None], valid, contact


def _measured(
    device: AbstractSimulated, movie: Movie, watching: Watching, draw: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return what devices read of touches after a window of rest, (B, F, S), N, and their valid sensors."""
    force = device.model.respond(movie, displacement=False).readings
    before, after = device.window, ceil(_AFTER * device.model_rate)
    padded, rate = pad(force, (0, 0, before, after)), _rate(device, watching)
    if rate > device.model_rate or not watching.aligned:
        padded = between_frames(padded, device.model_rate, rate, draw.random(len(padded)))
    imperfection = replace(device.imperfection, rate=rate)
    gestures = len(padded) if getattr(device, "randomise", False) else None
    constants = draw_constants(imperfection, padded.shape[2], device.model_rate, draw, gestures)
    # A drift is 0 where the touch begins, as in other gestures: the live view follows it without contact.
    time = torch.arange(padded.shape[1]) / rate - before / device.model_rate
    readings, valid, _ = imperfection.apply(padded, constants, draw, time)
    return readings, valid[:, 0]


def _decided(shape: torch.Size, first: int, step: float, draw: np.random.Generator) -> Tensor:
    """Return the frames at which it is decided about each touch, (B, J): the ticks have any phase to it."""
    begin = first - 1 + step * draw.random(shape[0])
    count = int((shape[1] - first - step) / step)
    ends = np.floor(begin[:, None] + step * np.arange(count)).astype(np.int64)
    return torch.from_numpy(ends)


def _chances(
    learner: "Predictor", device: AbstractSimulated, watching: Watching, readings: Tensor, valid: Tensor
) -> Tensor:
    """Return the probability of ``dangerous`` of windows (W, T, S) with valid sensors (W, S), (W,)."""
    positions = torch.from_numpy(device.sensors.positions).float()
    mask = valid[:, None].expand_as(readings)
    parts = [
        learner.probabilities(Touches(*part, positions, None, device.model_rate))[:, watching.column]
        for part in zip(readings.split(_WINDOWS), mask.split(_WINDOWS), strict=True)
    ]
    return torch.cat(parts).nan_to_num(1.0) if parts else torch.zeros(0)

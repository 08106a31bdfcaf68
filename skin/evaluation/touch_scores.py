"""Decisions about touches as the live view makes them, and the score of each touch: the highest of them."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import ceil
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import max_pool1d, pad

from skin.body.base import AbstractBody
from skin.core.rng import Stream, generator
from skin.device.sampling import between_frames, draw_constants
from skin.device.simulated import Simulated
from skin.device.touches import Touches
from skin.evaluation.decisions import DECISIONS, LiveConditions, held_frames, longest_shown, present_as_press
from skin.evaluation.operating_point import LABEL, DangerScore, Predictor
from skin.mechanics import geometry
from skin.touch.labels import RELEASE
from skin.touch.movie import Movie

_ABOUT_PEAK = -1, 4
"""Decisions from the one before the first peak: 74 to 81 % of the scores are then equal, of ``any_skin``."""


class TouchDecisions(NamedTuple):
    """The J decisions about each of B touches.

    Attributes:
        row: decisions in a row that the patience needs.
        probability: of ``dangerous``, of the model, (B, J).
        reading: largest of the window, N, (B, J).
        contact: whether something touches the skin, (B, J), bool.
        peak: what decides the label ``dangerous``, in multiples of its threshold, (B,).
        sensed: the same at the valid sensor under the largest mean pressure over its footprint, (B,).
    """

    row: int
    probability: Tensor
    reading: Tensor
    contact: Tensor
    peak: Tensor
    sensed: Tensor

    def highest(self, values: Tensor) -> Tensor:
        """Return the largest over the decisions of the smallest value (B, J) among ``row`` ones, (B,).

        Decisions without contact count as 0.
        """
        values = values * self.contact
        minimum = -max_pool1d(-pad(values, (self.row - 1, 0)), self.row, 1) if self.row > 1 else values
        return minimum.amax(dim=1)

    def fit(self, rows: np.ndarray, dangerous: np.ndarray) -> DangerScore:
        """Return the combination of probability and reading, fitted to n touches.

        Args:
            rows: (n,), their numbers.
            dangerous: (n,), bool.
        """
        values = (self.probability, self.reading)
        probability, reading = (self.highest(value).double().numpy()[rows] for value in values)
        return DangerScore.fit(probability, reading, dangerous)

    def scores(self, score: DangerScore | None) -> Tensor:
        """Return the score of each touch, (B,): it raises the alarm above thresholds below; 0 if none."""
        if score is None:
            return self.highest(self.probability)
        combined = score.probability(self.probability.double().numpy(), self.reading.double().numpy())
        return self.highest(torch.from_numpy(combined))


@torch.inference_mode()
def decide_touches(
    learner: Predictor,
    device: Simulated,
    live: LiveConditions,
    labels: np.ndarray,
    seed: int,
    report: Callable[[int], None] | None = None,
    enough: tuple[DangerScore | None, float] | None = None,
) -> TouchDecisions:
    """Return the decisions of the live view about touches.

    Args:
        learner: trained.
        device: simulates and measures the touches; with ``randomise``, each with another device.
        live: conditions of the live view.
        labels: (B, 4), bool, of the touches.
        seed: of the touches and their devices.
        report: called with the number of touches that are done.
        enough: a score, and the level above which it need not be known: of a touch that the decisions about
            its first peak, a third of all, bring above it, the others are left out. No score is then higher
            than that of all decisions.
    """
    # The live view tares. Untared, offsets hold the contact until little of a touch is left in the window.
    device = device.replace(padded=False, stream=False, tare=True)
    parts = list[tuple[Tensor, ...]]()
    weigh = geometry.footprints if device.model.smooth else AbstractBody.footprints
    footprints = torch.from_numpy(weigh(device.body, device.sensors)).float()
    danger, row = device.sampler.labels[LABEL], live.decisions(_round_rate(device, live))
    for first in range(0, len(labels), 50):
        batch, draw = labels[first : first + 50], generator(Stream.ALARM, seed, 2, first)
        movie = device.sampler.sample(len(batch), draw, batch)
        readings, valid, contact = _decision_windows(device, movie, live, draw)
        classify = partial(_classify, learner, device, live, readings, valid)
        judged, largest, probabilities = contact, readings.amax(dim=(2, 3)), torch.zeros(contact.shape)
        if enough is not None:
            after = torch.arange(contact.shape[1]) - (largest * contact).argmax(dim=1, keepdim=True)
            judged = contact & (after >= _ABOUT_PEAK[0]) & (after <= _ABOUT_PEAK[1])
        probabilities[judged] = classify(judged)
        peak = danger.measure(movie, device.body) / danger.above
        means = (movie.frames.flatten(1) @ footprints.T)[movie.index] * movie.scale[:, :, None]
        felt = means.amax(dim=1).where(valid, 0.0).amax(dim=1)  # Pa, the largest over a valid sensor
        sensed = peak * felt / movie.parameters["pressure"].clamp(1.0)
        found = TouchDecisions(row, probabilities, largest, judged, peak, sensed)
        if enough is not None:
            others = contact & ~judged & (found.scores(enough[0]) <= enough[1])[:, None]
            probabilities[others] = classify(others)
            found = found._replace(contact=judged | others)
        parts.append(found[1:])
        if report is not None:
            report(first + len(batch))
    joined = [torch.cat(part) for part in zip(*parts, strict=True)]
    return TouchDecisions(row, *joined)


def _round_rate(device: Simulated, live: LiveConditions) -> float:
    """Return the rate of the device, rounded to a multiple of the model's, Hz."""
    return max(1, round(live.rate / device.model_rate)) * device.model_rate


def _decision_windows(
    device: Simulated, movie: Movie, live: LiveConditions, draw: np.random.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the windows (B, J, T, S), N, of J decisions about each touch, as the model sees them.

    Returns:
        windows; valid (B, S); contact (B, J), whether something touches the skin at each decision.
    """
    readings, valid = _measure_touches(device, movie, live, draw)
    rate, window = _round_rate(device, live), device.window
    ratio = round(rate / device.model_rate)
    # Each frame holds the maximum over the interval of the model that begins there.
    highest = max_pool1d(readings.transpose(1, 2), ratio, 1).transpose(1, 2)
    end = _draw_decisions(readings.shape, ratio * window, max(1.0, rate / DECISIONS), draw)
    frames = end[:, :, None] - ratio * torch.arange(window, 0, -1) + 1
    windows = highest[torch.arange(len(end))[:, None, None], frames]
    risen = (windows >= live.contact) & valid[:, None, None]
    recent = max(1, ceil(RELEASE * device.model_rate - 1e-9))
    contact = risen[:, :, -recent:].flatten(2).any(dim=2)
    held = held_frames(live.longest, device.model_rate, window)
    begun = torch.where(contact, end, torch.iinfo(end.dtype).max).amin(dim=1, keepdim=True)
    lasted = (end - begun) / ratio + 1
    for touch, decision in (contact & (lasted > longest_shown(held, recent, window))).nonzero().tolist():
        press = present_as_press(windows[touch, 0].numpy(), windows[touch, decision].numpy(), held)
        windows[touch, decision] = torch.from_numpy(press)
    return windows * valid[:, None, None], valid, contact


def _measure_touches(
    device: Simulated, movie: Movie, live: LiveConditions, draw: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return what devices read of touches after a window of rest, (B, F, S), N, and their valid sensors."""
    force = device.model.respond(movie).readings
    before, after = device.window, ceil(1.0 * device.model_rate)  # a second behind the window of a touch
    padded, rate = pad(force, (0, 0, before, after)), _round_rate(device, live)
    if rate > device.model_rate or not live.aligned:
        padded = between_frames(padded, device.model_rate, rate, draw.random(len(padded)))
    imperfection = replace(device.imperfection, rate=rate)
    gestures = len(padded) if getattr(device, "randomise", False) else None
    constants = draw_constants(imperfection, padded.shape[2], device.model_rate, draw, gestures)
    # A drift is 0 where the touch begins, as in other gestures: the live view follows it without contact.
    time = torch.arange(padded.shape[1]) / rate - before / device.model_rate
    readings, valid, _ = imperfection.apply(padded, constants, draw, time)
    return readings, valid[:, 0]


def _draw_decisions(shape: torch.Size, first: int, step: float, draw: np.random.Generator) -> Tensor:
    """Return the frames at which it is decided about each touch, (B, J): the ticks have any phase to it."""
    begin = first - 1 + step * draw.random(shape[0])
    count = int((shape[1] - first - step) / step)
    return torch.from_numpy(np.floor(begin[:, None] + step * np.arange(count)).astype(np.int64))


def _classify(
    learner: Predictor, device: Simulated, live: LiveConditions, windows: Tensor, valid: Tensor, which: Tensor
) -> Tensor:
    """Return the probability of ``dangerous``, (W,), of windows (B, J, T, S) where ``which`` (B, J) holds."""
    positions = torch.from_numpy(device.sensors.positions).float()
    readings, valid = windows[which], valid[which.nonzero()[:, 0], None].expand(-1, windows.shape[2], -1)
    parts = [
        learner.probabilities(Touches(*part, positions, None, device.model_rate))[:, live.column]
        for part in zip(readings.split(500), valid.split(500), strict=True)
        if len(readings)
    ]
    return torch.cat(parts).nan_to_num(1.0) if parts else torch.zeros(0)

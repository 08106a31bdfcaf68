"""Large contacts, such as hands and bars: the alternative to fingertips."""

import math
from dataclasses import replace

import numpy as np

from skin.inference.candidates import CandidateReadings, FingertipPrior
from skin.inference.likelihood import Observation, fit_force
from skin.inference.noise import Noise
from skin.touch.images import load_image

SHAPES = ("bar", "hand", "fist", "square", "disc")
"""Pictures in ``data/shapes`` that large contacts have."""

_COUNT = 3000  # contacts that stand for all
_HELD_OUT = 150  # contacts that the tolerances are chosen on
_SPACING = 0.004  # m, between the points of a contact
_SHARE = 0.7  # of the surface, the largest area
_PRESSURE, _SPREAD = 60e3, 1.0  # Pa, median of the highest pressure, and the deviation of its logarithm
_TOLERANCES = [(own, common) for own in (0.05, 0.1, 0.2, 0.4) for common in (0.0, 0.02, 0.05, 0.1)]


class LargeContacts:
    """Evidence of a contact larger than a fingertip: the mean likelihood of many such contacts.

    A drawn contact represents similar ones, with readings within a tolerance: a fraction of each reading, and
    a fraction of the root mean square of all. The tolerances maximise the evidence of held-out contacts.

    Args:
        candidates: whose fingertips add up to larger contacts.
        noise: of the readings.
    """

    def __init__(self, candidates: CandidateReadings, noise: Noise) -> None:
        rng = np.random.default_rng(0)
        # In units of the median force of each contact.
        self.prior = FingertipPrior(force=1.0, spread=_SPREAD)
        every = draw_large(candidates, _COUNT + _HELD_OUT, rng)
        self._readings, held_out = every[:_COUNT], every[_COUNT:]
        force = np.exp(_SPREAD * rng.standard_normal((len(held_out), 1)))
        values = force * held_out + math.sqrt(noise.floor) * rng.standard_normal(held_out.shape)
        working = np.ones(values.shape[1], bool)
        clean = replace(noise, clip=math.inf)
        frames = [Observation.of(row, working, ~working, clean) for row in values]
        square = self._readings**2
        common = square.mean(1, keepdims=True)

        def spread(tolerance: tuple[float, float]) -> np.ndarray:
            return (tolerance[0] ** 2 + noise.gain**2) * square + tolerance[1] ** 2 * common

        def score(tolerance: tuple[float, float]) -> float:
            self._spread = spread(tolerance)
            return sum(map(self.evidence, frames))

        self._spread = spread(max(_TOLERANCES, key=score))

    def evidence(self, frame: Observation) -> float:
        """Return the log of the mean likelihood of a frame."""
        _, evidence = fit_force(frame, self.prior, self._readings, self._spread)
        top = evidence.max()
        return float(top) + math.log(float(np.exp(evidence - top).mean()))


def draw_large(candidates: CandidateReadings, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return the readings (N, S), N, of large contacts under their median force, float32.

    Shape, position, angle and the logarithm of the area, from the largest fingertip up, are uniform. A
    contact consists of small fingertips with the pressures of its picture.
    """
    size, radii = candidates.size, candidates.radii
    steps = np.ceil(size / _SPACING).astype(int)
    x, y = ((np.arange(step) + 0.5) * side / step for step, side in zip(steps, size, strict=True))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), -1).reshape(-1, 2)
    small = candidates.at(np.column_stack([points, np.full(len(points), radii[0])]))[0]
    pictures = [load_image(name) for name in SHAPES]
    shape, angle = rng.integers(0, len(SHAPES), count), rng.uniform(0, 2 * np.pi, count)
    minimum, maximum = math.pi * radii[1] ** 2, _SHARE * size.prod()
    area = minimum * (maximum / minimum) ** rng.random(count)
    position = size * rng.random((count, 2))
    readings, cell = np.empty((count, small.shape[1]), np.float32), float(size.prod() / len(points))
    for number in range(count):
        pressure = _sample(pictures[shape[number]], area[number], angle[number], points - position[number])
        readings[number] = _PRESSURE * cell * (pressure @ small)
    return readings[(readings != 0).any(1)]


def _sample(picture: np.ndarray, area: float, angle: float, away: np.ndarray) -> np.ndarray:
    """Return the values of a picture of some area, m^2, at points (P, 2) from its middle, m."""
    touched = picture > 0
    pixel = math.sqrt(area / touched.sum())
    cos, sin = math.cos(angle) / pixel, math.sin(angle) / pixel
    column = np.floor(cos * away[:, 0] + sin * away[:, 1] + picture.shape[1] / 2).astype(int)
    row = np.floor(cos * away[:, 1] - sin * away[:, 0] + picture.shape[0] / 2).astype(int)
    height, width = picture.shape
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return np.where(inside, picture[row.clip(0, height - 1), column.clip(0, width - 1)], 0)

"""The labels of a dense pressure movie, in which each frame is another."""

import torch
from torch import Tensor

from skin.touch.labels import Thresholds, report_labels
from skin.touch.movie import Movie, measure_gestures


def movie_labels(
    pressure: Tensor,
    footprints: Tensor,
    cell: tuple[float, float],
    thresholds: Thresholds | None = None,
    rate: float = 10.0,
) -> Tensor:
    """Return the labels (B, 4) that a dense pressure movie gives.

    Args:
        pressure: (B, T, H, W), Pa.
        footprints: (S, H * W), area weights of each sensor that sum to 1.
        cell: extent (x, y) of a cell, m.
        thresholds: of the labels; None: those of the report.
        rate: frames per second, Hz.
    """
    thresholds = thresholds or Thresholds()
    batch, time = pressure.shape[:2]
    index = torch.arange(batch * time, device=pressure.device).view(batch, time)
    scale = torch.ones(batch, time).to(pressure)
    measures = measure_gestures(pressure.flatten(0, 1), index, scale, footprints, cell, thresholds.contact)
    movie = Movie(pressure, index, scale, torch.empty(0), measures._asdict())
    labels = report_labels(thresholds, rate).values()
    return torch.stack([label.measure(movie, None) > label.above for label in labels], dim=1).float()

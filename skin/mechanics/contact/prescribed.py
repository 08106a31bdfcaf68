"""Prescribed pressure, as in the report: the image of an object is its pressure."""

from typing import final

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.mechanics.simulator.base import AbstractSimulator
from skin.touch.movie import AbstractContact, ContactProblem, ContactResult
from skin.touch.paths import Trajectories


@final
class Prescribed(AbstractContact):
    """Takes the grey-scale image of an object as its pressure (report, equations 1 and 2).

    Use it for the gestures of the report, for simulators without mechanics, and for objects that are softer
    than the skin, whose pressure does not depend on the skin.

    Args:
        body, simulator: not used.
    """

    proportional = True

    def __init__(self, body: AbstractBody | None = None, simulator: AbstractSimulator | None = None) -> None:
        del body, simulator

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the images at the force at which the peak cell of the gesture has the wanted pressure."""
        shapes = problem.shapes
        width, height = shapes.body.cell
        if shapes.fine:
            frames, highest, area = shapes.press(*trajectories.poses)
            peak = _peak(highest, trajectories)
        else:
            frames, area = shapes.render(*trajectories.poses), None
            peak = _peak(frames.flatten(1).amax(1), trajectories)
        # The drawn multiple of the threshold of pressure is one of the limit that the gesture reaches first.
        human = problem.settings.danger.human_force
        limit, most = problem.settings.danger.of_contact(trajectories.wanted[:, 2])
        most = np.where(trajectories.wanted[:, 3], most, np.minimum(most, human))
        reached = np.minimum(limit, most * (peak / (width * height)))
        highest_cell = trajectories.peak * (reached / problem.settings.thresholds.pressure)
        force = highest_cell * (width * height) / peak
        frames *= torch.from_numpy((force / (width * height))[trajectories.owner]).float()[:, None, None]
        return ContactResult(
            frames, force, highest_cell, force > human, np.zeros(len(force), bool), area=area
        )


def _peak(highest: torch.Tensor, trajectories: Trajectories) -> np.ndarray:
    """Return the peak of each whole movie, (B,), from those of its frames, (U,): equation 2."""
    return (highest[trajectories.index] * trajectories.profile).amax(1).double().numpy()

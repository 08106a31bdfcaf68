"""Pressure as in the report: the picture of an object is its pressure."""

from typing import final

import numpy as np
import torch

from skin.body.base import AbstractBody
from skin.contact.base import AbstractContact
from skin.simulator.base import AbstractSimulator
from skin.touch.problem import ContactProblem, ContactResult, Trajectories


@final
class Prescribed(AbstractContact):
    """The object's grey-scale picture is its pressure, whatever the skin does (report, equations 1 and 2).

    Choose it for the report's gestures, for a simulator without mechanics, and for objects softer than the
    skin, which press alike everywhere.

    Args:
        body, simulator: not asked: the skin has no say.
    """

    proportional = True

    def __init__(self, body: AbstractBody | None = None, simulator: AbstractSimulator | None = None) -> None:
        del body, simulator

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return pictures at the force at which the gesture's highest cell has the wanted pressure."""
        frames = problem.shapes.render(*trajectories.poses)
        # Equation 2: the drawn peak is the largest cell of the whole movie.
        peak = (frames.flatten(1).amax(1)[trajectories.index] * trajectories.profile).amax(1).double().numpy()
        width, height = problem.shapes.body.cell
        force = trajectories.peak * (width * height) / peak
        owner = torch.from_numpy(trajectories.owner)
        frames *= torch.from_numpy(force / (width * height)).float()[owner, None, None]
        none = np.zeros(len(force), bool)
        return ContactResult(frames, force, trajectories.peak, none, none)

"""The data of a contact: objects on their paths, and the pressure that they make."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from skin.touch.gesture import GestureSettings
from skin.touch.shapes import Shapes


class ContactProblem(NamedTuple):
    """What is touched, and how touches of it are judged.

    Attributes:
        shapes: what presses, on which body.
        footprints: (S, H * W), area weights of each sensor that sum to 1, float32.
        settings: the difficulty; its thresholds say where labels change.
    """

    shapes: Shapes
    footprints: Tensor
    settings: GestureSettings


@dataclass(frozen=True)
class Trajectories:
    """Gestures (B,) as the distinct frames (U,) that they show, those of one gesture side by side.

    Attributes:
        owner: (U,), the gesture of each frame, ascending.
        shape, angle, scale: (U,), as ``Shapes.render`` takes them.
        place: (U, 2), m.
        share: (U,), the largest part of full force at which a frame is shown.
        index: (B, T), which frame is shown.
        profile: (B, T), at what part of full force; 0 where nothing touches.
        peak: (B,), the wanted highest cell pressure, Pa.
        wanted: (B, 4), bool, the wanted labels in the order of ``skin.labels.TOUCH``.
        stretch: (U,), as ``Shapes.render`` takes it.
    """

    owner: np.ndarray
    shape: np.ndarray
    angle: np.ndarray
    scale: np.ndarray
    place: np.ndarray
    share: np.ndarray
    index: Tensor
    profile: Tensor
    peak: np.ndarray
    wanted: np.ndarray
    stretch: np.ndarray | None = None

    @property
    def poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
        """What ``Shapes.render`` and ``Shapes.solids`` take."""
        return self.shape, self.angle, self.scale, self.place, self.stretch


class ContactResult(NamedTuple):
    """The pressure of trajectories.

    Attributes:
        frames: (U, H, W), Pa, float32, each divided by its share of full force: every one of a gesture sums
            to the same total force.
        force: (B,), full force, N.
        peak: (B,), the highest cell pressure of the gesture, Pa.
        refused: (B,), bool, gestures whose frames mean nothing, because no force gives the wanted labels or
            because the pressure was not found.
        hopeless: (B,), bool, those of them that no other path would save.
        unconverged: (B,), how many frames were not found to the stated tolerance; None where all are exact.
    """

    frames: Tensor
    force: np.ndarray
    peak: np.ndarray
    refused: np.ndarray
    hopeless: np.ndarray
    unconverged: np.ndarray | None = None


class ContactModel(Protocol):
    """What the sampler asks of a contact: see :class:`skin.contact.base.AbstractContact`."""

    @property
    def proportional(self) -> bool: ...

    @property
    def advice(self) -> str: ...

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures, with the force that gives the wanted labels if there is one."""

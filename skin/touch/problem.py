"""The data of a contact: objects on their paths, and the resulting pressure."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from torch import Tensor

from skin.touch.gesture import GestureSettings
from skin.touch.shapes import Shapes


class ContactProblem(NamedTuple):
    """The touched body and the criteria for labels.

    Attributes:
        shapes: the shapes and the body.
        footprints: (S, H * W), area weights of each sensor that sum to 1, float32.
        settings: ranges of the gestures, and the thresholds of the labels.
    """

    shapes: Shapes
    footprints: Tensor
    settings: GestureSettings


@dataclass(frozen=True)
class Trajectories:
    """Gestures (B,) as distinct frames (U,); the frames of one gesture are adjacent.

    Attributes:
        owner: (U,), the gesture of each frame, ascending.
        shape, angle, scale: (U,), as ``Shapes.render`` takes them.
        place: (U, 2), m.
        share: (U,), the largest share of full force at which a frame is shown.
        index: (B, T), the frame at each time.
        profile: (B, T), its share of full force; 0 without contact.
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
        """Arguments of ``Shapes.render`` and ``Shapes.solids``."""
        return self.shape, self.angle, self.scale, self.place, self.stretch


class ContactResult(NamedTuple):
    """The pressure of trajectories.

    Attributes:
        frames: (U, H, W), Pa, float32, each divided by its share of full force, so that all frames of a
            gesture have the same total force.
        force: (B,), full force, N.
        peak: (B,), peak cell pressure of the gesture, Pa.
        refused: (B,), bool, gestures whose frames are not valid, because no force gives the wanted labels or
            the contact did not converge.
        hopeless: (B,), bool, the refused gestures for which no other path can succeed.
        unconverged: (B,), number of frames that did not converge to the tolerance; None where all are exact.
    """

    frames: Tensor
    force: np.ndarray
    peak: np.ndarray
    refused: np.ndarray
    hopeless: np.ndarray
    unconverged: np.ndarray | None = None


class ContactModel(Protocol):
    """The interface of a contact for the sampler; see :class:`skin.contact.base.AbstractContact`."""

    @property
    def proportional(self) -> bool: ...

    @property
    def advice(self) -> str: ...

    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures at a force that gives the wanted labels, if there is one."""

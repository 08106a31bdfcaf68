"""The interface of a contact: from an object and a force to pressure."""

from abc import ABC, abstractmethod
from typing import ClassVar

from skin.touch.gesture import Trajectories
from skin.touch.sampler import ContactProblem, ContactResult


class AbstractContact(ABC):
    """Computes the pressure of objects on the cells of the skin.

    Attributes:
        proportional: whether pressure is proportional to force. A static touch is then one frame for any time
            profile, and the centre of pressure moves with the object.
        advice: end of the error message where the wanted labels do not occur.
    """

    proportional: ClassVar[bool]
    advice: ClassVar[str] = ""

    @abstractmethod
    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures at a force that gives the wanted labels, if there is one."""

"""The interface of a contact: from an object and a force to pressure."""

from abc import ABC, abstractmethod
from typing import ClassVar

from skin.touch.problem import ContactProblem, ContactResult, Trajectories


class AbstractContact(ABC):
    """Turns what touches the skin into pressure on its cells.

    Attributes:
        proportional: twice the force is twice the pressure, so that a touch that stands still is one frame,
            whatever its time profile, and that the centre of pressure moves as the object does.
        advice: what else might help where the wanted labels are never met, to end a sentence with.
    """

    proportional: ClassVar[bool]
    advice: ClassVar[str] = ""

    @abstractmethod
    def press(self, trajectories: Trajectories, problem: ContactProblem) -> ContactResult:
        """Return the pressure of gestures, with the force that gives the wanted labels if there is one."""

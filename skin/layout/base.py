"""The interface of a sensor layout."""

from abc import ABC, abstractmethod

from skin.body.base import AbstractBody
from skin.sensors import Sensors

__all__ = ["AbstractLayout"]


class AbstractLayout(ABC):
    """Places sensors in a body."""

    @abstractmethod
    def sensors(self, body: AbstractBody) -> Sensors:
        """Return the sensors of this layout in ``body``.

        Raises:
            InputError: a sensor lies outside the body, or two lie at one place.
        """

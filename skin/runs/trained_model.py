"""The interface of trained models: a finished run, or a file of ``skin export``. torch is not imported."""

from abc import ABC, abstractmethod
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from skin.errors import InputError
from skin.touch.labels import Task


class TrainedModel(ABC):
    """Predicts the labels of touches of one skin.

    Attributes:
        identity: id of the run.
        title: name of the run.
        task: the labels.
        window: T, frames.
        rate: Hz, of the frames.
        positions: of the sensors, (S, 3), m.
        size: extent (x, y) of the skin, m.
        threshold: a window is dangerous where its probability is greater; None: not chosen, or no alarm.
    """

    identity: str
    title: str
    task: Task
    window: int
    rate: float
    positions: np.ndarray
    size: tuple[float, float]
    threshold: float | None

    @property
    @abstractmethod
    def contact(self) -> float:
        """N above the baseline that count as touch.

        Raises:
            InputError: it is unknown.
        """

    @property
    @abstractmethod
    def learned(self) -> bool:
        """Whether the label ``touch`` counts as touch, too."""

    @property
    @abstractmethod
    def longest(self) -> float:
        """Longest touch of the training, s."""

    @property
    @abstractmethod
    def presses(self) -> np.ndarray | None:
        """Readings of a press at the limit of ``dangerous`` on each sensor, (S, S), N; None: unknown."""

    @abstractmethod
    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), float32.

        Args:
            readings: (B, T, S), float32, N.
            valid: (B, T, S), bool.
        """

    @abstractmethod
    def threshold_at(
        self, rate: float, patience: float, aligned: bool, say: Callable[[str], None]
    ) -> float | None:
        """Return the threshold of the alarm of the live view; None for a model without alarm.

        Args:
            rate: of the device, Hz.
            patience: s for which decisions must be dangerous.
            aligned: whether the device gives the frames of the model, as the simulator does.
            say: called with each message for the user.

        Raises:
            InputError: no threshold raises an alarm as seldom as wanted.
        """

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the columns of :meth:`predict`."""
        return tuple(self.task.names)

    @property
    def alarms(self) -> bool:
        """Whether the model predicts danger."""
        return "dangerous" in self.task.names

    def predict(self, readings: ArrayLike) -> np.ndarray:
        """Return the probability of each label, (B, L), float32, for windows of readings.

        Args:
            readings: (B, T, S), N above the readings without touch, in the order of :attr:`positions`, with
                T = :attr:`window` frames at :attr:`rate`; or one window (T, S). NaN is an invalid reading.

        Returns:
            An array whose shape is (L,) for one window.

        Raises:
            InputError: the readings are no numbers, are infinite, or have another shape.
        """
        windows = self._windows(readings)
        if not windows.size:
            return np.empty((*windows.shape[:-2], len(self.labels)), np.float32)
        batch = windows.reshape(-1, *windows.shape[-2:])
        return self.probabilities(np.nan_to_num(batch), ~np.isnan(batch)).reshape(*windows.shape[:-2], -1)

    def _windows(self, readings: ArrayLike) -> np.ndarray:
        """Return readings as (B, T, S) or (T, S), float32."""
        try:
            windows = np.array(readings, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise InputError(f"readings must be an array of numbers: {error}") from error
        frames, sensors = self.window, len(self.positions)
        if windows.ndim not in (2, 3) or windows.shape[-2:] != (frames, sensors):
            raise InputError(
                f"readings must be (B, {frames}, {sensors}) or ({frames}, {sensors}), windows of {frames} "
                f"frames at {self.rate:g} Hz of {sensors} sensors, got {windows.shape}"
            )
        if np.isinf(windows).any():
            raise InputError("readings must be finite: give NaN for an invalid reading")
        return windows

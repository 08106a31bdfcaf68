"""Touches from a file."""

from typing import Literal

import numpy as np

from skin.body.base import AbstractBody
from skin.device._blank import Blank
from skin.device._split import split_rows
from skin.device.base import AbstractDevice, Split
from skin.errors import InputError
from skin.layout.base import AbstractLayout
from skin.recording import Recording, Touches
from skin.recording_file import read_recording
from skin.wire.open import open_skin
from skin.wire.source import Source

_SAME_PLACE = 1e-6  # m: the file's positions are float32


class Recorded(AbstractDevice):
    """Yields the touches of a recording, split 80/10/10 by gesture; ``test`` is ``holdout``, the last part.

    Args:
        path: ``x.parquet`` or ``x.csv``.
        body: the sheet; it is compared with the file's.
        layout: positions of the sensors; they are compared with the file's.
        split_seed: seed of the split.
        test: ``holdout``, or ``all`` touches, for a run that was trained on others.

    Attributes:
        sensors: as ``layout`` gives them.
        rate: frames per second, Hz.
        window: frames per touch.

    Raises:
        InputError: no file given, unreadable, too few touches, or another sheet or other sensors than the
            configuration's.
    """

    def __init__(
        self,
        body: AbstractBody,
        layout: AbstractLayout,
        path: str | None = None,
        split_seed: int = 0,
        test: Literal["holdout", "all"] = "holdout",
    ) -> None:
        if path is None:
            raise InputError("device=recording needs a file: add device.path=x.parquet")
        self._recording = read_recording(path)
        if test not in ("holdout", "all"):
            raise InputError(f"device.test must be holdout or all, got {test}")
        self._test = test
        if len(self._recording) < 10 and test == "holdout":
            raise InputError(
                f"{path} has {len(self._recording)} touches: 80/10/10 needs at least 10, or a "
                "run that was trained on others and device.test=all"
            )
        self.path, self.split_seed = path, split_seed
        self.sensors = layout.sensors(body)
        self._compare(body)
        self.surface, self.task, self.size = body, self._recording.task, body.size
        touches = self._recording.touches
        self.rate, self.window = touches.rate, touches.readings.shape[1]

    def _compare(self, body: AbstractBody) -> None:
        stored, size = self._recording.touches.positions, self._recording.size
        if not np.allclose(size, body.size):
            raise InputError(
                f"{self.path} was recorded on a skin of {size[0]:g} x {size[1]:g} m, the body is "
                f"{body.size[0]:g} x {body.size[1]:g} m: add {body.resized(size)}"
            )
        if len(stored) != len(self.sensors):
            raise InputError(
                f"{self.path} has {len(stored)} sensors, the layout has {len(self.sensors)}: give the layout "
                "it was recorded with, as in layout=file layout.path=FILE.csv"
            )
        apart = np.abs(stored.numpy() - self.sensors.positions).max(axis=1)
        if apart.max() > _SAME_PLACE:
            number = int(apart.argmax())
            raise InputError(
                f"{self.path} has sensor {number} at {stored[number].tolist()} m, the layout at "
                f"{self.sensors.positions[number].tolist()} m: give the layout it was recorded with, as in "
                "layout=file layout.path=FILE.csv"
            )

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split, the same in every epoch."""
        return self.recording(split, epoch).touches

    def all_touches(self) -> Touches:
        """Return the touches of the whole file."""
        return self._recording.touches

    def blank(self) -> AbstractDevice:
        """Return a device that has labels, which the file may lack."""
        return Blank.of(self.task, self.size, self._recording.touches)

    def source(self) -> Source:
        """Open the file as a stream of frames, in real time."""
        return Source.of_newtons(self.path, open_skin(self.path, self.sensors), len(self.sensors))

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the recording of a split; None takes the whole file."""
        if split is None or (split == "test" and self._test == "all"):
            return self._recording
        part: Split = "holdout" if split == "test" else split
        return self._recording[split_rows(part, len(self._recording), self.split_seed)]

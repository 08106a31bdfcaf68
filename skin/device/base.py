"""The interface of a device: a source of touches."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Sequence
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.labels import Task
from skin.recording import Recording, Touches
from skin.sensors import Sensors

if TYPE_CHECKING:  # only their names are needed here
    from skin.signal.frame import Frame
    from skin.signal.imperfection import Constants, Imperfection
    from skin.simulator.base import AbstractSimulator
    from skin.touch.sampler import TouchSampler
    from skin.touch.stream import Strip
    from skin.wire.announcement import AnnouncementListener
    from skin.wire.conversion import UnitConversion
    from skin.wire.segmentation import AbstractSegmenter, RecordedGesture
    from skin.wire.skin import Skin
    from skin.wire.source import Source

Split = Literal["train", "validation", "holdout", "test"]


class AbstractDevice(ABC):
    """Yields touches; nothing downstream knows where they come from.

    A subclass needs ``task``, ``size`` and :meth:`touches`. Everything else has a default, which holds for a
    device that knows nothing but its touches.

    Attributes:
        task: what the labels mean.
        size: extent (x, y) of the sheet, m.
        surface: the body that is touched, for pictures; None: a flat sheet of ``size``.
    """

    task: Task
    size: tuple[float, float]
    surface: AbstractBody | None = None

    @property
    def simulation(self) -> "AbstractSimulated | None":
        """This device, if it simulates its touches; else None."""
        return None

    @property
    def wired(self) -> "AbstractWired | None":
        """This device, if it reads a skin at a port; else None."""
        return None

    @abstractmethod
    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split.

        ``train``, ``validation`` and ``holdout`` share the training budget 80/10/10 by gesture; ``test``
        comes from gestures that no training can draw, where the device has such. ``epoch`` matters to devices
        that draw fresh gestures.
        """

    def all_touches(self) -> Touches:
        """Return the touches that one can look at by their number: by default those of ``test``."""
        return self.touches("test")

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the touches of a split, or the whole budget, with all that is known about them.

        Raises:
            InputError: only readings and labels are known.
        """
        raise InputError(
            "only simulated or recorded touches can be written to a file: leave out device=, or add "
            "device=recording device.path=FILE.parquet"
        )

    def blank(self) -> "AbstractDevice":
        """Return a device with labelled touches of the same shape, to restore a run with.

        By default it is the device itself. One whose touches may lack labels returns another.
        """
        return self

    def source(self) -> "Source":
        """Open the stream of frames that ``skin live`` watches.

        Raises:
            InputError: it cannot be opened, or there is none.
        """
        raise InputError(
            "only a skin at a port, a recording or the simulator can be watched: give device=serial "
            "device.port=/dev/ttyACM0, device=recording device.path=FILE.parquet, or leave out device="
        )

    def simulated(self, purpose: str) -> "AbstractSimulated":
        """Return this device as a simulated one.

        Args:
            purpose: what needs it, as the beginning of a sentence.

        Raises:
            InputError: it is not simulated.
        """
        if self.simulation is None:
            raise InputError(f"{purpose}: leave out device=, or add device=simulated")
        return self.simulation


class AbstractSimulated(AbstractDevice):
    """Simulates its touches: everything about them is known, and it can draw others.

    Attributes:
        body: the sheet.
        simulator: ``simulator(body, sensors)`` gives the map from pressure to true readings.
        sensors: S sensors, where touches say they are.
        model: from pressure to the true readings of the true sensors.
        sampler: draws the gestures.
        window: frames per touch.
        rate: frames per second, Hz.
        stream: whether touches are windows of streams.
        seed: of the device's constants and noise.
        data_seed: of the gestures of the budget.
        calibration: file that ``imperfection`` was read from; or None.
        imperfection: of a device of this kind.
        constants: of this device.
        idle: what the untouched skin reads on average, (S,), N.
    """

    body: AbstractBody
    simulator: Callable[[AbstractBody, Sensors], "AbstractSimulator"]
    sensors: Sensors
    model: "AbstractSimulator"
    sampler: "TouchSampler"
    window: int
    rate: float
    stream: bool
    seed: int
    data_seed: int
    calibration: str | None
    imperfection: "Imperfection"
    constants: "Constants"

    @property
    def simulation(self) -> "AbstractSimulated":
        """This device."""
        return self

    @property
    @abstractmethod
    def idle(self) -> Tensor:
        """What the untouched skin reads on average, (S,), N; 0 for dead sensors."""

    @abstractmethod
    def replace(self, **changes: Any) -> "AbstractSimulated":
        """Return a device with other settings, such as ``seed=3`` for another device of the same kind."""

    @abstractmethod
    def fresh_touches(self, count: int) -> Touches:
        """Return touches that belong to no split."""

    @abstractmethod
    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the touches of a split, or the whole budget, with the applied force and the parameters.

        Args:
            split: None takes the whole budget.
            epoch: matters to ``train`` with fresh gestures.
            complete: with the displacements and the largest strains, too.
        """

    @abstractmethod
    def strip(self, frames: int, gap: Sequence[int] | None = None, number: int = 0) -> "Strip":
        """Return a test stream in one piece, to be cut as one likes; one device feels all of it.

        Args:
            frames: its length.
            gap: [least, most] idle frames between two touches; None: as ``touch.gap``.
            number: of the stream: another number, other gestures.
        """


class AbstractWired(AbstractDevice):
    """Reads a skin at a port, frame by frame.

    Attributes:
        sensors: S sensors, as many as values in a frame.
        window: frames per touch.
        rate: frames per second that touches are resampled to, Hz; None before it is known.
        labels: where labels come from.
        gestures: how many touches ``test`` has.
        calibration: file that tells what values mean; or None.
    """

    sensors: Sensors
    window: int
    rate: float | None
    labels: str
    gestures: int
    calibration: str | None

    @property
    def wired(self) -> "AbstractWired":
        """This device."""
        return self

    @abstractmethod
    def open(self, reconnect: bool = False) -> "tuple[Skin, AnnouncementListener]":
        """Open the port, and listen to its announcements; ``reconnect`` waits for an unplugged skin."""

    @abstractmethod
    def warm_up(self, skin: "Skin") -> "tuple[list[Frame], UnitConversion]":
        """Read the beginning: is the device fast enough, and what does it say untouched?

        Returns:
            all frames that came, and what values mean.

        Raises:
            InputError: no frames come, they come too slowly, or nobody knows what values mean.
        """

    @abstractmethod
    def segmenter(
        self,
        listener: "AnnouncementListener",
        conversion: "UnitConversion",
        first: "Sequence[Frame]",
        done: Collection[int] = (),
    ) -> "AbstractSegmenter":
        """Return what finds the gestures of a stream.

        Args:
            listener: hears announcements.
            conversion: of the values.
            first: frames that came before.
            done: numbers of gestures that are there already.
        """

    @abstractmethod
    def to_recording(self, gestures: "Sequence[RecordedGesture]", conversion: "UnitConversion") -> Recording:
        """Return gestures as a recording."""

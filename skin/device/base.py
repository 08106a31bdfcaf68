"""The interface of a device: a source of touches."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Literal

from torch import Tensor

from skin.body.base import AbstractBody
from skin.errors import InputError
from skin.labels import Task
from skin.recording import Part, Recording, Touches
from skin.sensors import Sensors

if TYPE_CHECKING:  # only their names are needed here
    from skin.signal.constants import Constants
    from skin.signal.imperfection import Imperfection
    from skin.simulator.base import AbstractSimulator
    from skin.touch.sampler import TouchSampler
    from skin.touch.stream import TouchStream

Split = Literal["train", "validation", "holdout", "test"]


class AbstractDevice(ABC):
    """Base class of devices: sources of touches.

    A subclass needs ``task``, ``size`` and :meth:`touches`. The defaults of everything else apply to a device
    that has only touches.

    Attributes:
        task: the labels and their kind.
        size: extent (x, y) of the sheet, m.
        surface: the touched body, for plots; None: a flat sheet of ``size``.
        name: of the source of :meth:`strips`, for the live view.
        real: whether touches are read from a real skin, which may ask a person for them.
    """

    task: Task
    size: tuple[float, float]
    surface: AbstractBody | None = None
    name: str = "simulator"
    real: bool = False

    @property
    def simulation(self) -> "AbstractSimulated | None":
        """This device, if it simulates its touches; else None."""
        return None

    @property
    def reference(self) -> "AbstractSimulated | None":
        """The simulated skin of the configuration, on which thresholds of ``skin live`` are tuned."""
        return self.simulation

    @abstractmethod
    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split.

        ``train``, ``validation`` and ``holdout`` share the training budget 80/10/10 by gesture; ``test``
        comes from gestures that are not used for training, if the device has such. ``epoch`` is used by
        devices that draw fresh gestures.
        """

    def all_touches(self) -> Touches:
        """Return the touches that can be selected by number for plots: by default those of ``test``."""
        return self.touches("test")

    def parts(self, split: Split | None = None) -> Sequence[Part] | None:
        """Return a split, or the whole budget, as parts that are made one at a time.

        None, the default: the touches fit into memory, and :meth:`touches` and :meth:`recording` return them.
        """
        return None

    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the touches of a split, or the whole budget, with applied force and parameters.

        Raises:
            InputError: the device has only readings and labels.
        """
        raise InputError(
            "only simulated or recorded touches can be written to a file: leave out device=, or add "
            "device=recording device.path=FILE.parquet"
        )

    def blank(self) -> "AbstractDevice":
        """Return a device with labelled touches of the same shapes, with which a run can be restored.

        By default it is the device itself. A device whose touches may lack labels returns another one.
        """
        return self

    def strips(self) -> Iterator[Touches]:
        """Yield touches, N, that can be played one after the other as a stream of frames.

        Raises:
            InputError: the device has none.
        """
        raise InputError(
            "only a skin at a port, a recording or the simulator can be watched: give device=serial "
            "device.port=/dev/ttyACM0, device=recording device.path=FILE.parquet, or leave out device="
        )

    def simulated(self, purpose: str) -> "AbstractSimulated":
        """Return this device as a simulated one.

        Args:
            purpose: the reason, the beginning of the error message.

        Raises:
            InputError: the device is not simulated.
        """
        if self.simulation is None:
            raise InputError(f"{purpose}: leave out device=, or add device=simulated")
        return self.simulation


class AbstractSimulated(AbstractDevice):
    """Base class of devices that simulate their touches, with all parameters, and can draw others.

    Attributes:
        body: the sheet.
        simulator: ``simulator(body, sensors)`` gives the map from pressure to true readings.
        sensors: S sensors, at the positions that touches report.
        model: maps pressure to the true readings of the sensors at their true positions.
        sampler: draws the gestures.
        window: frames per touch.
        model_rate: frames per second of touches, Hz.
        rate: frames per second of the sensors, Hz; touches are resampled to ``model_rate``.
        stream: whether touches are windows of streams.
        seed: for the device's constants and noise.
        data_seed: for the gestures of the training budget.
        calibration: file with the imperfections; or None.
        imperfection: distribution of the imperfections of such devices.
        constants: imperfections of this device.
        idle: mean readings of the untouched skin, (S,), N.
    """

    body: AbstractBody
    simulator: Callable[[AbstractBody, Sensors], "AbstractSimulator"]
    sensors: Sensors
    model: "AbstractSimulator"
    sampler: "TouchSampler"
    window: int
    model_rate: float
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
        """Mean readings of the untouched skin, (S,), N; 0 for dead sensors."""

    @abstractmethod
    def replace(self, **changes: Any) -> "AbstractSimulated":
        """Return a device with other settings, such as ``seed=3`` for another device of the same kind."""

    @abstractmethod
    def fresh_touches(self, count: int) -> Touches:
        """Return touches that belong to no split."""

    @abstractmethod
    def press_readings(self) -> Tensor:
        """Return the true readings (S, S), N, of a press at the limit of ``dangerous`` on each sensor.

        Row i is of a disc of even pressure around sensor i.
        """

    @abstractmethod
    def recording(self, split: Split | None = None, epoch: int = 0, complete: bool = True) -> Recording:
        """Return the touches of a split, or the whole budget, with the applied force and the parameters.

        Args:
            split: None takes the whole budget.
            epoch: used by ``train`` with fresh gestures.
            complete: include the displacements and the largest strains.
        """

    @abstractmethod
    def simulate_stream(
        self, frames: int, gap: Sequence[int] | None = None, number: int = 0
    ) -> "TouchStream":
        """Return a test stream in one piece, to be cut as one likes; one device feels all of it.

        Args:
            frames: its length, frames.
            gap: [least, most] idle frames between two touches; None: ``touch.gap``.
            number: of the stream; each number gives other gestures.
        """

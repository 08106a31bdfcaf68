"""Devices at a port, and any device as a stream of frames."""

from abc import abstractmethod
from collections.abc import Collection, Sequence
from itertools import chain

from skin.device.base import AbstractDevice
from skin.recording import Recording
from skin.sensors import Sensors
from skin.signal.frame import Frame
from skin.wire.channels import UnitConversion
from skin.wire.segmentation import AbstractSegmenter, AnnouncementListener, RecordedGesture
from skin.wire.skin import play
from skin.wire.source import SerialSource, Source


class AbstractWired(AbstractDevice):
    """Base class of devices that read a skin at a port, frame by frame.

    Attributes:
        wire: opens the port.
        sensors: S sensors, one per value of a frame.
        window: frames per touch.
        model_rate: frames per second that touches are resampled to, Hz.
        labels: source of the labels.
        gestures: number of touches of ``test``.
        calibration: calibration file of the device; or None.
    """

    real = True
    wire: SerialSource
    sensors: Sensors
    window: int
    model_rate: float
    labels: str
    gestures: int
    calibration: str | None

    @abstractmethod
    def segmenter(
        self,
        listener: AnnouncementListener,
        conversion: UnitConversion,
        first: Sequence[Frame],
        done: Collection[int] = (),
    ) -> AbstractSegmenter:
        """Return the segmenter of a stream.

        Args:
            listener: collects announcements.
            conversion: of the values to N.
            first: frames read before.
            done: numbers of gestures that are already recorded.
        """

    @abstractmethod
    def to_recording(self, gestures: Sequence[RecordedGesture], conversion: UnitConversion) -> Recording:
        """Return gestures as a recording."""


def open_source(device: AbstractDevice) -> Source:
    """Open the stream of frames that ``skin live`` watches: of a port, or touches in real time.

    Raises:
        InputError: the stream cannot be opened, or the device has none.
    """
    if isinstance(device, AbstractWired):
        return device.wire.open_source()
    strips = iter(device.strips())
    first = next(strips)
    return Source.in_newtons(device.name, play(chain([first], strips)), first.readings.shape[2])

"""Data augmentation: changes of a touch that keep its labels."""

from dataclasses import dataclass, replace

import torch
from pydantic import NonNegativeFloat
from torch import Tensor

from skin.errors import InputError
from skin.recording import Touches
from skin.settings import checked

_IDLE = 8
_MARGIN = 2  # frames that a touch may last beyond what stands out


@checked("data.augment")
@dataclass(frozen=True)
class Augmentation:
    """Shifts, reverses, scales and blurs touches of a training batch.

    It needs no simulator, so it applies to recordings of a real skin too. It assumes that a window contains a
    whole touch with idle frames around it.

    Args:
        shift: shift the touch in its window, as far as it stays whole; idle frames wrap around.
        reverse: reverse time with probability 0.5.
        gain: standard deviation of the logarithm of a factor per sensor and touch.
        noise: standard deviation of the noise added to every reading, N.

    Raises:
        InputError: a negative number.
    """

    shift: bool = False
    reverse: bool = False
    gain: NonNegativeFloat = 0.0
    noise: NonNegativeFloat = 0.0

    def __call__(self, touches: Touches, generator: torch.Generator) -> Touches:
        """Return augmented touches; ``generator`` is the source of randomness.

        Raises:
            InputError: touches whose sensors move, for which shifts are not defined.
        """
        if touches.motion is not None:
            raise InputError("data.augment does not support touches with motion: leave out data.augment")
        count, time, sensors = touches.readings.shape
        order = torch.arange(time).expand(count, time)
        if self.shift:
            order = (order - self._shifts(touches, generator)[:, None]) % time
        if self.reverse:
            turned = torch.rand(count, generator=generator) < 0.5
            order = torch.where(turned[:, None], order.flip(1), order)
        order = order[..., None].expand(-1, -1, sensors)
        readings, valid = touches.readings.gather(1, order), touches.valid.gather(1, order)
        if self.gain:
            readings = readings * (self.gain * torch.randn(count, 1, sensors, generator=generator)).exp()
        if self.noise:
            readings = readings + self.noise * torch.randn(readings.shape, generator=generator)
        saturated = None if touches.saturated is None else touches.saturated.gather(1, order)
        return replace(touches, readings=readings, valid=valid, saturated=saturated)

    def _shifts(self, touches: Touches, generator: torch.Generator) -> Tensor:
        """Draw the shift of each touch, (B,), frames, such that none is cut."""
        raw = touches.readings * touches.valid
        idle = raw.topk(min(_IDLE, raw.shape[1]), dim=1, largest=False).values.mean(dim=1, keepdim=True)
        force = (raw - idle).clamp(min=0).sum(dim=2)
        touched = (force > 0.12 * force.amax(dim=1, keepdim=True)).int()
        first = touched.argmax(dim=1) - _MARGIN
        last = raw.shape[1] - touched.flip(1).argmax(dim=1) - 1 + _MARGIN
        early, late = first.clamp(min=0), (raw.shape[1] - 1 - last).clamp(min=0)
        chance = torch.rand(len(raw), generator=generator)
        return (chance * (early + late + 1)).floor().long() - early

"""Touches as frames of a representation, and as batches of a training."""

import itertools
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property, partial
from hashlib import sha256
from typing import TYPE_CHECKING, Any

import torch
from pydantic import NonNegativeFloat, PositiveInt
from torch import Tensor

from skin.core.settings import checked
from skin.device.base import AbstractDevice, Split, in_background, one_ahead
from skin.device.touches import Touches, touches_hash
from skin.errors import InputError
from skin.learning.representation import AbstractRepresentation, Frames, idle_level

if TYPE_CHECKING:
    from pytorch_lightning import Trainer

Batch = tuple[Frames, Tensor]
MakeRepresentation = Callable[[Tensor, tuple[float, float]], AbstractRepresentation]

# Data augmentation: changes of a touch that keep its labels.


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
        rows = torch.arange(count)[:, None]
        frames = {name: getattr(touches, name) for name in ("readings", "valid", "saturated", "contacts")}
        moved = {name: values[rows, order] for name, values in frames.items() if values is not None}
        if self.gain:
            moved["readings"] *= (self.gain * torch.randn(count, 1, sensors, generator=generator)).exp()
        if self.noise:
            moved["readings"] += self.noise * torch.randn(touches.readings.shape, generator=generator)
        return replace(touches, **moved)

    def _shifts(self, touches: Touches, generator: torch.Generator) -> Tensor:
        """Draw the shift of each touch, (B,), frames, such that none is cut."""
        raw = touches.readings * touches.valid
        force = (raw - idle_level(raw)).clamp(min=0).sum(dim=2)
        touched = (force > 0.12 * force.amax(dim=1, keepdim=True)).int()
        margin = 2  # frames that a touch may last beyond what stands out
        early = (touched.argmax(dim=1) - margin).clamp(min=0)
        late = (touched.flip(1).argmax(dim=1) - margin).clamp(min=0)
        fraction = torch.rand(len(raw), generator=generator)
        return (fraction * (early + late + 1)).floor().long() - early


@checked("data")
class TouchData:
    """A device's touches in a representation, whole or as batches.

    Batches are slices of tensors; the representation runs on whole batches, on the accelerator where there is
    one. A device that draws fresh gestures is called again every epoch. If a device makes its touches in
    parts, each epoch has the parts in another order, and shuffles the touches of each. Processes that train
    together share each training batch; each of them validates on all gestures.

    Without a Trainer, each pass over the training batches is the next epoch, and the loaders yield frames and
    labels on the CPU.

    Args:
        device: source of touches, which have the window, and the sensors if all touches need the same ones.
        representation: partial; takes positions (S, 3), m, and size (x, y), m.
        batch_size: gestures per batch.
        seed: of the order of gestures and of their augmentation; epoch e uses (seed, e).
        augmentation: changes the touches of training batches; None leaves them.
        geometry: returns that of the configured skin, (S, G), for touches that do not have it (of a port or a
            file); None: there is none.

    Attributes:
        device: as given.
        task: what the labels mean.
        make: the representation, as given.
        make_geometry: the geometry, as given.
        trainer: the Trainer that is training on the data.
        passes: counts the passes over training batches without a Trainer.
    """

    trainer: "Trainer | None" = None

    def __init__(
        self,
        device: AbstractDevice,
        representation: MakeRepresentation,
        batch_size: PositiveInt = 64,
        seed: int = 0,
        augmentation: Augmentation | None = None,
        geometry: Callable[[], Tensor] | None = None,
    ) -> None:
        if augmentation is not None and augmentation.reverse and device.task.direction:
            raise InputError(
                "a touch that runs backwards slides the other way: set data.augment.reverse=false where "
                "data.direction=true"
            )
        self.device, self.make, self.make_geometry = device, representation, geometry
        self.task, self._fresh = device.task, bool(getattr(device, "fresh", False))
        kind: Any = getattr(representation, "func", representation)
        self._layout_free = bool(kind.layout_free)
        self.batch_size, self.seed = batch_size, seed
        # An augmentation without effect must not draw random numbers.
        self.augmentation = None if augmentation == Augmentation() else augmentation
        self._known: tuple[Tensor, AbstractRepresentation] | None = None
        self._drawn: dict[str, Touches] = {}
        self._ahead: dict[int, Future[Touches]] = {}
        self.passes = itertools.count()

    @cached_property
    def example(self) -> Touches:
        """The first touch of the training split."""
        for touches in self.parts("train"):
            return touches[torch.tensor([0])]
        raise InputError("there are no touches to train on: generate or record more")

    @property
    def hash(self) -> str:
        """Hash of the readings and labels of the training split."""
        hashes = [touches_hash(touches) for touches in self.parts("train")]
        return hashes[0] if len(hashes) == 1 else sha256("".join(hashes).encode()).hexdigest()[:16]

    def count(self, split: Split) -> list[int]:
        """Return the number of touches of each part of a split, in the order of :meth:`parts`."""
        parts = self.device.parts(split)
        return [len(self.touches(split))] if parts is None else [part.count for part in parts]

    def parts(
        self, split: Split, epoch: int = 0, generator: torch.Generator | None = None
    ) -> Iterator[Touches]:
        """Yield the touches of a split, all at once unless the device makes them in parts.

        Args:
            split: of the device.
            epoch: as of :meth:`touches`.
            generator: shuffles the parts; None leaves them in order.
        """
        parts = self.device.parts(split)
        if parts is None:
            yield self.touches(split, epoch)
            return
        order = range(len(parts)) if generator is None else torch.randperm(len(parts), generator=generator)
        for number in order:
            yield parts[number].make().touches

    def touches(self, split: Split, epoch: int = 0) -> Touches:
        """Return the touches of a split; those of epoch 0 are kept."""
        if epoch == 0 or not self._fresh:
            if split not in self._drawn:
                self._drawn[split] = self.device.touches(split)
            return self._drawn[split]
        ahead = self._ahead.pop(epoch, None) if split == "train" else None
        return self.device.touches(split, epoch) if ahead is None else ahead.result()

    def draw_ahead(self, epoch: int) -> None:
        """Begin to draw the new gestures of an epoch on a thread beside the one that trains."""
        if self.alongside and self.trainer is not None and epoch < (self.trainer.max_epochs or 0):
            self._ahead[epoch] = in_background(partial(self.device.touches, "train", epoch))

    @property
    def alongside(self) -> bool:
        """Whether new gestures and frames are computed on threads beside the one that trains.

        With more threads each draw uses all of them, and changes their number meanwhile.
        """
        here = self.trainer is not None and self.trainer.strategy.root_device.type == "cpu"
        return here and self._fresh and torch.get_num_threads() == 1

    def train_dataloader(self) -> "_Batches":
        """Return the batches of the training split, in another order each epoch."""
        return _Batches(self, "train")

    def val_dataloader(self) -> "_Batches":
        """Return the batches of the validation split."""
        return _Batches(self, "validation")

    def representation_for(self, positions: Tensor) -> AbstractRepresentation:
        """Return the representation of a layout with positions (S, 3), m; the last one is kept.

        Raises:
            InputError: positions that change with time, (B, T, S, 3); motion is given beside the layout.
        """
        if self._known is not None and self._layout_free:
            return self._known[1]
        if positions.ndim != 2 and not self._layout_free:
            raise InputError(
                "representations are built for one layout, got positions per frame: give one position "
                "(x, y, z) per sensor, and how far it moves as Touches.motion"
            )
        if self._known is None or not torch.equal(self._known[0], positions):
            self._known = (positions, self.make(positions, self.device.size).requires_grad_(False))
        return self._known[1]

    def frames(self, touches: Touches) -> Batch:
        """Return the frames of touches and their labels (B, L), on the touches' device."""
        return self.show(touches), touches.known_labels

    def show(self, touches: Touches) -> Frames:
        """Return the frames of touches, on the touches' device."""
        device = touches.readings.device
        representation = self.representation_for(touches.positions.cpu()).to(device)
        if touches.geometry is None and self.geometry is not None:
            touches = replace(touches, geometry=self.geometry.to(device))
        return representation.show(touches)

    @cached_property
    def geometry(self) -> Tensor | None:
        """The geometry of the configured skin, (S, G); None if it is unknown, or not needed."""
        return self.make_geometry() if self._layout_free and self.make_geometry is not None else None


class _Batches:
    """The batches of one split; no torch DataLoader, which would touch every sample by itself."""

    def __init__(self, data: TouchData, split: Split) -> None:
        self.data, self.split = data, split

    def __len__(self) -> int:
        return sum(-(-count // self.data.batch_size) for count in self.data.count(self.split))

    def __iter__(self) -> Iterator[Touches | Batch]:
        data = self.data
        if self.split == "train" and data.alongside:
            yield from one_ahead(data.frames, self._touches())
        else:
            yield from self._touches() if data.trainer else map(data.frames, self._touches())

    def _touches(self) -> Iterator[Touches]:
        data = self.data
        if self.split != "train":
            for touches in data.parts(self.split):
                for start in range(0, len(touches), data.batch_size):
                    yield touches[start : start + data.batch_size]
            return
        epoch = data.trainer.current_epoch if data.trainer else next(data.passes)
        data.draw_ahead(epoch + 1)
        # one stream per (seed, epoch); a mere sum would give seed 1 the orders of seed 0, an epoch late
        generator = torch.Generator().manual_seed(data.seed * 1_000_003 + epoch)
        for touches in data.parts(self.split, epoch, generator):
            for index in torch.randperm(len(touches), generator=generator).split(data.batch_size):
                batch = touches[index]
                yield self._fraction(data.augmentation(batch, generator) if data.augmentation else batch)

    def _fraction(self, batch: Touches) -> Touches:
        """Return this process's part of a batch where several train together.

        Each takes a whole batch that has less than two gestures for each of them: batch norm needs two.
        """
        trainer = self.data.trainer
        if trainer is None or trainer.world_size == 1 or len(batch) < 2 * trainer.world_size:
            return batch
        return batch[trainer.global_rank :: trainer.world_size]

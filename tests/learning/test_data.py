"""Batches: every gesture once an epoch, in an order that only the seed decides."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import pytest
import torch

from skin.device.base import AbstractDevice
from skin.device.touches import Part, Recording, Touches
from skin.errors import InputError
from skin.learning.data import Augmentation, TouchData
from skin.learning.representation import Readings
from skin.runs.build import build_data, build_device
from skin.touch.labels import TOUCH_SLIDING

CUTS = [(0, 7), (7, 19), (19, 23)]


class Numbered(AbstractDevice):
    """Yields touches whose readings are their number, plus 1000 times the epoch."""

    size, fresh = (0.16, 0.16), False

    def __init__(self, task, count=23):
        self.task, self.count, self.asked = task, count, []

    def touches(self, split, epoch=0):
        self.asked.append((split, epoch))
        readings = (torch.arange(self.count) + 1000.0 * epoch)[:, None, None].repeat(1, 6, 2)
        return Touches(readings, readings >= 0, torch.ones(2, 3), torch.zeros(self.count, 4), 10.0)


class InParts(Numbered):
    """Makes its touches in parts of 7, 12 and 4."""

    def parts(self, split=None):
        return [Part(stop - start, partial(self._part, slice(start, stop))) for start, stop in CUTS]

    def _part(self, rows):
        whole = Numbered.touches(self, "train")[rows]
        return Recording(whole, self.task, self.size, (0.01, 0.01))

    def touches(self, split, epoch=0):
        raise AssertionError("its touches do not fit into memory")


class Trainer:
    current_epoch, world_size, global_rank, max_epochs = 0, 1, 0, 3
    strategy = SimpleNamespace(root_device=torch.device("meta"))


@pytest.fixture
def make(made_up_device):
    def make(seed=0, fresh=False, kind=Numbered, **options):
        device = kind(made_up_device.task)
        device.fresh = fresh
        data = TouchData(device, partial(Readings, scale=1.0), seed=seed, **({"batch_size": 5} | options))
        data.trainer = Trainer()
        return data

    return make


def numbers(batches):
    return [batch.readings[:, 0, 0].long().tolist() for batch in batches]


def flat(batches):
    return [number for batch in numbers(batches) for number in batch]


def test_processes_share_each_batch(make):
    alone = numbers(make().train_dataloader())
    parts = []
    for rank in range(2):
        data = make()
        data.trainer.world_size, data.trainer.global_rank = 2, rank
        parts.append(numbers(data.train_dataloader()))
        assert flat(data.val_dataloader()) == list(range(23))
    both = [sorted(one + other) for one, other in zip(*parts, strict=True)]
    assert both[:-1] == [sorted(batch) for batch in alone[:-1]]
    assert parts[0][-1] == parts[1][-1] == alone[-1]  # three gestures are too few for two processes


def test_one_thread_trains_while_another_draws_the_next_epoch(make, monkeypatch):
    monkeypatch.setattr(torch, "get_num_threads", lambda: 1)
    data, other = make(fresh=True), make(fresh=True)
    data.trainer.strategy = SimpleNamespace(root_device=torch.device("cpu"))
    for epoch in range(3):
        data.trainer.current_epoch = other.trainer.current_epoch = epoch
        batches = [*data.train_dataloader()]
        expected = [other.frames(batch) for batch in other.train_dataloader()]
        assert len(batches) == len(expected) == 5
        for batch, (frames, labels) in zip(batches, expected, strict=True):
            assert torch.equal(batch[0].x, frames.x)
            assert torch.equal(batch[1], labels)
    assert sorted(data.device.asked) == [("train", epoch) for epoch in range(3)]


@pytest.mark.parametrize(("kind", "sizes"), [(Numbered, [3, 5, 5, 5, 5]), (InParts, [2, 2, 4, 5, 5, 5])])
def test_an_epoch_shows_every_gesture_once_in_an_order_of_seed_and_epoch(make, kind, sizes):
    data, other, orders = make(kind=kind), make(seed=1, kind=kind), []
    batches = data.train_dataloader()
    for epoch in range(2):
        data.trainer.current_epoch = other.trainer.current_epoch = epoch
        orders += [flat(batches), flat(other.train_dataloader())]
        assert flat(data.train_dataloader()) == orders[-2]
    assert sorted(map(len, numbers(batches))) == sizes
    assert len(batches) == len(sizes)
    assert all(sorted(order) == list(range(23)) for order in orders)
    assert len({tuple(order) for order in [*orders, range(23)]}) == 5


def test_parts_come_in_another_order_each_epoch_and_one_after_the_other(make):
    data, orders = make(kind=InParts), set()
    for epoch in range(12):
        data.trainer.current_epoch = epoch
        part = [sum(number >= stop for _, stop in CUTS) for number in flat(data.train_dataloader())]
        order = [one for one, before in zip(part, [None, *part], strict=False) if one != before]
        assert sorted(order) == [0, 1, 2]
        orders.add(tuple(order))
    assert len(orders) > 2


@pytest.mark.parametrize("fresh", [False, True])
def test_without_a_trainer_each_pass_is_the_next_epoch(make, fresh):
    """A loop of one's own gets the frames and labels that a Trainer's network gets."""
    alone, other = make(fresh=fresh), make(fresh=fresh)
    alone.trainer = None
    held = alone.train_dataloader()
    for epoch in range(3):
        other.trainer.current_epoch = epoch
        expected = [other.frames(batch) for batch in other.train_dataloader()]
        loader = held if epoch else alone.train_dataloader()  # it may be kept, or made anew
        for (frames, labels), (x, y) in zip(loader, expected, strict=True):
            assert torch.equal(frames.x, x.x)
            assert torch.equal(labels, y)
        assert len(list(alone.val_dataloader())) == 5
    assert all(frames.x.shape[1:] == (6, 2) for frames, _ in alone.val_dataloader())


def test_what_cannot_be_batched_is_refused(make, made_up_device):
    with pytest.raises(InputError, match=r"data\.batch_size=64"):
        make(batch_size=0)
    with pytest.raises(InputError, match="positions per frame"):
        make().representation_for(torch.rand(4, 6, 2, 3))
    readings = torch.zeros(1, 6, 2)
    with pytest.raises(InputError, match="without labels"):
        make().frames(Touches(readings, readings == 0, torch.rand(2, 3), None, 10.0))
    made_up_device.task = TOUCH_SLIDING
    with pytest.raises(InputError, match=r"set data.augment.reverse=false"):
        TouchData(made_up_device, Readings, augmentation=Augmentation(reverse=True))


def test_touches_without_geometry_get_that_of_the_configured_skin(configured):
    small = ["body.cells=[10,10]", "layout=grid", "device.test_gestures=16", "data.gestures=16"]
    config = configured("representation=sites", "simulator=solid", "simulator.divisions=1", *small)
    device = build_device(config)
    touches, data = device.touches("test")[:8], build_data(config, device)
    unknown = replace(touches, geometry=None)
    torch.testing.assert_close(data.show(unknown).x, data.show(touches).x)
    torch.testing.assert_close(data.show(unknown).summary, data.show(touches).summary)
    other = build_data(configured("representation=sites", "simulator=naive", *small), device)
    assert not torch.allclose(other.show(unknown).x, data.show(touches).x)


# Changed touches keep their labels true.


TIME, SENSORS = 30, 4


@pytest.fixture
def touches():
    """Return touches of 8 frames that begin at frame 5 to 12, over constant offsets."""
    generator = torch.Generator().manual_seed(0)
    readings = torch.randn(64, 1, SENSORS, generator=generator).expand(-1, TIME, -1).clone()
    for number in range(64):
        start = 5 + number % 8
        readings[number, start : start + 8] += torch.arange(1.0, 9.0)[:, None]
    valid = torch.ones_like(readings, dtype=torch.bool)
    return Touches(readings, valid, torch.rand(SENSORS, 3), torch.ones(64, 4), 10.0)


def changed(touches, seed=1, **settings):
    return Augmentation(**settings)(touches, torch.Generator().manual_seed(seed))


def pressed(touches):
    excess = touches.readings - touches.readings.amin(dim=1, keepdim=True)
    return excess.amax(dim=2)


def test_a_shift_moves_the_touch_whole(touches):
    before, after = pressed(touches), pressed(changed(touches, shift=True))
    first = (after > 0).int().argmax(dim=1)
    assert len(first.unique()) > 8
    for number, start in enumerate(first.tolist()):
        assert torch.allclose(after[number, start : start + 8], torch.arange(1.0, 9.0))
    torch.testing.assert_close(after.sum(dim=1), before.sum(dim=1))


def test_every_second_touch_runs_backwards(touches):
    after = changed(touches, reverse=True).readings
    back = (after == touches.readings.flip(1)).all(dim=(1, 2))
    kept = (after == touches.readings).all(dim=(1, 2))
    assert (back ^ kept).all()
    assert 16 < back.sum() < 48


def test_gain_is_one_factor_per_sensor_and_touch_and_noise_has_its_deviation(touches):
    factor = changed(touches, gain=0.1).readings / touches.readings
    torch.testing.assert_close(factor, factor[:, :1].expand_as(factor))
    assert factor[:, 0].log().std() == pytest.approx(0.1, rel=0.15)
    assert (changed(touches, noise=0.2).readings - touches.readings).std() == pytest.approx(0.2, rel=0.05)

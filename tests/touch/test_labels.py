"""Labels that leave others undefined, thresholds, and labels of one's own."""

import pytest
import torch

from skin.body.layout import Grid
from skin.body.sheet import Sheet
from skin.device.simulated import Simulated
from skin.errors import InputError
from skin.mechanics.simulator.naive import Naive
from skin.touch.fingertips import read_touch
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, Label


def test_a_shut_gate_silences_the_other_labels():
    given = torch.tensor([[1.0, 0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    assert TOUCH_OR_NOT.counts(given).tolist() == [[True] * 5, [False] * 4 + [True]]
    assert TOUCH_OR_NOT.gated == TOUCH.names
    assert TOUCH.counts(given[:, :4]).all()


def mean_speed(movie, body):
    """Return the length of each path by the diagonal of the skin and the duration."""
    return movie.parameters["speed"] / float(torch.tensor(body.size).norm())


OWN = {"fast": {"opposite": "slow", "measure": mean_speed, "above": 0.04}}
BODY = Sheet((0.16, 0.16), (16, 16), [{"material": "EcoFlex 00-30", "thickness": 0.005}])


@pytest.mark.parametrize("kind", [{}, {"radius": [0.004, 0.01]}], ids=["gestures", "fingertips"])
@pytest.mark.parametrize(
    "data", [{}, {"stream": True}, {"direction": True}], ids=["whole", "stream", "direction"]
)
def test_a_label_of_ones_own_follows_from_its_measure(kind, data):
    settings = {"layout": Grid(3, 3), "simulator": Naive, "gestures": 80, "test_gestures": 10}
    plain, device = (
        Simulated(body=BODY, touch=kind | more, **settings, **data) for more in ({}, {"labels": OWN})
    )
    names = list(plain.task.names)
    assert device.task.names == (*names[:4], "fast", *names[4:])
    assert (device.task.gate, device.task.direction) == (plain.task.gate, plain.task.direction)
    recording, other = (one.recording("train", complete=False) for one in (device, plain))
    assert torch.equal(recording.touches.readings, other.touches.readings)  # it changes no draw
    labels = recording.touches.labels
    assert torch.equal(labels[:, [n for n in range(len(names) + 1) if n != 4]], other.touches.labels)
    fast = recording.parameters["speed"] / (0.16 * 2**0.5) > 0.04
    assert torch.equal(labels[:, 4] > 0.5, fast if "stream" not in data else fast & (labels[:, 5] > 0.5))
    assert 0 < labels[:, 4].mean() < 0.6


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"rub": {"opposite": "still"}}, "touch.labels.rub needs measure and above"),
        ({"rub": OWN["fast"] | {"over": 1}}, "touch.labels.rub has no setting over"),
        ({"rub": OWN["fast"] | {"above": "much"}}, "touch.labels.rub.above=much must be"),
        ({"big": OWN["fast"]}, "touch.labels.big is a label already: give yours another name"),
        ([1], r"touch.labels must be labels by name, got"),
    ],
)
def test_a_wrong_label_is_one_sentence(labels, message):
    with pytest.raises(InputError, match=message):
        read_touch({"labels": labels})
    assert read_touch({"labels": OWN}).labels == {"fast": Label(**OWN["fast"])}

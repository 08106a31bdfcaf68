"""Labels that leave others undefined, and thresholds."""

import pytest
import torch

from skin.errors import InputError
from skin.touch.labels import TOUCH, TOUCH_OR_NOT, TOUCH_SLIDING, Task, Thresholds


@pytest.mark.parametrize("wrong", [{"area": 0}, {"area": 1.5}, {"contact": -0.1}])
def test_shares_are_shares(wrong):
    with pytest.raises(InputError, match=r"touch.thresholds"):
        Thresholds(**wrong)


def test_a_shut_gate_silences_the_other_labels():
    given = torch.tensor([[1.0, 0.0, 0.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0, 0.0]])
    assert TOUCH_OR_NOT.counts(given).tolist() == [[True] * 5, [False] * 4 + [True]]
    assert TOUCH_OR_NOT.gated == TOUCH.names
    assert TOUCH.counts(given[:, :4]).all()


@pytest.mark.parametrize("kind", ["binary", "exclusive"])
def test_a_gate_is_one_of_the_binary_labels(kind):
    with pytest.raises(ValueError, match="no gate"):
        Task(("poke", "touch"), kind, gate="touched" if kind == "binary" else "touch")


def test_a_touch_without_a_direction_counts_in_the_other_labels_only():
    given = torch.tensor([[1.0, 1.0, 0.0, 1.0, 0.6, -0.8], [0.0, 1.0, 1.0, 0.0, 0.0, 0.0]])
    assert TOUCH_SLIDING.counts(given).tolist() == [[True] * 6, [True] * 4 + [False] * 2]
    assert TOUCH_SLIDING.binary == TOUCH_SLIDING.gated == TOUCH.names
    torch.testing.assert_close(TOUCH_SLIDING.shares(given)[0], torch.tensor([1.0, 1.0, 0.0, 1.0, 0.8, 0.1]))


def test_a_direction_stands_behind_binary_labels():
    with pytest.raises(ValueError, match="a direction stands behind binary labels"):
        Task(("poke", "x", "y"), "exclusive", direction=True)

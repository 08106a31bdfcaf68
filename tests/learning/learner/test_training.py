"""Callbacks of a training by themselves."""

from skin.learning.training import Clock


def test_a_clock_from_a_checkpoint_of_a_complete_training_knows_its_epochs(tmp_path):
    clock = Clock(tmp_path / "seconds.json")
    clock.load_state_dict({"seconds": [1.0, 5.0, 2.0]})
    assert clock.median() == 2.0

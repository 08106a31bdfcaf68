"""The callback of a training by itself."""

from skin.learning.training import Progress


def test_progress_from_a_checkpoint_of_a_complete_training_knows_its_epochs(tmp_path):
    progress = Progress(tmp_path / "seconds.json")
    progress.load_state_dict({"seconds": [1.0, 5.0, 2.0], "state": None})
    assert progress.median() == 2.0

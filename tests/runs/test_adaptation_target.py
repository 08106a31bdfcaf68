"""The gestures that a run is adapted to, and those that are reported."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from hydra import compose, initialize_config_dir

from skin.core.files import CONF
from skin.device.base import split_slices
from skin.errors import InputError
from skin.runs.adaptation import FineTuning, choose_gestures, find_target, simulated_budget
from skin.runs.build import build_device
from skin.runs.configuration import validate_config
from skin.runs.run import FinishedRun

NAIVE = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2"]


@pytest.mark.parametrize(("count", "budget"), [(8, 10), (16, 20), (48, 60), (49, 62), (3230, 4038)])
def test_the_training_split_of_the_budget_is_large_enough(count, budget):
    assert simulated_budget(FineTuning(gestures=count))["gestures"] == budget
    assert split_slices(budget)["train"].stop in (count, count + 1)


def test_simulated_gestures_are_those_that_a_training_has_with_the_same_seed(configured):
    fresh = build_device(configured(*NAIVE, "data.fresh=true", "device.test_gestures=20"))
    touches, others = choose_gestures(fresh, FineTuning(gestures=16, seed=3))
    trained = build_device(configured(*NAIVE, "data.gestures=20", "seed=3"))
    assert torch.equal(touches.readings, trained.touches("train").readings)
    assert torch.equal(others.touches("test").readings, fresh.touches("test").readings)


def test_a_part_of_a_recording_is_chosen_and_the_rest_is_reported(made_up_device):
    whole = made_up_device.all_touches()
    touches, others = choose_gestures(made_up_device, FineTuning(gestures=16, seed=1))
    both = torch.cat([touches.readings, others.touches("test").readings])
    assert (len(touches), len(both)) == (16, len(whole))
    assert torch.equal(both.sum(dim=(1, 2)).sort().values, whole.readings.sum(dim=(1, 2)).sort().values)
    other, _ = choose_gestures(made_up_device, FineTuning(gestures=16, seed=2))
    assert not torch.equal(touches.readings, other.readings)
    touches, others = choose_gestures(made_up_device, FineTuning())
    assert (len(touches), others) == (len(whole), None)


@pytest.mark.parametrize(
    ("change", "wanted", "reason"),
    [
        (lambda touches: touches[:7], None, "7 gestures are too few .* record 8 or more"),
        (lambda touches: touches[:20], 21, "use adapt.gestures=20"),
        (lambda touches: replace(touches, labels=None), None, "record them with labels"),
    ],
)
def test_too_few_gestures_or_gestures_without_labels_are_refused(
    made_up_device, monkeypatch, change, wanted, reason
):
    touches = change(made_up_device.all_touches())
    monkeypatch.setattr(made_up_device, "all_touches", lambda: touches)
    with pytest.raises(InputError, match=reason):
        choose_gestures(made_up_device, FineTuning(gestures=wanted))


def test_the_threshold_of_the_alarm_may_be_for_a_profile():
    words = ["evaluation.profile=rough", "device.noise=0.3"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        stored = validate_config(compose("train", [*NAIVE, "device.noise=0.2"]))
        run = SimpleNamespace(
            info=SimpleNamespace(run_id="a"), data=SimpleNamespace(tags={"fingerprint": "b"})
        )
        parent = FinishedRun(None, run)
        parent.__dict__["stored"] = stored
        found = {
            given: find_target(parent, validate_config(compose("adapt", given)), FineTuning(), given)
            for given in (tuple(words), ())
        }
    profiled, plainly = found.values()
    (device, twin, config), (_, plain, _) = profiled, plainly
    assert (twin.noise, twin.gain_spread, twin.randomise) == (0.1, 0.2, True)
    assert (plain.noise, plain.randomise) == (0.2, False)
    assert config.evaluation.profile == "rough"
    # The gestures to adapt on are measured by the described device, not by one of the profile.
    assert device.noise == 0.3

"""Fine-tuning: the gestures, what changes a network, and that it stays where nothing is better."""

from copy import deepcopy
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from skin.core.files import CONF
from skin.device.files import write_recording
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.small_data import split_folds
from skin.runs import adaptation
from skin.runs.adaptation import Candidate, FineTuning
from skin.runs.build import build_device, build_learner, default_option
from skin.runs.configuration import validate_config
from skin.runs.run import FinishedRun
from tests.made_up import MadeUpDevice

NAIVE = ["simulator=naive", "layout=grid", "layout.rows=2", "layout.columns=2"]
SMALL = FineTuning(layers=["all"], lr=[3e-3], epochs=15, patience=5)


def test_a_part_of_a_recording_is_chosen_and_the_rest_is_reported(made_up_device):
    whole = made_up_device.all_touches()
    touches, others = adaptation.choose_gestures(made_up_device, FineTuning(gestures=16, seed=1))
    both = torch.cat([touches.readings, others.touches("test").readings])
    assert (len(touches), len(both)) == (16, len(whole))
    assert torch.equal(both.sum(dim=(1, 2)).sort().values, whole.readings.sum(dim=(1, 2)).sort().values)
    other, _ = adaptation.choose_gestures(made_up_device, FineTuning(gestures=16, seed=2))
    assert not torch.equal(touches.readings, other.readings)
    touches, others = adaptation.choose_gestures(made_up_device, FineTuning())
    assert (len(touches), others) == (len(whole), None)


@pytest.mark.parametrize(
    ("change", "wanted", "reason"),
    [
        (lambda touches: touches[:7], None, "7 gestures are too few .* record 8 or more"),
        (lambda touches: touches[:20], 21, "use adapt.gestures=20"),
        (lambda touches: replace(touches, labels=None), None, "record them with labels"),
    ],
)
def test_too_few_or_unlabelled_gestures_are_refused(made_up_device, monkeypatch, change, wanted, reason):
    touches = change(made_up_device.all_touches())
    monkeypatch.setattr(made_up_device, "all_touches", lambda: touches)
    with pytest.raises(InputError, match=reason):
        adaptation.choose_gestures(made_up_device, FineTuning(gestures=wanted))


def test_the_threshold_of_the_alarm_may_be_for_a_profile(configured, tmp_path):
    device = build_device(configured(*NAIVE, "data.gestures=10"))
    path = write_recording(device.recording(complete=False), tmp_path / "x.parquet")
    recorded = ["device=recording", f"device.path={path}"]
    parent = FinishedRun(None, SimpleNamespace(data=SimpleNamespace(tags={"fingerprint": "b"})))
    with initialize_config_dir(str(CONF), version_base="1.3"):
        parent.__dict__["stored"] = validate_config(compose("train", [*NAIVE, "device.noise=0.2"]))
        (_, twin, config), (_, plain, _) = (
            adaptation.find_target(parent, validate_config(compose("adapt", words)), FineTuning(), words)
            for words in ([*recorded, "evaluation.profile=rough"], recorded)
        )
    assert (twin.noise, twin.gain_spread, twin.randomise) == (0.1, 0.2, True)
    assert (plain.noise, plain.randomise) == (0.2, False)
    assert config.evaluation.profile == "rough"


@pytest.fixture(scope="module")
def once(configured):
    config = configured(
        "representation=features", "model=mlp", "model.widths=[]", "fusion.head=residual",
        "fusion.hidden=16", "optimizer.lr=0.003", "trainer.max_epochs=15",
    )  # fmt: skip
    data, learner = TouchData(MadeUpDevice(), instantiate(config.representation), 32), build_learner(config)
    learner.fit(data)
    return learner, data


@pytest.fixture
def trained(once):
    return deepcopy(once[0]), once[1]


def other_skin(touches):
    """Return the touches as measured by sensors with other gains."""
    gains = torch.rand(touches.readings.shape[2], generator=torch.Generator().manual_seed(1)) * 0.5 + 0.1
    return replace(touches, readings=touches.readings * gains)


def loss(learner, data, touches):
    network = learner.network.eval()
    with torch.no_grad():
        return float(network.loss(network(data.frames(touches)[0]), touches.known_labels))


def equal(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def adapted(learner, data, touches, settings):
    candidates = adaptation.fine_tune(learner, data, touches, settings)
    best, judged = adaptation.choose_candidate(candidates, touches, data.task, settings)
    best.train()
    return candidates, best, judged


def test_another_skin_is_learnt_from_few_gestures(trained):
    learner, data = trained
    before, unseen = deepcopy(learner), other_skin(data.touches("test"))
    _, best, _ = adapted(learner, data, other_skin(data.touches("validation")), SMALL)
    assert best.name.startswith("layers=all lr=0.003 epochs=")
    assert loss(learner, data, unseen) < 0.8 * loss(before, data, unseen)


def test_what_is_not_better_leaves_the_network_as_it_was(trained):
    learner, data = trained
    before = deepcopy(learner.network.state_dict())
    candidates, best, judged = adapted(learner, data, data.touches("validation"), replace(SMALL, lr=[1e3]))
    assert best is candidates[0]
    assert best.name == ""
    assert judged is best.probabilities
    assert equal(learner.network.state_dict(), before)


def test_a_fold_is_judged_by_the_choice_of_the_others(trained):
    """Lowest of all is a candidate that is right on one fold only; that fold must not count for it."""
    _, data = trained
    touches = data.touches("validation")
    fold = split_folds(touches.known_labels, 4, 0)
    right, held = touches.known_labels.numpy() * 0.96 + 0.02, (fold == 0).numpy()[:, None]
    first = np.where(held, 1 - right, right)
    lucky = np.where(held, right, 0.9 * right + 0.05)
    candidates = [Candidate("", first, None), Candidate("lucky", lucky, None)]
    assert adaptation.choose_candidate(candidates, touches, data.task, SMALL)[0].name == ""


def test_gestures_are_held_out_of_what_predicts_them(trained):
    """Labels at random can be learnt by heart only."""
    learner, data = trained
    labels = torch.rand(48, 4, generator=torch.Generator().manual_seed(2)).round()
    touches = replace(data.touches("train")[:48], labels=labels)
    long = replace(SMALL, epochs=20, patience=20, lr=[1e-2])
    candidates = adaptation.fine_tune(learner, data, touches, long)
    assert len(candidates) == 21
    assert ((candidates[-1].probabilities > 0.5) == (labels.numpy() > 0.5)).mean() < 0.65
    options = {"kernel_ridge": default_option("learner", "kernel_ridge")}
    (scratch,) = adaptation.learn_from_scratch(touches, data.task, long, options)
    assert ((scratch.probabilities > 0.5) == (labels.numpy() > 0.5)).mean() < 0.65


def test_learners_from_scratch_need_each_label_outside_of_each_fold(trained, capsys):
    _, data = trained
    touches = data.touches("train")[:16]
    touches = replace(touches, labels=torch.zeros_like(touches.labels))
    options = {"kernel_ridge": default_option("learner", "kernel_ridge")}
    assert not [*adaptation.learn_from_scratch(touches, data.task, SMALL, options)]
    assert "kernel_ridge is not compared: all training touches have the same label" in capsys.readouterr().err


@pytest.mark.parametrize("layers", ["head", "all"])
def test_the_chosen_layers_are_trained_and_batch_norms_keep_their_statistics(trained, layers):
    learner, data = trained
    before = deepcopy(learner.network.state_dict())
    settings = replace(SMALL, layers=[layers], epochs=4)
    assert adapted(learner, data, other_skin(data.touches("validation")), settings)[1].name
    after = learner.network.state_dict()
    changed = {name for name in before if not torch.equal(after[name], before[name])}
    statistics = {name for name in before if "running" in name or "num_batches" in name}
    assert statistics
    trainable = set(before) - statistics
    assert changed == {name for name in trainable if layers == "all" or name.startswith("head.")}


def test_the_choice_with_the_lowest_held_out_loss_is_taken_and_a_seed_gives_the_same_weights(trained):
    learner, data = trained
    twin, touches = deepcopy(learner), other_skin(data.touches("validation"))
    wide = replace(SMALL, layers=["head", "all"], lr=[1e-6, 3e-3], epochs=4)
    candidates, best, _ = adapted(learner, data, touches, wide)
    assert len({one.name.rsplit(" ", 1)[0] for one in candidates}) == 5
    assert " lr=0.003 " in best.name
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    assert adapted(twin, data, touches, wide)[1].name == best.name
    assert torch.equal(torch.rand(1), expected)
    assert equal(learner.network.state_dict(), twin.network.state_dict())


def test_folds_have_equal_shares_of_each_combination():
    labels = torch.cartesian_prod(*4 * [torch.tensor([0.0, 1.0])]).repeat(5, 1)
    folds = split_folds(labels, 4, seed=0)
    assert folds.bincount().tolist() == [20] * 4
    for combination in labels.unique(dim=0):
        own = folds[(labels == combination).all(dim=1)]
        assert sorted(own.bincount(minlength=4).tolist()) == [1, 1, 1, 2]
    assert not torch.equal(folds, split_folds(labels, 4, seed=1))

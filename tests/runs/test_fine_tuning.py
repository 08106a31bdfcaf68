"""Fine-tuning changes a network where that is better on gestures that were held out, and else leaves it."""

from copy import deepcopy
from dataclasses import replace

import pytest
import torch
from hydra.utils import instantiate

from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.small_data import split_folds
from skin.runs.adaptation import FineTuning, Folds, Trial, fine_tune
from skin.runs.build import build_learner

SMALL = FineTuning(layers=["all"], lr=[3e-3], epochs=15, patience=5)


@pytest.fixture(scope="module")
def once():
    """Return what the first test has trained: a training takes seconds."""
    return []


@pytest.fixture
def trained(configured, made_up_device, once):
    """Return a learner that has learnt the touches of the made-up device, and its data."""
    if not once:
        config = configured(
            "representation=features", "model=mlp", "model.widths=[]", "fusion.head=residual",
            "fusion.hidden=16", "optimizer.lr=0.003", "trainer.max_epochs=15",
        )  # fmt: skip
        data = TouchData(made_up_device, instantiate(config.representation), 32)
        learner = build_learner(config)
        learner.fit(data)
        once.extend((learner, data))
    return once


@pytest.fixture
def network(trained):
    """Return a copy of the network: tests change it."""
    return deepcopy(trained[0].network)


def other_skin(touches):
    """Return the touches as measured by sensors with other gains."""
    gains = torch.rand(touches.readings.shape[2], generator=torch.Generator().manual_seed(1)) * 0.5 + 0.1
    return replace(touches, readings=touches.readings * gains)


def loss(network, data, touches):
    with torch.no_grad():
        return float(network.loss(network.eval()(data.frames(touches)[0]), touches.known_labels))


def equal(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def test_another_skin_is_learnt_from_few_gestures(trained, network):
    _, data = trained
    before = deepcopy(network)
    found = fine_tune(network, data, other_skin(data.touches("validation")), SMALL)
    assert found.better
    unseen = other_skin(data.touches("test"))
    assert loss(network, data, unseen) < 0.8 * loss(before, data, unseen)


def test_what_is_not_better_leaves_the_network_as_it_was(trained, network):
    _, data = trained
    before = deepcopy(network.state_dict())
    found = fine_tune(network, data, data.touches("validation"), replace(SMALL, lr=[1e3]))
    assert not found.better
    assert found.choice == ""
    assert equal(network.state_dict(), before)


def test_a_fold_is_judged_by_the_choice_of_the_others(trained, network):
    """Lowest of all is a candidate that is right on one fold only; that fold must not count for it."""
    _, data = trained
    touches = data.touches("validation")
    problem = Folds(network, data, touches, SMALL)
    right, held = 8 * (touches.known_labels - 0.5), (problem.fold == 0)[:, None]
    first = torch.where(held, -right, right)
    lucky = torch.where(held, right, 0.9 * right)
    losses = [float(network.loss(logits, touches.known_labels)) for logits in (first, lucky)]
    assert losses[1] < losses[0]
    judged = problem.judged([Trial("all", 1e-3, losses, torch.stack([first, lucky]))])
    assert torch.equal(judged, torch.where(held, first, lucky))


def test_gestures_are_held_out_of_what_predicts_them(trained, network):
    """Labels at random can be learnt by heart only."""
    _, data = trained
    touches = data.touches("train")[:48]
    labels = torch.rand(48, 4, generator=torch.Generator().manual_seed(2)).round()
    long = replace(SMALL, epochs=20, patience=20, lr=[1e-2])
    found = fine_tune(network, data, replace(touches, labels=labels), long)
    assert ((found.after > 0.5) == (labels > 0.5)).float().mean() < 0.65
    assert len(found.trials[0].losses) == 21


@pytest.mark.parametrize("layers", ["head", "all"])
def test_the_chosen_layers_are_trained_and_batch_norms_keep_their_statistics(trained, network, layers):
    _, data = trained
    before = deepcopy(network.state_dict())
    settings = replace(SMALL, layers=[layers], epochs=4)
    assert fine_tune(network, data, other_skin(data.touches("validation")), settings).better
    after = network.state_dict()
    changed = {name for name in before if not torch.equal(after[name], before[name])}
    statistics = {name for name in before if "running" in name or "num_batches" in name}
    assert statistics
    trainable = set(before) - statistics
    assert changed == {name for name in trainable if layers == "all" or name.startswith("head.")}


def test_the_choice_with_the_lowest_held_out_loss_is_taken(trained, network):
    _, data = trained
    wide = replace(SMALL, layers=["head", "all"], lr=[1e-6, 3e-3], epochs=6)
    found = fine_tune(network, data, other_skin(data.touches("validation")), wide)
    assert len(found.trials) == 4
    lowest = min(found.trials, key=lambda trial: min(trial.losses))
    epochs = lowest.losses.index(min(lowest.losses))
    assert found.choice == f"layers={lowest.layers} lr=0.003 epochs={epochs}"


def test_a_seed_gives_the_same_weights_and_leaves_the_random_state(trained, network):
    _, data = trained
    twin, touches = deepcopy(network), other_skin(data.touches("validation"))
    torch.manual_seed(5)
    expected = torch.rand(1)
    torch.manual_seed(5)
    fine_tune(network, data, touches, replace(SMALL, epochs=3))
    assert torch.equal(torch.rand(1), expected)
    fine_tune(twin, data, touches, replace(SMALL, epochs=3))
    assert equal(network.state_dict(), twin.state_dict())


def test_folds_have_equal_shares_of_each_combination():
    labels = torch.cartesian_prod(*4 * [torch.tensor([0.0, 1.0])]).repeat(5, 1)
    folds = split_folds(labels, 4, seed=0)
    assert folds.bincount().tolist() == [20] * 4
    for combination in labels.unique(dim=0):
        own = folds[(labels == combination).all(dim=1)]
        assert sorted(own.bincount(minlength=4).tolist()) == [1, 1, 1, 2]
    assert not torch.equal(folds, split_folds(labels, 4, seed=1))


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"gestures": 7}, "adapt.gestures=7 must be greater than or equal to 8"),
        ({"folds": 1}, "adapt.folds=1"),
        ({"folds": 9}, "adapt.folds=9"),
        ({"layers": ["body"]}, "adapt.layers"),
        ({"layers": []}, "too few"),
        ({"lr": [0.0]}, "adapt.lr"),
    ],
)
def test_bad_settings_are_refused(settings, reason):
    with pytest.raises(InputError, match=reason):
        FineTuning(**settings)

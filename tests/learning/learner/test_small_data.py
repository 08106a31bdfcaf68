"""Learners for small data: labels, classes and targets, the choice among them, and damaged files."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from sklearn.ensemble import ExtraTreesClassifier
from sklearn.kernel_ridge import KernelRidge as SklearnKernelRidge
from skops.io import dump

from skin.device.base import AbstractDevice
from skin.device.touches import Touches, one_hot
from skin.errors import InputError
from skin.learning.data import TouchData
from skin.learning.features import above_idle
from skin.learning.representation import Readings
from skin.learning.small_data import BestByCrossValidation, ExtraTrees, KernelRidge, touch_losses
from skin.touch.labels import TOUCH, Task

PLACE = Task(("x", "force"), "regression")
GESTURES = Task(("pat", "hold", "tap"), "exclusive")
FewTrees = partial(ExtraTrees, 30)  # those of 300 take minutes
FORGED = [
    (FewTrees, "children", np.zeros_like),  # a circle
    (FewTrees, "children", lambda array: array - 1),
    (FewTrees, "children", lambda array: array + 10**6),
    (FewTrees, "feature", lambda array: array + 1000),
    (FewTrees, "roots", lambda array: array + 10**6),
    (FewTrees, "values", lambda array: array[:-1]),
    (FewTrees, "values", lambda array: array * np.inf),
    (FewTrees, "values", lambda array: np.hstack([array, array])),
    (FewTrees, "threshold", lambda array: array.astype(str)),
    (FewTrees, "n_features_in_", lambda count: count + 1),
    (KernelRidge, "weights", lambda array: array[:-1]),
    (KernelRidge, "vectors", lambda array: array[:, 1:]),
    (KernelRidge, "mean", lambda array: array * np.nan),
    (KernelRidge, "typical", lambda array: array.astype(str)),
]


@dataclass
class Presses(AbstractDevice):
    """Yields presses on a row of four sensors: where, how hard, and how often."""

    task: Task
    size = (0.04, 0.01)
    configured = False

    def touches(self, split: str, epoch: int = 0) -> Touches:
        source = torch.Generator().manual_seed(sum(map(ord, split)))
        count = {"train": 100, "test": 40}[split]  # the others are for what is chosen later, as the alarm
        x, force = 0.04 * torch.rand(count, generator=source), 1 + 4 * torch.rand(count, generator=source)
        sites = 0.01 * (torch.arange(4) + 0.5)
        gesture = torch.arange(count) % 3
        time = torch.arange(30)
        course = torch.stack([(time % 6 < 2).float(), torch.ones(30), (time == 9).float()])[gesture]
        course = course * ((time > 3) & (time < 24))
        bump = torch.exp(-(((x[:, None] - sites) / 0.01) ** 2))[:, None]
        readings = force[:, None, None] * course[..., None] * bump
        readings = readings + 0.01 * torch.randn(readings.shape, generator=source)
        labels = torch.stack([x, force], dim=1) if self.task == PLACE else one_hot(gesture.float(), 3)
        labels[::10] = torch.nan
        positions = torch.stack([sites, torch.full((4,), 0.005), torch.zeros(4)], dim=1)
        return Touches(readings, torch.ones_like(readings).bool(), positions, labels, 10.0)


@pytest.mark.parametrize("make", [KernelRidge, FewTrees])
def test_classes_and_targets_are_learned_and_stored(make, tmp_path):
    for task in (GESTURES, PLACE):
        data = TouchData(Presses(task), Readings)
        learner = make()
        learner.fit(data)
        touches = data.touches("test")
        result = learner.probabilities(touches)
        known = ~touches.labels[:, 0].isnan()
        if task == GESTURES:
            torch.testing.assert_close(result.sum(dim=1), torch.ones(40))
            assert (result.argmax(1) == touches.labels.argmax(1))[known].float().mean() > 0.95
        else:
            errors = (result - touches.labels)[known].square().mean(dim=0).sqrt()
            assert (errors < torch.tensor([0.003, 0.6])).all()
        folder = tmp_path / task.kind
        folder.mkdir()
        path = learner.save(folder)
        other = make()
        other.load(data, path)
        assert torch.equal(other.probabilities(touches), result)


def test_the_leave_one_out_errors_are_those_of_trainings_without_the_touch(monkeypatch):
    outputs = []
    keep = lambda held, labels: outputs.append(held) or np.ones(2)  # noqa: E731
    monkeypatch.setattr("skin.learning.small_data._fit_link", keep)
    values = np.random.default_rng(0)
    matrix, labels = values.normal(size=(30, 5)), (values.random((30, 1)) > 0.5).astype(float)
    learner = KernelRidge((1.0,), (0.1,)).learn(matrix, labels, Task(("press",)))
    kernel = learner.learned[0][0]
    if kernel.scale == 0:
        gram = kernel.vectors @ kernel.vectors.T / 5
    else:
        gram = np.exp(-cdist(kernel.vectors, kernel.vectors, "cityblock") / 5)
    centred = labels[:, 0] - labels.mean()
    for left in (0, 17):
        rest = np.delete(np.arange(30), left)
        plain = SklearnKernelRidge(alpha=0.1, kernel="precomputed")
        plain.fit(gram[np.ix_(rest, rest)], centred[rest])
        expected = plain.predict(gram[left, rest][None])[0] + labels.mean()
        assert outputs[0][left, 0] == pytest.approx(expected)


def test_the_trees_are_those_of_scikit_learn():
    values = np.random.default_rng(0)
    matrix = values.normal(size=(60, 4)).astype(np.float32)
    labels = (matrix[:, :1] + 0.3 * values.normal(size=(60, 1)) > 0).astype(float)
    learner = ExtraTrees(seed=3).learn(matrix[:40], labels[:40], Task(("press",)))
    plain = ExtraTreesClassifier(300, random_state=3).fit(matrix[:40], labels[:40, 0])
    np.testing.assert_allclose(learner.predict(matrix[40:])[:, 0], plain.predict_proba(matrix[40:])[:, 1])


def test_the_member_with_the_lower_held_out_loss_is_kept(tmp_path, capsys):
    data = TouchData(Presses(GESTURES), Readings)
    members = {"kernel_ridge": partial(KernelRidge), "extra_trees": FewTrees}
    learner = BestByCrossValidation(members, folds=4)
    learner.fit(data)
    best = min(learner.losses, key=learner.losses.get)
    assert capsys.readouterr().err.strip().endswith(f": {best}")
    path = learner.save(tmp_path)
    touches = data.touches("test")
    for other in (BestByCrossValidation(members), members[best]()):
        other.load(data, path)
        assert torch.equal(other.probabilities(touches), learner.probabilities(touches))
    with pytest.raises(InputError, match="learner=chosen has no member"):
        BestByCrossValidation({})


@pytest.mark.parametrize(("make", "other"), [(KernelRidge, FewTrees), (FewTrees, KernelRidge)])
def test_damaged_and_foreign_files_are_refused(make, other, tmp_path):
    data = TouchData(Presses(PLACE), Readings)
    learner = make()
    learner.fit(data)
    path = learner.save(tmp_path)
    with pytest.raises(ValueError, match=r"it does not hold \d models of this learner"):
        other().load(data, path)
    with pytest.raises(ValueError, match=r"it does not hold \d models of this learner"):
        make().load(TouchData(Presses(GESTURES), Readings), path)
    content = path.read_bytes()
    for damaged in (content[:-100], content[:200] + b"\0\1\2\3" + content[204:]):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"."):
            make().load(data, path)


@pytest.fixture(scope="module")
def learned():
    data = TouchData(Presses(PLACE), Readings)
    learners = {make: make() for make in (FewTrees, KernelRidge)}
    for learner in learners.values():
        learner.fit(data)
    return data, learners


@pytest.mark.parametrize(("make", "name", "change"), FORGED)
def test_forged_files_are_refused_before_they_are_used(make, name, change, learned, tmp_path):
    data, learners = learned
    path = tmp_path / "models.skops"
    models = learners[make].learned[0]
    dump([replace(model, **{name: change(getattr(model, name))}) for model in models], path)
    with pytest.raises((ValueError, TypeError, IndexError)):
        make().load(data, path)


@pytest.mark.parametrize("name", ["forest.npz", "kernel.npz", "features.npz", "chosen"])
def test_files_of_an_earlier_version_are_refused(name, learned, tmp_path):
    with pytest.raises(InputError, match=rf"^{name} was stored by an earlier version: train the run again"):
        FewTrees().load(learned[0], tmp_path / name)


def test_losses_leave_out_what_is_unknown():
    labels = np.array([[1.0, 0, 0, np.nan], [np.nan] * 4])
    losses = touch_losses(np.full((2, 4), 0.5), labels, TOUCH)
    assert losses.tolist() == pytest.approx([np.log(2), 0])
    position = np.array([[0.0, 1.0], [2.0, np.nan], [4.0, 3.0]])
    losses = touch_losses(np.nan_to_num(position) + 1, position, PLACE)
    assert losses[1] == pytest.approx(1 / np.var([0, 2, 4]))


def test_a_touch_from_the_first_frame_on_has_its_idle_level_at_its_end():
    """For 28 of 30 frames it lasts: a fifth of the window would be in contact."""
    source = torch.Generator().manual_seed(0)
    press = 2.0 * (torch.arange(30) < 28)[None, :, None] * torch.tensor([1.0, 0.4, 0.0])
    offsets = torch.tensor([0.3, -0.2, 0.1])
    readings = press + offsets + 0.01 * torch.randn(1, 30, 3, generator=source)
    touches = Touches(readings, torch.ones_like(readings).bool(), torch.zeros(3, 3), None, 10.0)
    torch.testing.assert_close(above_idle(touches), press, atol=0.05, rtol=0)

"""Gestures on the head of Epi: classes, and the labels of the report with few labelled touches or none."""

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.studies.real_rows import RealRow, RealSettings, exact_interval, result_line, spread
from skin.body.layout import Grid
from skin.device.base import Blank
from skin.device.conversion import convert_files
from skin.device.formats import read_format
from skin.device.recording import label_as
from skin.device.resampling import resample
from skin.device.touches import CLASS, Recording, Touches, one_hot
from skin.learning.few import ExtraTrees, KernelRidge, few_features, predict_held_out, touch_losses
from skin.runs.adaptation import Adaptation, FineTuning, fine_tune, learn_from_scratch
from skin.runs.build import build_data, build_learner, build_skin, default_option, with_skin
from skin.runs.configuration import Tracking
from skin.runs.finished_run import find_run
from skin.runs.store import Store
from skin.touch.labels import TOUCH, Task

LAST = 20  # touches of each class, for the test
BLOCKS = 5  # of the training touches of each class, in order of time
LABELLED, DRAWS = 48, 20
PLACEMENTS = 20
FRAMES, RATE = 30, 10.0  # Hz, of any_skin
MEMBERS = {"kernel ridge": KernelRidge, "extra trees": ExtraTrees}
LAYOUT = Grid(3, 4)
AUGMENT = {"shift": True, "reverse": True, "gain": 0.05, "noise": 0.02}  # of conf/adapt.yaml


def read_epi(row: RealRow, path: Path, settings: RealSettings) -> Recording:
    """Return the recording."""
    return convert_files(read_format(row.mapping), path)


def run_gestures(row: RealRow, recording: Recording, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Train on the first touches of each class, and test on its last ones."""
    names = recording.metadata["classes"]
    task, numbers = Task(tuple(names), "exclusive"), recording.parameters[CLASS].long().numpy()
    matrix, labels = (
        few_features(recording.touches, task),
        one_hot(recording.parameters[CLASS], len(names)).numpy(),
    )
    train, test, block = list[int](), list[int](), list[int]()
    for number in range(len(names)):
        rows = np.flatnonzero(numbers == number)
        train += rows[:-LAST].tolist()
        test += rows[-LAST:].tolist()
        block += (np.arange(len(rows) - LAST) * BLOCKS // (len(rows) - LAST)).tolist()
    losses = {
        name: touch_losses(
            predict_held_out(make, matrix[train], labels[train], task, np.array(block)), labels[train], task
        ).mean()
        for name, make in MEMBERS.items()
    }
    name = min(losses, key=lambda name: losses[name])
    learner = MEMBERS[name](settings.seed).learn(matrix[train], labels[train], task)
    right = learner.predict(matrix[test]).argmax(axis=1) == numbers[test]
    low, high = exact_interval(int(right.sum()), len(right))
    yield result_line(
        row,
        len(train),
        len(test),
        name,
        metric="accuracy",
        value=100 * float(right.mean()),
        low=100 * low,
        high=100 * high,
        over=row.over,
    )


class Shipped:
    """The pretrained model ``any_skin`` for twelve sensors.

    Nobody knows where the electrodes are: they are placed on a grid of the default skin.

    Attributes:
        learner: trained.
        data: with the representation, and the augmentation of ``skin adapt``.
        places: of the sensors, (12, 3), m.
    """

    def __init__(self) -> None:
        run = find_run(Store.existing(Tracking()), "any_skin")
        config = with_skin(run.stored, None, LAYOUT)
        assert config.data is not None
        config = replace(config, data=replace(config.data, augment=AUGMENT))
        skin = build_skin(config)
        self.places = torch.from_numpy(skin.sensors.positions).float()
        zeros = torch.zeros(1, FRAMES, len(self.places))
        example = Touches(zeros, zeros == 0, self.places, torch.zeros(1, len(TOUCH)), RATE)
        self.data, self.learner = (
            build_data(config, Blank(TOUCH, skin.body.size, example)),
            build_learner(config),
        )
        run.load_weights(self.learner, self.data)

    def touches(self, recording: Recording, order: np.ndarray) -> Touches:
        """Return the touches as the model needs them, with the electrodes in some order (S,)."""
        touches = label_as(recording.touches, recording.task, TOUCH)
        time = np.arange(touches.readings.shape[1]) / touches.rate
        all_readings = touches.readings.double().numpy()[:, :, order]
        valid, never = np.ones(all_readings.shape[1:], bool), np.zeros(all_readings.shape[1:], bool)
        windows = [
            resample(time, readings, valid, never, FRAMES / RATE, 1 / RATE, FRAMES).values
            for readings in all_readings
        ]
        readings = torch.from_numpy(np.stack(windows)).float()
        return Touches(readings, torch.ones_like(readings).bool(), self.places, touches.labels, RATE)


def balanced_accuracy(chances: np.ndarray, labels: np.ndarray) -> float:
    """Return the balanced accuracy of probabilities (B,) and labels (B,), NaN where unknown, per cent."""
    known = ~np.isnan(labels)
    said, truth = chances[known] > 0.5, labels[known] > 0.5
    return 50 * float(said[truth].mean() + (~said[~truth]).mean())


def run_shipped(row: RealRow, recording: Recording, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Predict the labels of all touches by the model as shipped, for several placements of the electrodes."""
    shipped, draw = Shipped(), np.random.default_rng(settings.seed)
    values = []
    for _ in range(PLACEMENTS):
        touches = shipped.touches(recording, draw.permutation(12))
        chances = shipped.learner.probabilities(touches).numpy()
        values.append(label_accuracies(recording, chances[:, _columns(recording.task)]))
    yield from _label_lines(row, np.array(values), recording, "any_skin", "none", "placements")


def _columns(task: Task) -> list[int]:
    return [TOUCH.names.index(name) for name in task.names]


def label_accuracies(recording: Recording, chances: np.ndarray) -> list[float]:
    """Return the balanced accuracy of each label for probabilities (B, L)."""
    labels = recording.touches.known_labels.numpy()
    return [balanced_accuracy(*pair) for pair in zip(chances.T, labels.T, strict=True)]


def _label_lines(
    row: RealRow, values: np.ndarray, recording: Recording, estimator: str, training: int | str, over: str
) -> Iterator[dict[str, Any]]:
    for number, name in enumerate(recording.task.names):
        goals = {"press": 99.9, "big": 96.5, "dynamic": 95.5} if row.goal is not None else {}
        tested = len(recording) - (training if isinstance(training, int) else 0)
        column = values[:, number]
        low, high = spread(column)
        yield result_line(
            replace(row, goal=goals.get(name)),
            training,
            tested,
            estimator,
            metric=f"balanced accuracy, {name}",
            value=float(column.mean()),
            low=low,
            high=high,
            over=over,
        )


def run_few(row: RealRow, recording: Recording, settings: RealSettings) -> Iterator[dict[str, Any]]:
    """Label a few touches, keep what is best on them as ``skin adapt`` does, and test on all others."""
    shipped, columns = Shipped(), _columns(recording.task)
    network, placed = shipped.learner.network, shipped.touches(recording, np.arange(12))
    weights = deepcopy(network.state_dict())
    options = {name: default_option("learner", name) for name in ("kernel_ridge", "extra_trees")}
    values, choices = dict[str, list[list[float]]](), list[str]()
    for number in range(max(2, round(DRAWS * settings.share))):
        order = np.random.default_rng([settings.seed, 7, number]).permutation(len(recording))
        few, others = torch.from_numpy(order[:LABELLED]), torch.from_numpy(order[LABELLED:])
        tuning = FineTuning(seed=number)
        network.load_state_dict(weights)
        adaptation = fine_tune(network, shipped.data, placed[few], tuning)
        trials, choice = adaptation.trials, adaptation.choice
        shown = Adaptation(trials, choice, adaptation.before[:, columns], adaptation.after[:, columns])
        labelled, tested = recording[few], recording[others]
        scratch = learn_from_scratch(labelled.touches, recording.task, shown, tuning, options)
        predicted = shipped.learner.probabilities(placed[others]).numpy()[:, columns]
        chances = {"any_skin, adapted": predicted}
        matrix, labels = few_features(labelled.touches, recording.task), labelled.touches.known_labels.numpy()
        for name, make in MEMBERS.items():
            fitted = make(number).learn(matrix, labels, recording.task)
            chances[name] = fitted.predict(few_features(tested.touches, recording.task))
        kept = "any_skin, adapted" if scratch is None else scratch.name.replace("_", " ")
        choices.append(kept)
        for name, predicted in {"chosen": chances[kept], **chances}.items():
            values.setdefault(name, []).append(label_accuracies(tested, predicted))
    often = "; ".join(f"{name} {choices.count(name)}" for name in sorted(set(choices)))
    for name, accuracies in values.items():
        shown_row = row if name == "chosen" else replace(row, goal=None)
        words = f"chosen: {often}" if name == "chosen" else name
        yield from _label_lines(shown_row, np.array(accuracies), recording, words, LABELLED, "draws")


_epi = partial(
    RealRow,
    path="humanoid-touch-classification",
    mapping="epi",
    unit="%",
    read=read_epi,
    higher=True,
    over="touches",
)
ROWS = (
    _epi(name="epi gestures", split="last 20 of each of 11 classes", goal=96.0, run=run_gestures),
    _epi(
        name="epi labels, as shipped",
        split="none: all touches, electrodes placed at random",
        goal=None,
        run=run_shipped,
    ),
    _epi(
        name="epi labels, 48 touches",
        split="48 touches drawn, tested on all others",
        goal=0.0,
        run=run_few,
    ),
)

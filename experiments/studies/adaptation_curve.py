"""Accuracy of a network after fine-tuning, beside models that are trained on the same gestures."""

from collections.abc import Mapping, Sequence
from copy import deepcopy
from typing import Any

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from experiments.studies.subject import Measurement, Subject
from skin.adaptation import FineTuning, fine_tune
from skin.build import build_data, build_learner
from skin.config import plain, validate_config
from skin.device.base import AbstractSimulated
from skin.evaluation.metrics import metrics
from skin.learner.base import AbstractLearner
from skin.settings import configured


def measure_adaptation(
    subject: Subject, rows: Sequence[str], epochs: int | None, adapt: Mapping[str, Any]
) -> Measurement:
    """Return the metrics ``zero_shot/…``, ``adapted/…`` and ``<row>/…`` on the test gestures of the device.

    The run is fine-tuned and the rows are trained on the training split of the device. The rows also use its
    validation split. ``adapted/changed`` is 1 if fine-tuning was better on held-out gestures, else 0.

    Args:
        subject: a run of a network on a simulated device.
        rows: names of experiments.
        epochs: of their trainings; None: those of the experiments.
        adapt: settings of the fine-tuning that differ from ``conf/adapt.yaml``.

    Raises:
        InputError: the run is no network, or the device is not simulated.
    """
    device = subject.device.simulated("gestures to adapt to are simulated")
    composed = compose("adapt")
    changes = {"seed": device.data_seed, **adapt}
    settings = configured(FineTuning, plain(composed)["adapt"] | changes, "adapt")
    config = OmegaConf.merge(subject.config, {"data": {"augment": composed.data.augment}})
    assert isinstance(config, DictConfig)
    learner = subject.learner
    found = _named("zero_shot", learner, device)
    original = deepcopy(learner.network.state_dict())
    try:
        data = build_data(validate_config(config), device)
        better = fine_tune(learner.network, data, device.touches("train"), settings).better
        found |= _named("adapted", learner, device) | {"adapted/changed": float(better)}
    finally:
        learner.network.load_state_dict(original)  # other conditions start from it
    for row in rows:
        found |= _named(row, _trained(row, device, epochs), device)
    return Measurement(found)


def _trained(row: str, device: AbstractSimulated, epochs: int | None) -> AbstractLearner:
    """Return the learner of a row, trained on a device."""
    line = [f"experiment={row}", f"seed={device.data_seed}"]
    config = validate_config(compose("train", line + ([f"trainer.max_epochs={epochs}"] if epochs else [])))
    learner = build_learner(config)
    learner.fit(build_data(config, device))
    return learner


def _named(model: str, learner: AbstractLearner, device: AbstractSimulated) -> dict[str, float]:
    """Return the metrics of a learner on the test gestures."""
    touches = device.touches("test")
    found = metrics(learner.probabilities(touches), touches.known_labels, device.task)
    return {f"{model}/{name}": value for name, value in found.items() if name.endswith("/accuracy")}

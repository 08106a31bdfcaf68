"""A finished training run that predicts, for scripts and for ``skin live``."""

import warnings
from dataclasses import dataclass

from mlflow.entities import Run
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from skin.build import build_data, build_device, build_learner, build_skin
from skin.config import Tracking, plain, validate_config
from skin.device.base import AbstractDevice
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point
from skin.learner.base import AbstractLearner
from skin.recording import Touches
from skin.settings import configured
from skin.skin_distribution import SkinDistribution
from skin.stored_run import find_run, load_configuration, load_learner, load_operating_point
from skin.tracking import Store


@dataclass(frozen=True)
class Trained:
    """A trained run.

    Attributes:
        device: of its training, or as its configuration was changed.
        learner: trained.
        window: T, frames.
        positions: (S, 3), m.
        rate: Hz.
        point: operating point of its alarm; None without the label ``dangerous``.
    """

    device: AbstractDevice
    learner: AbstractLearner
    window: int
    positions: Tensor
    rate: float
    point: OperatingPoint | None = None

    @property
    def labels(self) -> tuple[str, ...]:
        """The names of the columns of :meth:`predict`."""
        return tuple(self.device.task.names)

    def predict(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L), for touches of this window and rate.

        Raises:
            InputError: the touches do not fit the run.
        """
        return self.learner.probabilities(touches)


def load_run(name: str = "latest", uri: str | None = None, trust: bool = False) -> Trained:
    """Return a pretrained model or a finished training run.

    Args:
        name: of the model, or the beginning of the run's id; ``latest`` is the last run that finished.
        uri: of the runs, as MLflow takes it; None: ``mlflow.db`` in the current folder.
        trust: allow any class in its configuration, which may run any code.

    Raises:
        InputError: there is no such run, or it cannot be loaded.
    """
    store = Store.open(Tracking(uri, None, "skin", True, None))
    run = find_run(store, name)
    stored = load_configuration(store, run, trust)
    return load_trained(store, run, validate_config(stored), stored)


def load_trained(store: Store, run: Run, config: DictConfig, stored: DictConfig) -> Trained:
    """Load a finished run with its weights.

    Args:
        store: that holds the run.
        run: a finished training.
        config: its configuration, changed as :func:`skin.stored_run.apply_overrides` does.
        stored: its configuration without changes.

    Raises:
        InputError: its weights do not fit the configuration.
    """
    _warn_of_unknown_skin(stored, config)
    device, learner = build_device(config), build_learner(config)
    data = build_data(config, device.blank())
    load_learner(store, run, learner, data)
    known = data.example
    point = None if "skins" in config.device else choose_for_skin(learner, stored, config)
    point = point or load_operating_point(run, learner, stored, config.evaluation)
    return Trained(device, learner, known.readings.shape[1], known.positions, known.rate, point)


def choose_for_skin(
    learner: AbstractLearner, stored: DictConfig, config: DictConfig
) -> OperatingPoint | None:
    """Return an operating point for the skin of a configuration, for a run that was trained on drawn skins.

    Safe touches are more easily mistaken on some skins than on others, so the threshold that was chosen over
    all of them has another false-alarm rate on each. This one is chosen on fresh gestures on the skin, each
    measured by a device that is drawn as in training. None if the run was trained on one skin.

    Args:
        learner: of the run, trained.
        stored: its configuration.
        config: its configuration with the skin to use.
    """
    if "skins" not in stored.device:
        return None
    whole, here = plain(stored), plain(config)
    for group in ("body", "layout", "simulator"):
        whole[group] = whole["device"][group] = here[group]
    device = build_device(OmegaConf.create(whole)).reference
    assert device is not None
    return choose_operating_point(learner, device, config.evaluation)


def _warn_of_unknown_skin(stored: DictConfig, config: DictConfig) -> None:
    """Warn where a run that was trained on drawn skins is used on one that they do not include."""
    if (ranges := OmegaConf.select(stored, "device.skins")) is None:
        return
    distribution, skin = configured(SkinDistribution, plain(ranges), "device.skins"), build_skin(config)
    if outside := distribution.outside(skin.body, skin.sensors):
        warnings.warn(
            f"this skin is unlike those that the run was trained on: {', '.join(outside)}; its verdicts may "
            "be worse than the run's results",
            UserWarning,
            stacklevel=3,
        )

"""A finished training run that predicts, for scripts and for ``skin live``."""

import warnings
from dataclasses import dataclass
from typing import overload

import numpy as np
import torch
from hydra.errors import InstantiationException
from mlflow.entities import Run
from numpy.typing import ArrayLike
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from skin.body.base import AbstractBody
from skin.build import build_data, build_device, build_learner, build_skin
from skin.config import Tracking, plain, validate_config
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.error_messages import to_input_error
from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point
from skin.layout.base import AbstractLayout
from skin.learner.base import AbstractLearner
from skin.recording import Touches
from skin.run_overrides import profile_settings
from skin.settings import configured
from skin.skin_distribution import SkinDistribution
from skin.skin_settings import with_skin
from skin.stored_run import described, find_run, load_configuration, load_learner, load_operating_point
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

    @overload
    def predict(self, touches: Touches) -> Tensor: ...

    @overload
    def predict(self, touches: ArrayLike) -> np.ndarray: ...

    def predict(self, touches: Touches | ArrayLike) -> Tensor | np.ndarray:
        """Return the probability of each label, (B, L), for touches of this window and rate.

        Args:
            touches: B touches; or their readings, an array (B, T, S), N above the readings without touch, in
                the order of :attr:`positions`, with T = :attr:`window` frames at :attr:`rate`; or one window
                (T, S). NaN is an invalid reading.

        Returns:
            A tensor for touches. For an array, an array of float32; its shape is (L,) for one window.

        Raises:
            InputError: the touches do not fit the run.
        """
        if isinstance(touches, Touches):
            return self.learner.probabilities(touches)
        windows = self._windows(touches)
        if not windows.size:
            return np.empty((*windows.shape[:-2], len(self.labels)), np.float32)
        batch = torch.from_numpy(windows.reshape(-1, *windows.shape[-2:]))
        valid = ~batch.isnan()
        known = Touches(batch.nan_to_num(), valid, self.positions, None, self.rate)
        return self.learner.probabilities(known).numpy().reshape(*windows.shape[:-2], -1)

    def _windows(self, readings: ArrayLike) -> np.ndarray:
        """Return readings as (B, T, S) or (T, S), float32.

        Raises:
            InputError: they are no numbers, are infinite, or have another shape.
        """
        try:
            windows = np.array(readings, dtype=np.float32)
        except (TypeError, ValueError) as error:
            raise InputError(f"readings must be an array of numbers: {error}") from error
        frames, sensors = self.window, len(self.positions)
        if windows.ndim not in (2, 3) or windows.shape[-2:] != (frames, sensors):
            raise InputError(
                f"readings must be (B, {frames}, {sensors}) or ({frames}, {sensors}), windows of {frames} "
                f"frames at {self.rate:g} Hz of {sensors} sensors, got {windows.shape}"
            )
        if np.isinf(windows).any():
            raise InputError("readings must be finite: give NaN for an invalid reading")
        return windows


def load_run(
    name: str = "latest",
    uri: str | None = None,
    trust: bool = False,
    body: AbstractBody | str | None = None,
    layout: AbstractLayout | str | None = None,
) -> Trained:
    """Return a pretrained model or a finished training run.

    Args:
        name: of the model, or the beginning of the run's id; ``latest`` is the last run that finished.
        uri: of the runs, as MLflow takes it; None: ``mlflow.db`` in the current folder.
        trust: allow any class in its configuration, which may run any code.
        body: the body of the skin to use it on, such as :class:`skin.body.sheet.Sheet`, or the name of an
            option, such as ``arm``; None: that of the run.
        layout: the sensors of this skin: a layout such as :class:`skin.layout.grid.Grid`, the name of an
            option, or the path of a CSV file; None: those of the run.

    Raises:
        InputError: there is no such run, it cannot be loaded, or it does not fit the skin.
    """
    store = Store.existing(Tracking(uri, None, "skin", True, None))
    run = find_run(store, name)
    stored = load_configuration(store, run, trust)
    try:
        whole = with_skin(plain(stored), body, layout)
        return load_trained(store, run, validate_config(OmegaConf.create(whole)), stored)
    except InstantiationException as error:
        raise to_input_error(error) or error from error


def load_trained(
    store: Store, run: Run, config: DictConfig, stored: DictConfig, choose: bool = True
) -> Trained:
    """Load a finished run with its weights.

    Args:
        store: that holds the run.
        run: a finished training.
        config: its configuration, changed as :func:`skin.run_overrides.apply_overrides` does.
        stored: its configuration without changes.
        choose: the threshold of its alarm for single windows; False: it has none, or another is chosen.

    Raises:
        InputError: its weights do not fit the configuration.
    """
    _warn_of_unknown_skin(stored, config)
    with described(run):
        device, learner = build_device(config), build_learner(config)
        data = build_data(config, device.blank())
    load_learner(store, run, learner, data)
    known = data.example
    point = None
    if choose:
        point = None if "skins" in config.device else choose_for_skin(learner, stored, config)
        point = point or load_operating_point(run, learner, stored, config.evaluation)
    return Trained(device, learner, known.readings.shape[1], known.positions, known.rate, point)


def choose_for_skin(
    learner: AbstractLearner, stored: DictConfig, config: DictConfig
) -> OperatingPoint | None:
    """Return an operating point for the skin and the device of a configuration; None: the stored one holds.

    Safe touches are more easily mistaken on some skins and devices than on others, so a threshold that was
    chosen over many of them has another false-alarm rate on each. A run that was trained on drawn skins gets
    one for its skin, and every run one for ``evaluation.profile``.

    Args:
        learner: of the run, trained.
        stored: its configuration.
        config: its configuration with the skin to use.

    Raises:
        InputError: see :func:`threshold_device`.
    """
    known = OmegaConf.select(stored, "evaluation.profile")
    if "skins" not in stored.device and config.evaluation.profile == known:
        return None
    return choose_operating_point(learner, threshold_device(stored, config), config.evaluation)


def threshold_device(stored: DictConfig, config: DictConfig) -> AbstractSimulated:
    """Return the device whose fresh gestures determine the threshold of the alarm.

    It is the device of the training on the skin of ``config``. If ``evaluation.profile`` is set, every
    gesture is measured by another device of this profile.

    Args:
        stored: configuration of a training.
        config: the same with the skin to use.

    Raises:
        InputError: the training has no simulated touches, or there is no such profile.
    """
    whole, here, profile = plain(stored), plain(config), config.evaluation.profile
    if "simulator" not in whole["device"]:
        raise InputError(
            f"evaluation.profile={profile} chooses the alarm's threshold on simulated touches, and this run "
            "was trained on others: leave it out"
        )
    for group in ("body", "layout", "simulator"):
        whole[group] = whole["device"][group] = here[group]
    if profile is not None:
        whole["device"] |= profile_settings(profile)
        # Drawn skins draw a device for every gesture without being told.
        every = {} if "skins" in whole["device"] else {"randomise": True, "calibration": None}
        whole["device"] = {key: one for key, one in whole["device"].items() if key != "randomise"} | every
    device = build_device(OmegaConf.create(whole)).reference
    assert device is not None
    return device


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

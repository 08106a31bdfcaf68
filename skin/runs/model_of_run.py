"""The model of a finished run: it predicts, evaluates and raises the alarm on the skin that it is used on."""

import logging
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, fields, replace
from functools import cached_property
from math import log
from pathlib import Path
from typing import Any, overload

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import InstantiationException
from numpy.typing import ArrayLike
from omegaconf import OmegaConf
from torch import Tensor

from skin import __version__
from skin.body.base import AbstractBody
from skin.body.layout import AbstractLayout
from skin.core import array_cache
from skin.core.files import CONF
from skin.core.messages import Steps, to_input_error
from skin.core.settings import configured
from skin.device import imperfection, sampling
from skin.device.base import AbstractDevice, AbstractSimulated
from skin.device.calibration import Calibration, read_calibration
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation import decisions, operating_point
from skin.evaluation.operating_point import (
    DANGEROUS_TOUCHES,
    LABEL,
    ContactThreshold,
    OperatingPoint,
    Predictor,
    Watching,
    choose_for_touches,
    choose_operating_point,
    rise,
)
from skin.evaluation.settings import Evaluation, check_evaluation
from skin.learning.learner import AbstractLearner
from skin.runs.build import build_data, build_device, build_learner, build_skin, with_skin
from skin.runs.configuration import Config, Tracking
from skin.runs.exported_model import ExportedModel, ModelMetadata
from skin.runs.finished_run import FinishedRun, find_run
from skin.runs.store import Store
from skin.runs.trained_model import TrainedModel

_RATIOS = (1, 2, 3, 5, 7, 10, 15, 20, 30, 50, 70, 100)  # of the rate of a device to that of the model
_USUAL = "mild"
_EVERY = {"without_lag": 0.0, "framed": 0.0}  # every device is as described, whatever the training mixed in
_DEVICE = "device"  # in place of a profile: the imperfections of the device that is evaluated
_FAINT = 0.3  # N, default contact threshold
_MANY = 4000  # windows of streams, a tenth of which tunes the contact threshold
_EXPECTED = 20.0  # s
_SOURCES = (operating_point, decisions, imperfection, sampling)  # of the thresholds that are kept on disk
_log = logging.getLogger(__name__)


# Which threshold of the alarm holds for a run on a skin and a device. That for single windows is stored
# with the run. That of the live view, which judges many windows of a touch, depends on the rate, too.


def alarm_point(
    run: FinishedRun,
    learner: Predictor,
    config: Config,
    one_skin: bool = False,
    device: AbstractDevice | None = None,
) -> OperatingPoint | None:
    """Return the operating point of a run for single windows; None if its task has no label ``dangerous``.

    Safe touches are more easily mistaken on some skins and devices than on others, so a threshold that was
    chosen over many of them has another false-alarm rate on each. A run that was trained on drawn skins gets
    one for its skin, and every run one for ``evaluation.profile``. Otherwise the stored one holds.

    Args:
        run: the run.
        learner: of the run, trained.
        config: its configuration with the skin to use.
        one_skin: the skin of ``config`` counts even if its device draws others.
        device: on which another threshold is chosen; None: that of :func:`threshold_device`.

    Raises:
        InputError: the stored operating point cannot be read, or a profile is set and the device draws many
            skins; see also :func:`threshold_device`.
    """
    settings, stored = check_evaluation(config.evaluation), run.stored
    all_skins = "skins" in config.device and not one_skin
    if all_skins and settings.profile is not None:
        raise InputError("evaluation.profile chooses the threshold for one skin: add device=simulated")
    same_profile = settings.profile == (stored.evaluation and stored.evaluation.profile)
    if all_skins or ("skins" not in stored.device and same_profile):
        return stored_point(run, learner, settings)
    return choose_operating_point(learner, device or threshold_device(stored, config), settings)


def stored_point(run: FinishedRun, learner: Predictor, settings: Evaluation) -> OperatingPoint | None:
    """Return the operating point that is stored with a run; None if its task has no label ``dangerous``.

    If the run has none for the target rate, it is chosen now if the device of its training draws fresh
    gestures; else the threshold is 0.5. Both cases are reported on standard error.

    Args:
        run: the run.
        learner: of the run, trained.
        settings: the target rate and the number of safe gestures.

    Raises:
        InputError: the stored operating point cannot be read.
    """
    point, target = run.point, settings.false_alarm_rate
    if run.stores_point and (point is None or point.target == target):
        return point
    lacks = f"run {run.identity} stores no alarm threshold for {100 * target:g} % false alarms"
    if "simulator" in run.stored.device:
        point = choose_operating_point(learner, build_device(run.stored), settings)
        message = None if point is None else f"{lacks}, it is chosen now: {point.sentence()}"
    else:
        point = point or OperatingPoint.default(target)
        message = (
            f"{lacks} and its device draws no fresh gestures: {point.sentence()}; train it again to store one"
        )
    if message:
        _log.warning(message)
    return point


def threshold_device(stored: Config, config: Config) -> AbstractSimulated:
    """Return the device whose fresh gestures determine the threshold of the alarm.

    It is the device of the training on the skin of ``config``. If ``evaluation.profile`` is set, every
    gesture is measured by another device of this profile, sampled as by the simulated device of ``config``;
    ``device``: with its imperfections.

    Args:
        stored: configuration of a training.
        config: the same with the skin to use.

    Raises:
        InputError: the training has no simulated touches, or there is no such profile.
    """
    profile, settings = check_evaluation(config.evaluation).profile, stored.device
    if "simulator" not in settings:
        raise InputError(
            f"evaluation.profile={profile} chooses the alarm's threshold on simulated touches, and this run "
            "was trained on others: leave it out"
        )
    skin = {group: getattr(config, group) for group in ("body", "layout", "simulator")}
    settings = settings | skin
    if profile is not None:
        sampled = {name: config.device[name] for name in ("rate", "aligned") if name in config.device}
        settings |= _EVERY | (
            _evaluated(config) if profile == _DEVICE else sampled | profile_settings(profile)
        )
        # Drawn skins draw a device for every gesture without being told.
        every = {} if "skins" in settings else {"randomise": True, "calibration": None}
        settings = {name: value for name, value in settings.items() if name != "randomise"} | every
    device = build_device(replace(stored, **skin, device=settings)).reference
    assert device is not None
    return device


def alarm_point_for_touches(
    run: FinishedRun,
    learner: Predictor,
    config: Config,
    watching: Watching,
    say: Callable[[str], None],
) -> OperatingPoint:
    """Return the operating point of a run for safe touches as the live view judges them; it is kept on disk.

    Args:
        run: the run; its task has the label ``dangerous``.
        learner: of the run, trained.
        config: its configuration with the skin, the device and the profile to use; without a profile, a run
            trained on drawn skins takes ``mild``.
        watching: how the device is watched.
        say: called with each message for the user.

    Raises:
        InputError: there is no such profile, or the calibration cannot be read.
    """
    settings = check_evaluation(config.evaluation)
    if "simulator" not in run.stored.device:
        point = stored_point(run, learner, settings)
        assert point is not None  # it has the label
        return point
    path = config.device.get("calibration") if config.device.get("port") else None
    if settings.profile is None and path is None and "skins" in run.stored.device:
        # Such trainings have devices so different that a threshold for all of them hides dangerous touches.
        settings = replace(settings, profile=_USUAL)
        config = replace(config, evaluation=settings)
    device = threshold_device(run.stored, config)
    calibration = read_calibration(path) if path and settings.profile is None else None
    if calibration is not None:
        device = device.replace(**_remaining(calibration), randomise=True, calibration=None)
    target, count = settings.false_alarm_rate, min(settings.safe_gestures, operating_point.SAFE_TOUCHES)
    content = {
        "run": run.identity,
        "device": run.stored.device,
        "skin": {group: getattr(config, group) for group in ("body", "layout", "simulator", "touch")},
        "positions": device.sensors.positions.round(9).tolist(),
        "imperfections": {name: str(value) for name, value in vars(device.imperfection).items()},
        "watching": asdict(watching),
        "target": target,
        "count": count,
    }
    key = array_cache.hashed(content, [Path(str(module.__file__)) for module in _SOURCES])

    def choose() -> dict[str, np.ndarray]:
        devices = "" if settings.profile is None else f" and devices of the profile {settings.profile}"
        say(f"choosing the alarm's threshold on {count} safe touches at {watching.rate:.3g} Hz{devices}")
        with Steps({"choosing the threshold of the alarm": _EXPECTED}) as steps:
            counts = count, DANGEROUS_TOUCHES
            # More threads than free cores take many times as long.
            report = lambda done: setattr(steps, "share", done / sum(counts))  # noqa: E731
            point = choose_for_touches(learner, device, watching, target, *counts, report)
        return {"point": np.array([point.threshold, point.raised, point.dangerous, point.found])}

    file = array_cache.folder(None) / f"threshold_{key[:16]}.npz"
    threshold, *counts = array_cache.kept(file, key, {"point": (4,)}, choose)["point"].tolist()
    raised, dangerous, found = (int(number) for number in counts)
    return OperatingPoint(threshold, target, count, raised, device.data_seed, dangerous, found, watching.rate)


def _remaining(calibration: Calibration) -> dict[str, Any]:
    """Return the imperfections that a calibrated device is left with: its gains are known to 2 %.

    Readings are linear after the conversion: the limit is that of the force, and the noise is that at the
    reading at which the curves meet.
    """
    values, curves = calibration.values(), calibration.curves
    if curves is not None:
        values |= {"clip": curves.straighten(values["clip"]), "noise": values["noise"] / curves.slopes}
    names = ("noise", "hysteresis", "time_constant")
    left = {name: float(np.median(values[name])) for name in names}
    clip = float(np.median(values["clip"]))
    limit = {"clip": clip} if np.isfinite(clip) else {}
    return _EVERY | left | limit | {"gain_spread": 0.02, "dead": 0, "tare": True}


def _evaluated(config: Config) -> dict[str, Any]:
    """Return the imperfections of the simulated device that a run is evaluated on.

    Raises:
        InputError: the device is not simulated.
    """
    names = {entry.name for entry in fields(imperfection.ImperfectionSettings)}
    if not names <= set(config.device):
        raise InputError(
            f"evaluation.profile={_DEVICE} takes the imperfections of a simulated device: add "
            "device=simulated, or name a profile"
        )
    return {name: config.device[name] for name in names}


def profile_settings(name: str) -> dict[str, Any]:
    """Return the settings of the device in a profile (``conf/profile/``).

    Raises:
        InputError: there is no such profile.
    """
    if not GlobalHydra.instance().is_initialized():  # from Python
        with initialize_config_dir(str(CONF), version_base="1.3"):
            return profile_settings(name)
    loader = GlobalHydra.instance().config_loader()
    names = loader.get_group_options("profile")
    if name not in names:
        raise InputError(f"there is no profile {name}: choose one of {', '.join(names)}, or {_DEVICE}")
    return OmegaConf.to_container(compose(f"profile/{name}").device, resolve=True)  # type: ignore[return-value]


# The model.


class RunModel(TrainedModel):
    """The model of a run.

    Args:
        device: of its training, or as its configuration was changed.
        learner: trained.
        example: touches of its window, rate and sensors.
        point: operating point of its alarm for single windows; None: not chosen, or no label ``dangerous``.
        touch: contact threshold, N; None: tuned on simulated streams of the device, and the learned label
            ``touch`` counts, too.
        run: the run; None: it was trained in this process.
        watched: configuration of the run with the skin, the device and the profile that it is used on.

    Attributes:
        device, learner, point, run, config: as above; ``config`` is ``watched``.
        places: :attr:`positions` as a tensor.
    """

    def __init__(
        self,
        device: AbstractDevice,
        learner: AbstractLearner,
        example: Touches,
        point: OperatingPoint | None = None,
        touch: float | None = None,
        run: FinishedRun | None = None,
        watched: Config | None = None,
    ) -> None:
        self.device, self.learner, self.point, self.run, self.config = device, learner, point, run, watched
        self.identity, self.title = ("none", "untrained") if run is None else (run.identity, run.title)
        self.task, self.size = device.task, device.size
        self.window, self.rate = example.readings.shape[1], example.rate
        self.places, self.positions = example.positions, example.positions.numpy()
        self.threshold = None if point is None else point.threshold
        self._touch = touch

    @property
    def learned(self) -> bool:
        """Whether the label ``touch`` counts as touch, too."""
        return self._touch is None and self.task.gate is not None

    @cached_property
    def contact(self) -> float:
        """N above the baseline that count as touch.

        Raises:
            InputError: it is neither given nor learned and the device has no streams to tune it on.
        """
        if self._touch is not None:
            return self._touch
        if self.device.reference is None:
            if self.learned:
                return _FAINT
            raise InputError(
                "this run has no contact threshold: give live.touch=0.3 (N), or train on streams"
            )
        streams = self.device.reference.replace(stream=True, direction=False, tare=True, gestures=_MANY)
        touches = streams.touches("validation")
        return ContactThreshold.tuned(rise(touches), touches.known_labels[:, -1] > 0.5).least

    @property
    def longest(self) -> float:
        """Longest touch of the training, s; two thirds of the window if unknown."""
        if self.device.reference is not None:
            return self.device.reference.sampler.settings.press[1]
        return self.window * 2 / 3 / self.rate

    @cached_property
    def presses(self) -> np.ndarray | None:
        """Readings of a press at the limit of ``dangerous`` on each sensor, (S, S), N; None: unknown."""
        reference = self.device.reference
        return None if reference is None else reference.press_readings().double().numpy()

    @overload
    def predict(self, readings: Touches) -> Tensor: ...

    @overload
    def predict(self, readings: ArrayLike) -> np.ndarray: ...

    def predict(self, readings: Touches | ArrayLike) -> Tensor | np.ndarray:
        """Return the probability of each label, (B, L), for touches of this window and rate.

        Args:
            readings: B touches, which may have other sensors; or an array as in
                :meth:`skin.runs.trained_model.TrainedModel.predict`.

        Returns:
            A tensor for touches, else an array.

        Raises:
            InputError: the touches do not fit the run.
        """
        return (
            self.learner.probabilities(readings)
            if isinstance(readings, Touches)
            else super().predict(readings)
        )

    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), for readings (B, T, S), N, and their validity."""
        return window_classifier(self.learner, self.places, self.rate)(readings, valid)

    def watching(self, rate: float, patience: float, aligned: bool) -> Watching:
        """Return how a live view watches a device.

        Args:
            rate: of the device, Hz; the nearest of some rates is used.
            patience: s for which decisions must be dangerous.
            aligned: whether the device gives the frames of the model.
        """
        # A measured rate is never the same twice, and the threshold would be chosen anew at each start.
        ratio = min(_RATIOS, key=lambda ratio: abs(log(ratio * self.rate / rate)))
        column = self.task.names.index(LABEL)
        return Watching(ratio * self.rate, self.contact, self.longest, patience, column, aligned)

    def point_at(
        self, rate: float, patience: float, aligned: bool, say: Callable[[str], None]
    ) -> OperatingPoint | None:
        """Return the operating point of the live view, chosen on safe touches of this skin and device.

        Args:
            rate, patience, aligned, say: as in :meth:`threshold_at`.
        """
        if not self.alarms or self.run is None or self.config is None:
            return self.point
        watching = self.watching(rate, patience, aligned)
        return alarm_point_for_touches(self.run, self.learner, self.config, watching, say)

    def threshold_at(
        self, rate: float, patience: float, aligned: bool, say: Callable[[str], None]
    ) -> float | None:
        """Return the threshold of :meth:`point_at`, which is announced."""
        point = self.point_at(rate, patience, aligned, say)
        if point is None:
            return None
        if point.useless:
            raise InputError(
                f"{point.warning()}: train with more gestures, or give a lower threshold, which has more "
                f"false alarms, such as live.patience.above={min(point.threshold, 1.0) / 2:.1g}"
            )
        say(point.sentence())
        return point.threshold

    def describe(self, thresholds: Mapping[str, float] | None = None) -> ModelMetadata:
        """Return the description of the model for an exported file.

        Args:
            thresholds: rate of a device, Hz -> threshold of the alarm; None: :attr:`threshold` only.

        Raises:
            InputError: as of :attr:`contact`; or the model estimates targets.
        """
        if self.task.kind == "regression":
            raise InputError(
                f"{self.title} estimates {', '.join(self.task.names)}, and no labels: skin export "
                "writes models of labels or classes"
            )
        return ModelMetadata(
            run=self.identity,
            title=self.title,
            version=__version__,
            labels=list(self.task.names),
            kind=self.task.kind,
            gate=self.task.gate,
            direction=self.task.direction,
            rate=self.rate,
            window=self.window,
            positions=self.positions.tolist(),
            size=self.size,
            saturation=None if self.device.reference is None else self.device.reference.imperfection.clip,
            threshold=self.threshold,
            contact=self.contact,
            learned=self.learned,
            longest=self.longest,
            thresholds=dict(thresholds) if thresholds else None,
            presses=None if self.presses is None else self.presses.round(4).tolist(),
        )


def window_classifier(
    learner: Predictor, positions: Tensor, rate: float
) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Return a function of the readings and validity of windows that asks a learner.

    Args:
        learner: trained.
        positions: (S, 3), m.
        rate: Hz.
    """

    @torch.inference_mode()
    def classify(readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        windows = torch.from_numpy(readings), torch.from_numpy(valid)
        return learner.probabilities(Touches(*windows, positions, None, rate)).numpy()

    return classify


def load_run(
    name: str = "latest",
    uri: str | None = None,
    trust: bool = False,
    body: AbstractBody | str | None = None,
    layout: AbstractLayout | str | None = None,
) -> TrainedModel:
    """Return the model of a finished training run, a pretrained model, or a file of ``skin export``.

    Args:
        name: of the model, the beginning of the run's id, or the path of an ONNX file; ``latest`` is the last
            run that finished.
        uri: of the runs, as MLflow takes it; None: ``mlflow.db`` in the current folder.
        trust: allow any class in its configuration, which may run any code.
        body: the body of the skin to use it on, such as :class:`skin.body.base.Sheet`, or the name of an
            option, such as ``arm``; None: that of the run.
        layout: the sensors of this skin: a layout such as :class:`skin.body.layout.Grid`, the name of an
            option, or the path of a CSV file; None: those of the run.

    Raises:
        InputError: there is no such run, it cannot be loaded, or it does not fit the skin.
    """
    if name.endswith(".onnx"):
        if body is not None or layout is not None:
            raise InputError(f"{name} is a network for one skin: leave out body and layout")
        return ExportedModel(name)
    run = find_run(Store.existing(Tracking(uri)), name, trust)
    try:
        return load_model(run, with_skin(run.stored, body, layout))
    except InstantiationException as error:
        raise to_input_error(error) or error from error


def load_model(
    run: FinishedRun,
    config: Config | None = None,
    watched: Config | None = None,
    device: AbstractDevice | None = None,
    touch: float | None = None,
    one_skin: bool = False,
    alarm: bool = True,
) -> RunModel:
    """Return the model of a finished run.

    Args:
        run: the run.
        config: its configuration, changed as :meth:`FinishedRun.configured` does; None: not changed.
        watched: its configuration with the device that a live view watches; None: ``config``.
        device: to use it on; None: that of ``config``.
        touch: as in :class:`RunModel`.
        one_skin: as in :func:`alarm_point`.
        alarm: choose the threshold of the alarm for single windows; False: it has none.

    Raises:
        InputError: its weights do not fit the configuration.
    """
    config = config or run.stored
    if device is None:
        _warn_of_unknown_skin(run.stored, config)
    with run.described():
        device = device or _with_labels(run.stored, build_device(config))
        learner = build_learner(config)
        data = build_data(config, device.blank())
    run.load_weights(learner, data)
    point = alarm_point(run, learner, config, one_skin) if alarm else None
    return RunModel(device, learner, data.example, point, touch, run, watched or config)


def _with_labels(stored: Config, device: AbstractDevice) -> AbstractDevice:
    """Return a device whose recorded touches have the labels of a run."""
    if device.real or device.reference is not None:
        return device
    try:
        task = build_device(stored).task
    except InputError:  # the recording of its training is gone
        return device
    return device.with_labels(task)


def _warn_of_unknown_skin(stored: Config, config: Config) -> None:
    """Warn where a run that was trained on drawn skins is used on others than those."""
    if (distributed := stored.device.get("skins")) is None:
        return
    from skin.device.calibration import read_calibration
    from skin.device.imperfection import outside
    from skin.device.skins import SkinDistribution

    distribution, skin = configured(SkinDistribution, distributed, "device.skins"), build_skin(config)
    unlike = distribution.outside(skin.body, skin.sensors)
    if "skins" not in config.device:
        path = config.device.get("calibration")
        measured = {} if path is None else read_calibration(path).values()
        ranges = {name: (values.min(), values.max()) for name, values in measured.items()}
        unlike += outside(config.device | ranges, stored.device)
    if unlike:
        warnings.warn(
            f"this skin is unlike those that the run was trained on: {', '.join(unlike)}; its verdicts may "
            "be worse than the run's results",
            UserWarning,
            stacklevel=3,
        )


def equation10_warning(stored: Config, device: AbstractDevice | None = None) -> str | None:
    """Return a warning if a run trained with equation 10 is used on a real skin; else None.

    Args:
        stored: the run's configuration.
        device: the watched device; None: a real skin.
    """
    reading = (stored.device.get("simulator") or {}).get("reading")
    if reading != "equation10" or (device is not None and not device.real):
        return None
    return (
        "warning: this run learned from simulator=fem and equation 10, which does not carry over to other "
        "mechanics (docs/results.md): train one with simulator=solid for a real skin"
    )

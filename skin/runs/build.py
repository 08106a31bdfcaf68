"""Build the objects that a configuration names, and the model of a finished run."""

import json
import warnings
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property, partial
from inspect import signature
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from hydra.errors import HydraException, InstantiationException
from hydra.utils import instantiate
from omegaconf import OmegaConf
from torch import Tensor

from skin import __version__
from skin.body.base import AbstractBody, Sensors, check_plausibility, warn_of_surface
from skin.body.layout import AbstractLayout, Listed
from skin.core.files import CONF
from skin.core.messages import one_line, to_input_error
from skin.core.settings import check_groups, configured
from skin.device.base import AbstractDevice
from skin.device.resampling import INWARDS
from skin.device.touches import Touches
from skin.errors import InputError
from skin.evaluation.alarm import AlarmSource, choose_alarm_threshold
from skin.evaluation.operating_point import OperatingPoint, Predictor
from skin.evaluation.streams import ContactThreshold, rise
from skin.learning.data import Augmentation, TouchData
from skin.learning.learner import AbstractLearner
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.configuration import Config, Tracking, iterate_leaves, name_option, validate_config
from skin.runs.model import Model, ModelMetadata, OnnxModel
from skin.runs.run import TAG, FinishedRun, find_run

_FAINT = 0.3  # N, default contact threshold
_MANY = 400  # windows of streams that tune the contact threshold


@dataclass(frozen=True)
class SkinModel:
    """A body with sensors and a simulator, without touches.

    Attributes:
        body: the body.
        layout: the layout of the sensors.
        sensors: those of the layout in the body.
        simulator: ``simulator(body, sensors)``.
    """

    body: AbstractBody
    layout: AbstractLayout
    sensors: Sensors
    simulator: Callable[[AbstractBody, Sensors], AbstractSimulator]


def build_skin(config: Config) -> SkinModel:
    """Return the body, the sensors and the simulator."""
    body, layout = _build_body(vars(config), "simulator")
    return SkinModel(body, layout, layout.sensors(body), instantiate(config.simulator))


def _build_body(groups: Mapping[str, Any], source: str) -> tuple[AbstractBody, AbstractLayout]:
    """Check body, layout and the group of what responds to touches; return the first two."""
    _check_options({name: groups[name] for name in ("body", "layout", source)})
    check_plausibility(groups)
    return instantiate(groups["body"]), instantiate(groups["layout"])


def _check_options(groups: Mapping[str, Any]) -> None:
    """Raise InputError where a group names no option, or has settings that its option does not take."""
    for name, group in groups.items():
        name_option(group, name)
    check_groups(groups)


def build_device(config: Config) -> AbstractDevice:
    """Return the device, with its body, layout and, if it has one, its simulator."""
    body, layout = _build_body(vars(config), "device")
    if config.task is not None and "task" not in config.device:
        raise InputError(f"task={config.task} needs device=recording device.path=FILE.parquet")
    # Not arguments of instantiate, which would treat the dataclass of the body as a configuration.
    device: AbstractDevice = instantiate(config.device, _partial_=True)(body=body, layout=layout)
    if device.simulation is not None and device.simulation.model.mechanical:
        warn_of_surface(body, device.simulation.sensors)
    return device


def build_frames(
    representation: Mapping[str, Any],
    device: AbstractDevice,
    make_skin: Callable[[], SkinModel],
    **training: Any,
) -> TouchData:
    """Return what makes the frames of touches in a representation: enough to predict.

    Args:
        representation: its settings.
        device: of the touches.
        make_skin: returns the skin of the device, where a representation needs its geometry.
        training: further arguments of :class:`skin.learning.data.TouchData`.
    """
    _check_options({"representation": representation})
    # Not a local function: processes that train together pickle it.
    geometry = partial(_measure_geometry, make_skin) if device.configured else None
    return TouchData(device, instantiate(representation), geometry=geometry, **training)


def _measure_geometry(make_skin: Callable[[], SkinModel]) -> Tensor:
    """Return what the sensors of a skin respond to, (S, G)."""
    from skin.mechanics.geometry import sensor_geometry

    skin = make_skin()
    return sensor_geometry(skin.body, skin.sensors, skin.simulator(skin.body, skin.sensors))


def build_data(config: Config, device: AbstractDevice) -> TouchData:
    """Return the data of a device's touches in the configured representation."""
    assert config.data is not None
    return build_frames(
        config.representation,
        device,
        partial(build_skin, config),
        batch_size=config.data.batch_size,
        seed=config.seed,
        augmentation=configured(Augmentation, config.data.augment, "data.augment"),
    )


def training_data(settings: Mapping[str, Any] | None = None, /, **groups: Any) -> TouchData:
    """Return the data of a training, for a loop of your own or a Trainer; nothing is simulated yet.

    A pass over ``train_dataloader()`` is an epoch, and yields (:class:`skin.learning.representation.Frames`,
    labels (B, L)). Passes of equal number are equal where the seeds are.

    Args:
        settings: as on the command line of ``skin train``, such as ``{"data.gestures": 400}``.
        groups: the option of a group by its name, as in ``simulator="solid"``, or settings of a group, as in
            ``data={"fresh": True}``.

    Raises:
        InputError: there is no such group, option or setting, or it has another value.
    """
    words = [
        f"{'.'.join(path)}={json.dumps(value, default=str)}"
        for path, value in iterate_leaves({**(settings or {}), **groups})
    ]
    try:
        with initialize_config_dir(str(CONF), version_base="1.3"):
            config = validate_config(compose("train", words))
        return build_data(config, build_device(config))
    except (HydraException, ValueError) as error:  # ValueError: of a group that is None
        raise to_input_error(error) or InputError(one_line(error)) from error


def build_learner(config: Config) -> AbstractLearner:
    """Return an untrained learner."""
    _check_options({"learner": config.learner})
    return instantiate(config.learner, seed=config.seed)


# The settings of a skin that was built in Python.


def with_skin(config: Config, body: AbstractBody | str | None, layout: AbstractLayout | str | None) -> Config:
    """Return the configuration of a run with another body or layout.

    Args:
        config: of the run.
        body: the body, the name of an option (``arm``), or None for that of the settings.
        layout: the layout, the name of an option (``grid``), the path of a CSV file, or None.

    Raises:
        InputError: there is no such option or file, or a sensor lies outside the body.
    """
    if body is not None:
        settings = default_option("body", body) if isinstance(body, str) else _body_settings(body)
        config = replace(config, body=settings)
    if isinstance(layout, str):
        file = {"path": layout} if layout.lower().endswith(".csv") else {}
        return replace(config, layout=default_option("layout", "file" if file else layout) | file)
    if layout is not None:
        check_groups({"body": config.body})
        return replace(config, layout=_listed_settings(layout, instantiate(config.body)))
    return config


def _body_settings(body: AbstractBody) -> dict[str, Any]:
    """Return the settings of a body: the arguments that it was built from."""
    if not isinstance(body, AbstractBody):
        raise InputError(f"body must be a body such as skin.Sheet, or the name of one, got {body!r}")
    settings = {name: asdict(body)[name] for name in signature(type(body)).parameters}
    return _option_settings(type(body)) | settings


def _listed_settings(layout: AbstractLayout, body: AbstractBody) -> dict[str, Any]:
    """Return settings for the sensors that a layout has in a body."""
    if not isinstance(layout, AbstractLayout):
        raise InputError(f"layout must be a layout such as skin.Grid, a name or a CSV file, got {layout!r}")
    sensors = layout.sensors(body)
    normals, positions = sensors.normals.tolist(), sensors.positions.tolist()
    listed = {"positions": positions, "footprint": list(sensors.footprint), "normals": normals}
    listed |= {"directions": sensors.measured.tolist()} if sensors.axes > 1 else {}
    return _option_settings(Listed) | listed


def _option_settings(option: type) -> dict[str, Any]:
    """Return the settings by which Hydra builds an option."""
    return {"_target_": f"{option.__module__}.{option.__qualname__}", "_convert_": "all"}


def default_option(group: str, name: str) -> dict[str, Any]:
    """Return the default settings of an option.

    Raises:
        InputError: there is no such option.
    """
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    if name not in options:
        raise InputError(f"there is no {group} {name}: give one of {', '.join(options)}, or build one")
    return OmegaConf.to_container(OmegaConf.load(CONF / group / f"{name}.yaml"))  # type: ignore[return-value]


# Where the alarm of a run is raised.


def alarm_source(run: FinishedRun, learner: Predictor, used: Config) -> AlarmSource:
    """Return what decides where a run raises the alarm.

    Args:
        run: the run.
        learner: of the run, trained.
        used: its configuration with the skin and the device to use.
    """
    stored = run.stored
    skin = {group: getattr(used, group) for group in ("body", "layout", "simulator", "touch")}
    return AlarmSource(
        f"run {run.identity}",
        used.evaluation,
        learner,
        stored.device,
        used.device,
        skin,
        device_on_skin(stored, skin),
        partial(build_device, stored),
        stored=run.run.data.tags.get(TAG),
        profile=None if stored.evaluation is None else stored.evaluation.profile,
        weights=getattr(run.run.info, "weights", None),  # of a pretrained model
    )


def device_on_skin(trained: Config, skin: Mapping[str, Any]) -> Callable[[Mapping[str, Any]], AbstractDevice]:
    """Return a function of the settings of a device that builds it on a skin; it can be sent to a process.

    Args:
        trained: configuration of the training.
        skin: settings of ``body``, ``layout`` and ``simulator``.
    """
    return partial(_build_on_skin, trained, {group: skin[group] for group in ("body", "layout", "simulator")})


def _build_on_skin(trained: Config, skin: Mapping[str, Any], device: Mapping[str, Any]) -> AbstractDevice:
    return build_device(replace(trained, **skin, device={**device, **skin}))


# The model of a run.


class TorchModel(Model):
    """The model of a run.

    Args:
        device: of its training, or as its configuration was changed.
        learner: trained.
        example: touches of its window, rate and sensors.
        point: operating point of its alarm for single windows; None: not chosen, or no label ``dangerous``.
        touch: contact threshold, N; None: tuned on simulated streams of the device, and the learned label
            ``touch`` counts, too.
        run: the run; None: it was trained in this process.
        used: configuration of the run with the skin, the device and the profile that it is used on.

    Attributes:
        device, learner, point, run, config: as above; ``config`` is ``used``.
        sites: :attr:`positions` as a tensor.
    """

    def __init__(
        self,
        device: AbstractDevice,
        learner: AbstractLearner,
        example: Touches,
        point: OperatingPoint | None = None,
        touch: float | None = None,
        run: FinishedRun | None = None,
        used: Config | None = None,
    ) -> None:
        self.device, self.learner, self.point, self.run, self.config = device, learner, point, run, used
        self.sites, threshold = example.positions, None if point is None else point.threshold
        identity, title = ("none", "untrained") if run is None else (run.identity, run.title)
        alarm = AlarmSource(title) if run is None or used is None else alarm_source(run, learner, used)
        super().__init__(
            identity,
            title,
            device.task,
            example.readings.shape[1],
            example.rate,
            # What a process gets is moved to shared memory: a view would then read freed memory.
            self.sites.numpy().copy(),
            device.size,
            threshold,
            alarm,
        )
        self.learned, self._touch = touch is None and self.task.gate is not None, touch

    @cached_property
    def contact(self) -> float:  # type: ignore[override]
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
        streams = self.device.reference.replace(stream=True, direction=False, tare=True)
        touches = streams.fresh_touches(_MANY)
        return ContactThreshold.tuned(rise(touches), touches.known_labels[:, -1] > 0.5).minimum

    @cached_property
    def longest(self) -> float:  # type: ignore[override]
        """Longest touch of the training, s; two thirds of the window if unknown."""
        if self.device.reference is not None:
            return self.device.reference.sampler.settings.press[1]
        return self.window * 2 / 3 / self.rate

    @cached_property
    def presses(self) -> np.ndarray | None:  # type: ignore[override]
        """Readings of a press at the limit of ``dangerous`` on each sensor, (S, S), N; None: unknown."""
        reference = self.device.reference
        return None if reference is None else reference.press_readings().double().numpy()

    @torch.inference_mode()
    def probabilities(self, readings: np.ndarray, valid: np.ndarray) -> np.ndarray:
        """Return the probability of each label, (B, L), for readings (B, T, S), N, and their validity."""
        windows = torch.from_numpy(readings), torch.from_numpy(valid)
        return self.learner.probabilities(Touches(*windows, self.sites, None, self.rate)).numpy()

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
        reference = self.device.reference
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
            saturation=None if reference is None else reference.imperfection.clip,
            threshold=self.threshold,
            contact=self.contact,
            learned=self.learned,
            longest=self.longest,
            thresholds=dict(thresholds) if thresholds else None,
            presses=None if self.presses is None else self.presses.round(4).tolist(),
            limits=None
            if reference is None
            else {
                name: limit
                for name, limit in asdict(reference.sampler.settings.danger).items()
                if np.isfinite(limit)
            },
        )


def load_run(
    name: str = "latest",
    uri: str | None = None,
    trust: bool = False,
    body: AbstractBody | str | None = None,
    layout: AbstractLayout | str | None = None,
) -> Model:
    """Return the model of a finished training run, a pretrained model, or a file of ``skin export``.

    Args:
        name: of the model, the beginning of the run's id, or the path of an ONNX file; ``latest`` is the last
            run that finished.
        uri: of the runs, as MLflow takes it; None: ``mlflow.db`` in the current folder.
        trust: allow any class in its configuration, which may run any code.
        body: the body of the skin to use it on, such as :class:`skin.body.sheet.Sheet`, or the name of an
            option, such as ``arm``; None: that of the run.
        layout: the sensors of this skin: a layout such as :class:`skin.body.layout.Grid`, the name of an
            option, or the path of a CSV file; None: those of the run.

    Raises:
        InputError: there is no such run, it cannot be loaded, or it does not fit the skin.
    """
    if name.endswith(".onnx"):
        if body is not None or layout is not None:
            raise InputError(f"{name} is a network for one skin: leave out body and layout")
        return OnnxModel(name)
    run = find_run(Tracking(uri), name, trust)
    try:
        return load_model(run, with_skin(run.stored, body, layout))
    except InstantiationException as error:
        raise to_input_error(error) or error from error


def load_model(
    run: FinishedRun,
    config: Config | None = None,
    used: Config | None = None,
    device: AbstractDevice | None = None,
    touch: float | None = None,
    one_skin: bool = False,
    alarm: bool = True,
) -> TorchModel:
    """Return the model of a finished run.

    Args:
        run: the run.
        config: its configuration, changed as :meth:`FinishedRun.configured` does; None: not changed.
        used: its configuration with the device that a live view watches; None: ``config``.
        device: to use it on; None: that of ``config``.
        touch: as in :class:`TorchModel`.
        one_skin: as in :func:`alarm_point`.
        alarm: choose the threshold of the alarm for single windows; False: it has none.

    Raises:
        InputError: its weights do not fit the configuration, or it was trained on sensors of three axes, and
            those of the layout have one.
    """
    given = config or run.stored
    config = with_axes_of(run.stored, given)
    used = config if used is None else with_axes_of(run.stored, used)
    if device is not None and config is not given:
        raise InputError(
            f"{run.title} takes sensors that measure inwards, these touches have three axes: leave out run="
        )
    if device is None:
        _warn_of_unknown_skin(run.stored.device, config.device, partial(build_skin, config))
    with run.reading("config.yaml", "describes nothing that can be built"):
        device = device or _with_labels(run.stored, build_device(config))
        learner = build_learner(config)
        data = build_frames(config.representation, device.blank(), partial(build_skin, config))
    run.load_weights(learner, data)
    point = choose_alarm_threshold(alarm_source(run, learner, config), one_skin=one_skin) if alarm else None
    return TorchModel(device, learner, data.example, point, touch, run, used)


def with_axes_of(trained: Config, config: Config) -> Config:
    """Return a configuration with sensors like those of a training: of sites with three axes those inwards.

    The limits, masks and thresholds that follow from it are then those of these channels.

    Raises:
        InputError: the training had sensors of three axes, and those of the layout have one.
    """
    known, skin = build_skin(trained).sensors, build_skin(config)
    if known.axes > skin.sensors.axes:
        raise InputError(
            "this run was trained on sensors of three axes, the layout has one: give layout.axes=three, or "
            "a layout with directions"
        )
    if known.axes == skin.sensors.axes:
        return config
    layout = config.layout | {"axes": "normal"}
    if "axes" not in config.layout:  # a file, or a layout that was built in Python
        positions, normals = (values[INWARDS] for values in (skin.sensors.positions, skin.sensors.normals))
        layout = _listed_settings(
            Listed(positions.tolist(), skin.sensors.footprint, normals.tolist()), skin.body
        )
    device = {**config.device, "inwards": True} if "port" in config.device else config.device
    return replace(config, layout=layout, device=device)


def _with_labels(stored: Config, device: AbstractDevice) -> AbstractDevice:
    """Return a device whose recorded touches have the labels of a run."""
    if device.real or device.reference is not None:
        return device
    try:
        task = build_device(stored).task
    except InputError:  # the recording of its training is gone
        return device
    return device.with_labels(task)


def _warn_of_unknown_skin(
    trained: Mapping[str, Any], used: Mapping[str, Any], make_skin: Callable[[], SkinModel]
) -> None:
    """Warn where a run that was trained on drawn skins is used on others than those.

    Args:
        trained, used: settings of the devices.
        make_skin: returns the skin that it is used on.
    """
    if (distributed := trained.get("skins")) is None:
        return
    from skin.device.calibration import read_calibration
    from skin.device.imperfection import outside
    from skin.device.skins import SkinDistribution

    skin = make_skin()
    unlike = configured(SkinDistribution, distributed, "device.skins").outside(skin.body, skin.sensors)
    if "skins" not in used:
        path = used.get("calibration")
        measured = {} if path is None else read_calibration(path, bool(used.get("inwards"))).values()
        ranges = {name: (values.min(), values.max()) for name, values in measured.items()}
        unlike += outside({**used, **ranges}, trained)
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
        device: the device in use; None: a real skin.
    """
    reading = (stored.device.get("simulator") or {}).get("reading")
    if reading != "equation10" or (device is not None and not device.real):
        return None
    return (
        "warning: this run learned from simulator=fem and equation 10, which does not carry over to other "
        "mechanics (docs/results.md): train one with simulator=solid for a real skin"
    )

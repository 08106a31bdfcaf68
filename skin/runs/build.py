"""Build the objects that a configuration names, group by group, and find the settings of a skin's objects."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import partial
from typing import TYPE_CHECKING, Any

from hydra import compose, initialize_config_dir
from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import OmegaConf

from skin.body.base import AbstractBody, Sensors, check_plausibility, warn_of_surface
from skin.body.layout import AbstractLayout, Listed
from skin.core.files import CONF
from skin.core.messages import one_line, to_input_error
from skin.core.settings import check_groups, configured
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.learning.data import Augmentation, TouchData
from skin.learning.learner import AbstractLearner
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.configuration import Config, iterate_leaves, validate_config

if TYPE_CHECKING:
    from torch import Tensor


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
        if "_target_" not in group:
            raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
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
    representation: Mapping[str, Any], device: AbstractDevice, make_skin: Callable[[], SkinModel]
) -> TouchData:
    """Return what makes the frames of touches in a representation: enough to predict.

    Args:
        representation: its settings.
        device: of the touches.
        make_skin: returns the skin of the device, where a representation needs its geometry.
    """
    _check_options({"representation": representation})
    # Not a local function: processes that train together pickle it.
    geometry = partial(_measure_geometry, make_skin) if device.configured else None
    return TouchData(device, instantiate(representation), geometry=geometry)


def _measure_geometry(make_skin: Callable[[], SkinModel]) -> "Tensor":
    """Return what the sensors of a skin respond to, (S, G)."""
    from skin.mechanics.geometry import sensor_geometry

    skin = make_skin()
    return sensor_geometry(skin.body, skin.sensors, skin.simulator(skin.body, skin.sensors))


def build_data(config: Config, device: AbstractDevice) -> TouchData:
    """Return the data of a device's touches in the configured representation."""
    assert config.data is not None
    augmentation = configured(Augmentation, config.data.augment, "data.augment")
    made = build_frames(config.representation, device, partial(build_skin, config))
    size = config.data.batch_size
    return TouchData(device, made.make, size, config.seed, augmentation, made.make_geometry)


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
    settings = {field.name: getattr(body, field.name) for field in fields(body) if field.init}
    settings["layers"] = [asdict(layer) for layer in body.layers]
    for layer in settings["layers"]:
        layer["material"] = {key: value for key, value in layer["material"].items() if value is not None}
    plain = {key: list(value) if isinstance(value, tuple) else value for key, value in settings.items()}
    return {"_target_": f"{type(body).__module__}.{type(body).__qualname__}", "_convert_": "all", **plain}


def _listed_settings(layout: AbstractLayout, body: AbstractBody) -> dict[str, Any]:
    """Return settings for the sensors that a layout has in a body."""
    if not isinstance(layout, AbstractLayout):
        raise InputError(f"layout must be a layout such as skin.Grid, a name or a CSV file, got {layout!r}")
    sensors = layout.sensors(body)
    return {
        "_target_": f"{Listed.__module__}.{Listed.__qualname__}",
        "_convert_": "all",
        "positions": sensors.positions.tolist(),
        "footprint": list(sensors.footprint),
        "normals": sensors.normals.tolist(),
    }


def default_option(group: str, name: str) -> dict[str, Any]:
    """Return the default settings of an option.

    Raises:
        InputError: there is no such option.
    """
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    if name not in options:
        raise InputError(f"there is no {group} {name}: give one of {', '.join(options)}, or build one")
    return OmegaConf.to_container(OmegaConf.load(CONF / group / f"{name}.yaml"))  # type: ignore[return-value]

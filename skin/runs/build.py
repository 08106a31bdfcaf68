"""Build the objects that a configuration names, group by group."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

from hydra.utils import instantiate

from skin.body.base import AbstractBody, check_plausibility, warn_of_surface
from skin.body.layout.base import AbstractLayout
from skin.body.sensors import Sensors
from skin.core.settings import check_groups, configured
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.learning.learner.base import AbstractLearner
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.configuration import Config

if TYPE_CHECKING:
    from torch import Tensor

    from skin.learning.data import TouchData


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
    body, layout = _body_and_layout(config, "simulator")
    return SkinModel(body, layout, layout.sensors(body), instantiate(config.simulator))


def _body_and_layout(config: Config, source: str) -> tuple[AbstractBody, AbstractLayout]:
    """Check body, layout and the group of what responds to touches; return the first two."""
    _check_options(config, "body", "layout", source)
    check_plausibility(vars(config))
    return instantiate(config.body), instantiate(config.layout)


def _check_options(config: Config, *names: str) -> None:
    """Raise InputError where a group names no option, or has settings that its option does not take."""
    groups = {name: getattr(config, name) for name in names}
    for name, group in groups.items():
        if "_target_" not in group:
            raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
    check_groups(groups)


def build_device(config: Config) -> AbstractDevice:
    """Return the device, with its body, layout and, if it has one, its simulator."""
    body, layout = _body_and_layout(config, "device")
    # Not arguments of instantiate, which would treat the dataclass of the body as a configuration.
    device: AbstractDevice = instantiate(config.device, _partial_=True)(body=body, layout=layout)
    if device.simulation is not None and device.simulation.model.mechanical:
        warn_of_surface(body, device.simulation.sensors)
    return device


def build_data(config: Config, device: AbstractDevice) -> "TouchData":
    """Return the data module of a device's touches in the configured representation."""
    # Imported here because Lightning takes seconds and commands without training do not need it.
    from skin.learning.data import Augmentation, TouchData

    assert config.data is not None
    augmentation = configured(Augmentation, config.data.augment, "data.augment")
    _check_options(config, "representation")
    representation = instantiate(config.representation)
    geometry = partial(_geometry, config)
    return TouchData(device, representation, config.data.batch_size, config.seed, augmentation, geometry)


def _geometry(config: Config) -> "Tensor":
    """Return what the sensors of the configured skin respond to, (S, G)."""
    from skin.mechanics.geometry import sensor_geometry

    skin = build_skin(config)
    return sensor_geometry(skin.body, skin.sensors, skin.simulator(skin.body, skin.sensors))


def build_learner(config: Config) -> AbstractLearner:
    """Return an untrained learner."""
    _check_options(config, "learner")
    learner: AbstractLearner = instantiate(config.learner, seed=config.seed)
    return learner

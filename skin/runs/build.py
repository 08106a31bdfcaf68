"""Build the objects that a configuration names, group by group."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from hydra.utils import instantiate
from omegaconf import DictConfig

from skin.body.base import AbstractBody, Sensors, check_plausibility, warn_of_surface
from skin.body.layout import AbstractLayout
from skin.core.settings import check_groups, configured
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.learning.learner import AbstractLearner
from skin.mechanics.simulator.base import AbstractSimulator
from skin.runs.configuration import plain

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


def build_skin(config: DictConfig) -> SkinModel:
    """Return the body, the sensors and the simulator."""
    groups = plain(config)
    body, layout = _body_and_layout(groups, "simulator")
    sensors, simulator = layout.sensors(body), instantiate(groups["simulator"])
    return SkinModel(body, layout, sensors, simulator)


def _body_and_layout(groups: dict[str, Any], source: str) -> tuple[AbstractBody, AbstractLayout]:
    """Check body, layout and the group of what responds to touches; return the first two."""
    _check_options(groups, "body", "layout", source)
    check_plausibility(groups)
    return instantiate(groups["body"]), instantiate(groups["layout"])


def _check_options(groups: dict[str, Any], *names: str) -> None:
    """Raise InputError where a group names no option, or has settings that its option does not take."""
    for name in names:
        if "_target_" not in (groups.get(name) or ()):
            raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
    check_groups({name: groups[name] for name in names})


def build_device(config: DictConfig) -> AbstractDevice:
    """Return the device, with its body, layout and, if it has one, its simulator."""
    groups = plain(config)
    body, layout = _body_and_layout(groups, "device")
    # Not arguments of instantiate, which would treat the dataclass of the body as a configuration.
    device: AbstractDevice = instantiate(groups["device"], _partial_=True)(body=body, layout=layout)
    if device.simulation is not None and device.simulation.model.mechanical:
        warn_of_surface(body, device.simulation.sensors)
    return device


def build_data(config: DictConfig, device: AbstractDevice) -> "TouchData":
    """Return the data module of a device's touches in the configured representation."""
    # Imported here because Lightning takes seconds and commands without training do not need it.
    from skin.learning.data import Augmentation, TouchData

    groups = plain(config)
    augmentation = configured(Augmentation, groups["data"]["augment"], "data.augment")
    _check_options(groups, "representation")
    representation = instantiate(groups["representation"])
    return TouchData(
        device,
        representation,
        config.data.batch_size,
        config.seed,
        augmentation,
        partial(_geometry, config),
    )


def _geometry(config: DictConfig) -> "Tensor":
    """Return what the sensors of the configured skin respond to, (S, G)."""
    from skin.mechanics.geometry import sensor_geometry

    skin = build_skin(config)
    return sensor_geometry(skin.body, skin.sensors, skin.simulator(skin.body, skin.sensors))


def build_learner(config: DictConfig) -> AbstractLearner:
    """Return an untrained learner."""
    groups = plain(config)
    _check_options(groups, "learner")
    return instantiate(groups["learner"], seed=config.seed)

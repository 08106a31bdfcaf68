"""Build the objects that a configuration names, group by group."""

from typing import TYPE_CHECKING

from hydra.utils import instantiate
from omegaconf import DictConfig

from skin.config import plain
from skin.device.base import AbstractDevice
from skin.learner.base import AbstractLearner
from skin.plausibility import check_plausibility, warn_of_surface
from skin.settings import check_groups, configured

if TYPE_CHECKING:
    from skin.datamodule import TouchData


def build_device(config: DictConfig) -> AbstractDevice:
    """Return the device, with its body, layout and, if it has one, its simulator."""
    groups = plain(config)
    check_groups({name: groups[name] for name in ("body", "layout", "device")})
    check_plausibility(groups)
    body, layout = instantiate(groups["body"]), instantiate(groups["layout"])
    # Not arguments of instantiate, which would treat the dataclass of the body as a configuration.
    device: AbstractDevice = instantiate(groups["device"], _partial_=True)(body=body, layout=layout)
    if device.simulation is not None and device.simulation.model.mechanical:
        warn_of_surface(body, device.simulation.sensors)
    return device


def build_data(config: DictConfig, device: AbstractDevice) -> "TouchData":
    """Return the data module of a device's touches in the configured representation."""
    # Imported here because Lightning takes seconds and commands without training do not need it.
    from skin.datamodule import TouchData
    from skin.signal.augmentation import Augmentation

    groups = plain(config)
    augmentation = configured(Augmentation, groups["data"]["augment"], "data.augment")
    check_groups({"representation": groups["representation"]})
    representation = instantiate(groups["representation"])
    return TouchData(device, representation, config.data.batch_size, config.seed, augmentation)


def build_learner(config: DictConfig) -> AbstractLearner:
    """Return an untrained learner."""
    learner = plain(config)["learner"]
    check_groups({"learner": learner})
    return instantiate(learner, seed=config.seed)

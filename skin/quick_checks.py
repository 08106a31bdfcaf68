"""Checks of a configuration that need no run, made before anything is loaded."""

from collections.abc import Sequence
from typing import Any

from omegaconf import DictConfig

from skin.config import plain
from skin.settings import check_groups

_GROUPS = ("body", "layout", "touch", "device", "contact")


def check_quickly(config: DictConfig, overrides: Sequence[str]) -> None:
    """Refuse settings of a skin that no skin has, and a port that does not exist.

    Args:
        config: of a command; groups that it lacks are not checked.
        overrides: of its command line. The groups that they name are checked further, which imports torch.

    Raises:
        InputError: naming the setting, or the port.
    """
    # They import numpy, for which a mistyped setting must not wait.
    from skin.plausibility import check_plausibility
    from skin.wire.reader import PortSettings, check_port

    groups: dict[str, Any] = {
        name: plain(config[name]) for name in _GROUPS if isinstance(config.get(name), DictConfig)
    }
    check_groups({name: groups[name] for name in ("body", "layout") if name in groups})
    check_plausibility(groups)
    device = groups.get("device", {})
    if isinstance(port := device.get("port"), str):
        PortSettings.select({name: value for name, value in device.items() if value is not None})
        check_port(port)
    named = {override.split("=")[0].split(".")[0] for override in overrides}
    if "run" in config and config.run is not None and not config.run.endswith(".onnx"):
        check_groups({name: groups[name] for name in ("device", "contact") if name in groups.keys() & named})
        if "touch" in named:
            from skin.touch.gesture import GestureSettings

            GestureSettings.of(groups["touch"])

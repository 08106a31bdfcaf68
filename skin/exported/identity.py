"""The skin of an exported network: its file describes it, and no override may contradict it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from skin.config import plain
from skin.errors import InputError
from skin.exported.metadata import ModelMetadata
from skin.exported.model import ExportedModel
from skin.run_overrides import apply_overrides
from skin.sensors import Sensors
from skin.settings import check_groups
from skin.trust import check_targets

GROUPS = ("body", "layout", "simulator", "touch", "evaluation")
"""Groups of settings that describe the skin of a network and how its threshold was chosen."""

# What an exported network leaves to the command line.
_FREE = ("device", "live", "web", "seconds", "run", "trust", "tracking", "hydra")
_CLOSE = 1e-6  # m; positions in the file are single precision


def describe_skin(config: DictConfig, positions: np.ndarray) -> dict[str, Any] | None:
    """Return the settings of the skin of a network, for its file.

    Args:
        config: of the run, with the skin that it is exported for.
        positions: of its sensors, (S, 3), m.

    Returns:
        The groups :data:`GROUPS`, plain; None if the sensors are not those of the configuration, such as
        those of a recording.
    """
    groups = {name: value for name, value in plain(config).items() if name in GROUPS}
    return groups if _at(_sensors(groups), positions) else None


def check_overrides(path: str, composed: DictConfig, overrides: Sequence[str]) -> None:
    """Check that overrides do not contradict an exported network.

    Args:
        path: of its file.
        composed: configuration with the overrides.
        overrides: of the command line.

    Raises:
        InputError: an override contradicts the file or has no effect on an exported network, or the file
            cannot be used.
    """
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    groups = [override.key_or_group.split(".")[0].split("/")[0] for override in parsed]
    named = dict(zip(overrides, groups, strict=True))
    asked = {override: group for override, group in named.items() if group not in _FREE}
    for override, group in asked.items():
        if group not in GROUPS:
            raise InputError(f"{override} has no effect on {path}, a network for one skin: leave it out")
    if not asked:
        return
    metadata = ExportedModel(path).metadata
    folders = [override for override, group in named.items() if group == "hydra"]
    for override in asked:
        if not _agrees(metadata, composed, [*folders, override], path):
            raise InputError(
                f"{override} contradicts {path}, which was exported for another skin: leave it out, or "
                "export the run again with it"
            )


def _agrees(metadata: ModelMetadata, composed: DictConfig, overrides: list[str], path: str) -> bool:
    """Return whether overrides leave the skin of a network as it is.

    Raises:
        InputError: the file does not describe its skin, or it describes none that can be built.
    """
    if metadata.skin is None:
        raise InputError(
            f"{overrides[-1]} cannot be compared with {path}, which does not describe its skin: leave it "
            "out, or write the file again with skin export"
        )
    check_targets({name: metadata.skin.get(name) for name in ("body", "layout")}, path)
    stored = OmegaConf.create({"device": {}, **{name: metadata.skin.get(name) for name in GROUPS}})
    before = plain(apply_overrides(stored, composed, []))
    after = plain(apply_overrides(stored, composed, overrides))
    if any(after[group] != before[group] for group in GROUPS if group != "layout"):
        return False
    same = after["layout"].get("footprint") == before["layout"].get("footprint")
    # A file of the same name may list other positions.
    return same and _at(_sensors(after), np.array(metadata.positions))


def _sensors(groups: dict[str, Any]) -> Sensors:
    """Return the sensors that settings describe."""
    check_groups({name: groups[name] for name in ("body", "layout")})
    return instantiate(groups["layout"]).sensors(instantiate(groups["body"]))


def _at(sensors: Sensors, positions: np.ndarray) -> bool:
    """Return whether sensors are at positions (S, 3), m."""
    same = sensors.positions.shape == positions.shape
    return same and bool(np.allclose(sensors.positions, positions, rtol=0, atol=_CLOSE))

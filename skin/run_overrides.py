"""The configuration of a finished run with the overrides of a command line."""

from collections.abc import Sequence
from typing import Any

from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from skin.config import plain, validate_config
from skin.errors import InputError

# Groups that the weights of a run depend on.
_FIXED = (
    "representation",
    "model",
    "fusion",
    "learner",
    "optimizer",
    "trainer",
    "experiment",
    "sweep",
    "seed",
)


def apply_overrides(stored: DictConfig, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return a run's configuration with the overrides of a command line, checked.

    Args:
        stored: as :func:`skin.stored_run.load_configuration` gives it.
        composed: a new configuration with the overrides.
        overrides: of the command line; only these settings are taken from ``composed``.

    Raises:
        InputError: an override changes a setting that the weights depend on.
    """
    whole = OmegaConf.create(_raw(stored))
    assert isinstance(whole, DictConfig)
    _follow(whole, composed)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key in ("run", "trust") or key.startswith("hydra"):
            continue
        group = key.split(".")[0]
        if group in _FIXED:
            raise InputError(f"{key} was fixed when the run was trained: leave it out, or train another run")
        if key == "profile":
            # A profile is no group of settings of its own, but changes those of the device.
            chosen = override.value()
            named = profile_settings(str(chosen)) if chosen else {}
            whole.device = OmegaConf.merge(whole.device, {name: composed.device[name] for name in named})
            continue
        parent, _, name = key.rpartition(".")
        source = OmegaConf.select(composed, parent) if parent else composed
        # Unresolved, so that a device refers to the simulator of this run.
        OmegaConf.update(whole, key, _raw(source)[name], merge=False)
    whole.tracking = composed.tracking
    return validate_config(whole)


def profile_settings(name: str) -> dict[str, Any]:
    """Return the settings of the device in a profile (``conf/profile/``).

    Raises:
        InputError: there is no such profile.
    """
    loader = GlobalHydra.instance().config_loader()
    known = loader.get_group_options("profile")
    if name not in known:
        raise InputError(f"there is no profile {name}: choose one of {', '.join(known)}")
    return plain(compose(f"profile/{name}").device)


def _follow(whole: DictConfig, composed: DictConfig) -> None:
    """Restore the interpolations of the device to other groups that the run had.

    Stored configurations are resolved; without this ``simulator=naive`` would not reach ``device.simulator``.
    """
    device = _raw(whole.device)
    for name, value in _raw(composed.device).items():
        if not isinstance(value, str) or not value.startswith("${") or name not in device:
            continue
        if OmegaConf.select(whole, value[2:-1]) == device[name]:
            device[name] = value
    whole.device = device


def _raw(config: DictConfig) -> dict[str, Any]:
    """Return plain containers with interpolations as they stand."""
    return OmegaConf.to_container(config, resolve=False)  # type: ignore[return-value]

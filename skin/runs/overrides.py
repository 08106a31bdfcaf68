"""The configuration of a finished run with the overrides of a command line, or a skin built in Python."""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from hydra import compose, initialize_config_dir
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from skin.body.base import AbstractBody
from skin.body.layout.base import AbstractLayout, Listed
from skin.core.files import CONF
from skin.core.settings import check_groups
from skin.errors import InputError
from skin.runs.configuration import Config, validate_config

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


def apply_overrides(stored: Config, composed: DictConfig, overrides: Sequence[str]) -> Config:
    """Return a run's configuration with the overrides of a command line, checked.

    An option that the command line chooses may set more than its own group: the file of a skin in
    docs/your-skin.md has a body, positions and a simulator. All of its settings are taken.

    Args:
        stored: as :attr:`skin.runs.finished_run.FinishedRun.stored` gives it.
        composed: a new configuration with the overrides, as Hydra composes it.
        overrides: of the command line; only these settings are taken from ``composed``.

    Raises:
        InputError: an override changes a setting that the weights depend on.
    """
    whole = OmegaConf.create(asdict(stored))
    _follow(whole, composed)
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    keys = [override.key_or_group for override in parsed if not _is_steering(override.key_or_group)]
    for key in keys:
        if key.split(".")[0] in _FIXED:
            raise InputError(f"{key} was fixed when the run was trained: leave it out, or train another run")
    for option in _find_options(overrides) if keys else []:
        _take_option(whole, composed, option)
    for key in keys:
        if key.split(".")[0] in composed:  # a profile sets the device, and nothing of its own
            _take(whole, composed, key)
    whole.tracking = composed.tracking
    return validate_config(whole)


def _is_steering(key: str) -> bool:
    """Return whether an override says which run is used, or how the command runs."""
    return key in ("run", "trust") or key.startswith("hydra")


@dataclass(frozen=True)
class _Option:
    """What an option that was chosen sets, in its file and in those that the file includes.

    Attributes:
        name: as in ``body/mine``.
        group: whose option it is.
        settings: values in the file by their paths from the root of the configuration.
    """

    name: str
    group: str
    settings: dict[tuple[str, ...], Any]


def _find_options(overrides: Sequence[str]) -> list[_Option]:
    """Return the options that a command line chooses, and those that they choose in turn."""
    if not GlobalHydra.instance().is_initialized():  # in Python, not in a command
        with initialize_config_dir(str(CONF), version_base=None):
            return _find_options(overrides)
    loader = GlobalHydra.instance().config_loader()
    # The loader has no public function that returns the files of a configuration.
    parsed, files = loader._parse_overrides_and_create_caching_repo("train", list(overrides))  # type: ignore[attr-defined]
    groups = [override for override in parsed if files.group_exists(override.key_or_group)]
    composition = create_defaults_list(files, "train", groups, prepend_hydra=True, skip_missing=True)
    choices = composition.overrides.override_choices.items()
    chosen = {f"{group}/{name}": group for group, name in choices if not group.startswith("hydra/")}
    options: list[_Option] = []
    for element in reversed(composition.defaults):  # a file comes after the ones that it includes
        path = element.config_path or ""
        group = chosen.get(path) or chosen.get(element.parent or "")
        content = files.load_config(path) if group else None
        if group is None or content is None:
            continue
        chosen[path] = group
        package = tuple(element.package.split(".")) if element.package else ()
        options.append(_Option(path, group, dict(_leaves(_raw(content.config), package))))
    return options


def _leaves(settings: dict[str, Any], above: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values with their paths; a list is one value."""
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from _leaves(value, (*above, name))
        else:
            yield (*above, name), value


def _take_option(whole: DictConfig, composed: DictConfig, option: _Option) -> None:
    """Take the settings of an option.

    Raises:
        InputError: it changes a setting that the weights depend on.
    """
    settings = _raw(composed)
    taken = option.group in composed and option.group not in _FIXED
    if taken:
        _take(whole, composed, option.group)
    for path, value in option.settings.items():
        group = path[0]
        if taken and group == option.group:
            continue
        # What a later file or the command line replaced is not taken.
        if _is_steering(group) or _value(settings, path) != value:
            continue
        if group in _FIXED:
            if _value(_raw(whole), path) != _value(OmegaConf.to_container(composed, resolve=True), path):
                raise InputError(
                    f"{'.'.join(path)} in the option {option.name} was fixed when the run was trained: leave "
                    "it out of the file, or train another run"
                )
        elif _value(settings, (group, "_target_")) != _value(_raw(whole), (group, "_target_")):
            _take(whole, composed, group)
        else:
            _take_leaf(whole, path, value)


def _value(settings: Any, path: tuple[str, ...]) -> Any:
    """Return the value at a path; None where there is none."""
    for name in path:
        settings = settings.get(name) if isinstance(settings, dict) else None
    return settings


def _take(whole: DictConfig, composed: DictConfig, key: str) -> None:
    """Take a group or a setting, unresolved, so that a device refers to the simulator of this run."""
    parent, _, name = key.rpartition(".")
    source = OmegaConf.select(composed, parent) if parent else composed
    OmegaConf.update(whole, key, _raw(source)[name], merge=False)


def _take_leaf(whole: DictConfig, path: tuple[str, ...], value: Any) -> None:
    """Take one setting; names of materials in its path may have dots."""
    part = whole
    for name in path[:-1]:
        if not isinstance(part.get(name), DictConfig):
            part[name] = {}
        part = part[name]
    part[path[-1]] = value


def profile_settings(name: str) -> dict[str, Any]:
    """Return the settings of the device in a profile (``conf/profile/``).

    Raises:
        InputError: there is no such profile.
    """
    loader = GlobalHydra.instance().config_loader()
    names = loader.get_group_options("profile")
    if name not in names:
        raise InputError(f"there is no profile {name}: choose one of {', '.join(names)}")
    return OmegaConf.to_container(compose(f"profile/{name}").device, resolve=True)  # type: ignore[return-value]


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
        settings = _default_option("body", body) if isinstance(body, str) else _body_settings(body)
        config = replace(config, body=settings)
    if isinstance(layout, str):
        config = replace(config, layout=_layout_settings(layout))
    elif layout is not None:
        check_groups({"body": config.body})
        config = replace(config, layout=_listed_settings(layout, instantiate(config.body)))
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
    return {"_target_": _class_name(body), "_convert_": "all", **plain}


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


def _layout_settings(name: str) -> dict[str, Any]:
    """Return the settings of a layout that is given by its name or by its file."""
    if name.lower().endswith(".csv"):
        return _default_option("layout", "file") | {"path": name}
    return _default_option("layout", name)


def _default_option(group: str, name: str) -> dict[str, Any]:
    """Return the default settings of an option.

    Raises:
        InputError: there is no such option.
    """
    options = sorted(path.stem for path in (CONF / group).glob("*.yaml"))
    if name not in options:
        raise InputError(f"there is no {group} {name}: give one of {', '.join(options)}, or build one")
    settings: Any = OmegaConf.to_container(OmegaConf.load(CONF / group / f"{name}.yaml"))
    return settings


def _class_name(built: object) -> str:
    return f"{type(built).__module__}.{type(built).__qualname__}"

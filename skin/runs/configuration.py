"""The configuration: its schema, its fingerprint, and that of a finished run with other settings.

Only Hydra is imported here: ``--help`` and a mistyped key must not import torch.
"""

import hashlib
import json
import os
import platform
import re
import socket
import subprocess
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from keyword import iskeyword
from math import isnan
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

from hydra import initialize_config_dir
from hydra._internal.defaults_list import create_defaults_list
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin import __version__
from skin.core.files import BUNDLED, CONF, MANIFEST, ROOT, candidates
from skin.core.messages import one_line
from skin.core.settings import walk_settings
from skin.errors import InputError
from skin.evaluation.settings import Evaluation

# What a result depends on: a hash of configuration, the files it names, and version; code and processor.


MACHINE = ("accelerator", "devices", "enable_progress_bar", "num_nodes", "precision", "strategy")
"""Settings of Lightning's Trainer that choose the machine, not the result."""
ADDED: dict[str, Any] = {
    "scale_spread": 0.0,
    "independent": False,
    "aligned": True,
    "framed": 0.0,
    "without_lag": 0.0,
    "ongoing": 0.0,
    "footprint_error": 0.0,
    "described": None,
    "interface": 0.0,
    "task": None,
    "targets": None,
    "second": 0.0,
    "training_touch": {},
    "start": None,
}
"""Settings that came later, and the values that earlier runs mean: not counted."""
_FOLDERS = ("skin", "experiments", "conf", "data")  # results depend on nothing else in the repository


def config_hash(content: dict[str, Any]) -> str:
    """Return the hash of a configuration in plain containers, 16 hexadecimal digits."""
    texts = (value for _, value in walk_settings(content) if isinstance(value, str))
    files = {text: _hash_of(text) for text in texts if _file(text)}
    text = json.dumps([_counted(content), files, __version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _counted(value: Any, group: str = "") -> Any:
    """Return a configuration without :data:`MACHINE`, and without the values in :data:`ADDED`."""
    if not isinstance(value, dict):
        return value
    left_out = MACHINE if group == "trainer" else ()
    added = ADDED if group in ("device", "skins", "touch", "learner") else {}
    return {
        key: _counted(entry, key)
        for key, entry in value.items()
        if key not in left_out and not (key in added and entry == added[key])
    }


def _file(name: str) -> Path | None:
    """Return the file that a setting names, the manifest of a data set, or None."""
    plain = "/" not in name and "." not in name
    try:
        paths = [path / MANIFEST if plain or path.is_dir() else path for path in candidates(name)]
        return next((candidate for candidate in paths if candidate.is_file()), None)
    except OSError:
        return None


def _hash_of(name: str) -> str:
    path = _file(name)
    if path is None:
        return ""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cache
def source_tags() -> dict[str, str]:
    """Return the tags ``source_commit`` and ``source_dirty`` of the code, and ``processor``.

    ``source_commit`` is the last commit that changed the code; without git, the version of the package.
    ``source_dirty`` is ``true`` if files differ from that commit, ``false`` if none does, and ``unknown``
    without git.
    """
    commit, dirty = _git("log", "-1", "--format=%H", "--", *_FOLDERS), "unknown"
    if commit:
        dirty = "true" if _git("status", "--porcelain", "--", *_FOLDERS) else "false"
    return {
        "source_commit": commit or __version__,
        "source_dirty": dirty,
        "processor": _processor(),
    }


def _git(*arguments: str) -> str | None:
    """Return the output of git in the repository; None without git."""
    if BUNDLED != ROOT:  # a wheel, which may be installed inside another repository
        return None
    try:
        command = ["git", "-C", str(ROOT), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _processor() -> str:
    """Return the name of the processor, with its family and model where the system tells them."""
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        text = ""
    facts = dict(re.findall(r"^(model name|cpu family|model)\s*:\s*(.+)$", text, re.MULTILINE))
    if not facts:
        return platform.processor() or platform.machine() or "unknown"
    return ", ".join(
        part for part in (
            facts.get("model name"),
            f"family {facts['cpu family']}" if "cpu family" in facts else None,
            f"model {facts['model']}" if "model" in facts else None,
        ) if part
    )  # fmt: skip


_TOO_LARGE = 2**63
_COUNTED = (("seconds",), ("gestures",), ("n",))  # settings of commands
_PATIENCE = 5.0  # s until a server that accepts no connection counts as away

# Of an address: what is before its password, which is not the port of a server, and what is after it.
_PASSWORD = re.compile(r"""([a-z][\w+.-]*://[^/@:\s]*:)(?!\d+/|\*\*\*@)(\S*)(@[^\s'"]*)""")
_PORTS = {"http": 80, "https": 443, "postgresql": 5432, "mysql": 3306, "mssql": 1433}
# Settings without effect on results.
_STEERING = ("shard", "tracking", "trust")


@dataclass
class Data:
    """How many gestures a training draws (``conf/data``)."""

    name: str
    gestures: int
    padded: bool
    fresh: bool
    batch_size: int
    stream: bool
    direction: bool
    augment: dict[str, Any]


@dataclass
class Tracking:
    """Where runs are logged, and whether finished ones are skipped (``conf/train.yaml``)."""

    uri: str | None = None
    artifacts: str | None = None
    experiment: str = "skin"
    resume: bool = True
    threads: int | None = None
    objective: str | None = None

    def __post_init__(self) -> None:
        self.uri = self.uri and hide_password(self.uri)


@dataclass(frozen=True)
class Config:
    """A checked configuration in plain containers. What it does not set is None, a group that it lacks empty.

    Groups without a type here are checked by their class.
    """

    row: str | None = None
    seed: int = 0
    task: str | None = None
    epochs: dict[str, int] = field(default_factory=dict)
    touch: dict[str, Any] = field(default_factory=dict)
    body: dict[str, Any] = field(default_factory=dict)
    layout: dict[str, Any] = field(default_factory=dict)
    simulator: dict[str, Any] = field(default_factory=dict)
    device: dict[str, Any] = field(default_factory=dict)
    representation: dict[str, Any] = field(default_factory=dict)
    model: dict[str, Any] = field(default_factory=dict)
    fusion: dict[str, Any] = field(default_factory=dict)
    learner: dict[str, Any] = field(default_factory=dict)
    data: Data | None = None
    optimizer: dict[str, Any] = field(default_factory=dict)
    trainer: dict[str, Any] = field(default_factory=dict)
    evaluation: Evaluation | None = None
    tracking: Tracking = field(default_factory=Tracking)
    contact: dict[str, Any] = field(default_factory=dict)
    shard: str | None = None
    # What a command other than training adds.
    run: str | None = None
    name: str | None = None
    licence: str | None = None
    trust: bool = False
    n: int | None = None
    out: str | None = None
    view: str | None = None
    labels: list[str] | None = None
    shape: str | None = None
    index: int | None = None
    session: str | None = None
    from_: str | None = None  # a Python keyword: from= on the command line
    path: str | None = None
    presses: str | None = None
    weight: float | None = None
    base: float | None = None
    calibrate: dict[str, Any] = field(default_factory=dict)
    port: str | None = None
    adapter: dict[str, Any] = field(default_factory=dict)
    link: str | None = None
    seconds: float | None = None
    web: bool | None = None
    demo: bool | None = None
    live: dict[str, Any] = field(default_factory=dict)
    export: dict[str, Any] = field(default_factory=dict)
    gestures: int | None = None
    format: str | None = None
    emulate: dict[str, Any] = field(default_factory=dict)
    faults: dict[str, Any] = field(default_factory=dict)
    record: dict[str, Any] = field(default_factory=dict)
    compare: dict[str, Any] = field(default_factory=dict)
    study: dict[str, Any] = field(default_factory=dict)
    smoke: bool | None = None
    table: dict[str, Any] = field(default_factory=dict)
    results: dict[str, Any] = field(default_factory=dict)
    design: dict[str, Any] = field(default_factory=dict)
    adapt: dict[str, Any] = field(default_factory=dict)


def is_server(uri: str | None) -> bool:
    """Return whether a tracking URI is the address of a server, not of a database."""
    return uri is not None and uri.startswith(("http://", "https://"))


def hide_password(text: str) -> str:
    """Return a tracking URI or an override with it, with ``***`` for the password.

    The environment keeps the password for :func:`reveal_password`. So no message, log or stored configuration
    can tell it, and commands that this one starts can connect.
    """
    for address in _PASSWORD.finditer(text):
        hidden = f"{address[1]}***{address[3]}"
        os.environ[_variable(hidden)] = address[2]
        text = text.replace(address[0], hidden)
    return text


def reveal_password(uri: str) -> str:
    """Return a tracking URI with the password that :func:`hide_password` replaced, to connect to it."""
    return uri.replace(":***@", f":{os.environ.get(_variable(uri), '***')}@", 1)


def _variable(hidden: str) -> str:
    """Return the environment variable of the password of a URI."""
    return f"SKIN_PASSWORD_{hashlib.sha256(hidden.encode()).hexdigest()[:8]}"


def answers(uri: str | None) -> bool:
    """Return whether the server of a tracking URI accepts connections; True for a file."""
    place = urlsplit(uri or "")
    port = place.port or _PORTS.get(place.scheme.partition("+")[0])
    if not place.hostname or port is None:
        return True
    try:
        socket.create_connection((place.hostname, port), timeout=_PATIENCE).close()
    except OSError:
        return False
    return True


def check_server(uri: str | None) -> None:
    """Check that the server of a tracking URI answers, before anything heavy is imported.

    Raises:
        InputError: it does not, or it is a database whose driver is not installed.
    """
    if uri is not None and uri.startswith(("mssql", "mysql", "postgresql")):
        from sqlalchemy import exc, make_url  # only where a database is named

        try:
            make_url(uri).get_dialect().import_dbapi()
        except (ImportError, exc.SQLAlchemyError) as error:
            raise InputError(
                f"tracking.uri={uri} needs a driver that is not installed ({one_line(error)}): install it, "
                'or give postgresql+pg8000://... after pip install "tactile-skin[server]"'
            ) from error
    if not answers(uri):
        raise InputError(
            f"the tracking server {uri} does not answer: start it, open the tunnel to it, or correct "
            "tracking.uri; without it, finished runs are not known, and nothing begins"
        )


def validate_config(config: Any) -> Config:
    """Return a configuration that fits the schema, with every interpolation resolved.

    Args:
        config: as Hydra composes it, or in plain containers.

    Raises:
        InputError: a key or a value does not fit, or an interpolation cannot be resolved.
    """
    try:
        whole = OmegaConf.merge(OmegaConf.structured(Config), _without_keywords(config))
        # NaN would pass most comparisons, and numbers of more than 64 bits overflow in arrays.
        for path, value in walk_settings(OmegaConf.to_container(whole)):
            unfit = isinstance(value, int) and abs(value) >= _TOO_LARGE
            if unfit or (isinstance(value, float) and isnan(value)):
                reason = "too large" if unfit else "nan"
                raise InputError(f"{'.'.join(path)} is {reason}: give a number")
            if path in _COUNTED and value is not None and value < 0:
                raise InputError(f"{path[0]}={value:g} is below 0: give a number above 0")
        return cast(Config, OmegaConf.to_object(whole))
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error


def _without_keywords(config: Any) -> Any:
    """Return a configuration whose keys are names in Python, as ``from_`` is for ``from``."""
    if not isinstance(config, Mapping) or not any(iskeyword(str(name)) for name in config):
        return config
    plain: Any = OmegaConf.to_container(config, resolve=False) if OmegaConf.is_config(config) else config
    return {f"{name}_" if iskeyword(str(name)) else name: value for name, value in plain.items()}


def refuse_null_groups(config: DictConfig) -> None:
    """Raise InputError where a group of a composed configuration was replaced by null.

    Args:
        config: as Hydra composes it; groups that a command does not have are missing in it.
    """
    groups = {
        name for name, hint in Config.__annotations__.items() if "dict" in str(hint) or "skin." in str(hint)
    }
    for name in sorted(groups & set(config)):
        if config[name] is None:
            raise InputError(
                f"{name}=null leaves nothing to use: give settings or an option, or leave it out"
            )


def settings_of(config: Config) -> dict[str, Any]:
    """Return what a configuration sets, in plain containers."""
    return {key: value for key, value in asdict(config).items() if value not in (None, {})}


def fingerprint(config: Config) -> str:
    """Return a hash of everything that results depend on: configuration, files it names, version."""
    # Unset keys belong to other commands; a new command must not change the fingerprint of finished runs.
    return config_hash({key: value for key, value in settings_of(config).items() if key not in _STEERING})


def overrides() -> list[str]:
    """Return the overrides on the command line of the running command."""
    return list(HydraConfig.get().overrides.task)


# The configuration of a finished run with the overrides of a command line.


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
        options.append(_Option(path, group, dict(iterate_leaves(_raw(content.config), package))))
    return options


def iterate_leaves(
    settings: dict[str, Any], above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values with their paths; a list is one value."""
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from iterate_leaves(value, (*above, name))
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

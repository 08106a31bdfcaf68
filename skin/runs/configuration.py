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
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from functools import cache, reduce
from math import isnan
from operator import getitem
from pathlib import Path
from typing import Any, cast
from urllib.parse import urlsplit

from hydra import compose, initialize_config_dir
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin import __version__
from skin.core.files import BUNDLED, CONF, MANIFEST, ROOT, candidates
from skin.core.messages import one_line
from skin.core.settings import import_target, option_name, walk_settings
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
    "miss_rate": None,
    "limits": {},
    "training_touch": {},
    "start": None,
}
"""Settings that came later, and the values that earlier runs mean: not counted."""
_FOLDERS = ("skin", "experiments", "conf", "data")  # results depend on nothing else in the repository


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


@cache
def source_tags() -> dict[str, str]:
    """Return the tags ``source_commit`` and ``source_dirty`` of the code, and ``processor``.

    ``source_commit`` is the last commit that changed the code; without git, the version of the package.
    ``source_dirty`` is ``true`` if files differ from that commit, ``false`` if none does, and ``unknown``
    without git.
    """
    commit = _git("log", "-1", "--format=%H", "--", *_FOLDERS)
    changed = "true" if _git("status", "--porcelain", "--", *_FOLDERS) else "false"
    return {
        "source_commit": commit or __version__,
        "source_dirty": changed if commit else "unknown",
        "processor": _processor(),
    }


def _git(*arguments: str) -> str | None:
    """Return the output of git in the repository; None without git."""
    if BUNDLED != ROOT:  # a wheel, which may be installed inside another repository
        return None
    try:
        return subprocess.run(
            ["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=True
        ).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _processor() -> str:
    """Return the name of the processor, with its family and model where the system gives them."""
    with suppress(OSError, KeyError):
        lines = re.findall(r"^([\w ]+?)\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
        return "{model name}, family {cpu family}, model {model}".format_map(dict(lines))
    return platform.processor() or platform.machine() or "unknown"


# Of an address: what is before its password, which is not the port of a server, and what is after it.
_PASSWORD = re.compile(r"""([a-z][\w+.-]*://[^/@:\s]*:)(?!\d+/|\*\*\*@)(\S*)(@[^\s'"]*)""")
_PORTS = {"http": 80, "https": 443, "postgresql": 5432, "mysql": 3306, "mssql": 1433}
# Settings without effect on results.
_STEERING = ("shard", "tracking", "trust")
NETWORK = ("representation", "model", "fusion", "optimizer", "trainer")
"""Groups that a network consists of."""


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
        if self.threads is not None and self.threads < 1:
            raise InputError(f"tracking.threads={self.threads} must be at least 1, or null")


@dataclass(frozen=True)
class Config:
    """A checked configuration of a skin or a training, in plain containers.

    What it does not set is None, a group that it lacks empty. Groups without a type here are checked by their
    class. What a command adds is an annotated parameter of its function.
    """

    row: str | None = None
    seed: int = 0
    task: str | None = None
    epochs: dict[str, int] = field(default_factory=dict)
    limits: dict[str, Any] = field(default_factory=dict)
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
    trust: bool = False
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
    """Return whether the server of a tracking URI accepts connections within 5 s; True for a file."""
    address = urlsplit(uri or "")
    port = address.port or _PORTS.get(address.scheme.partition("+")[0])
    with suppress(OSError):
        if address.hostname and port is not None:
            socket.create_connection((address.hostname, port), timeout=5.0).close()
        return True
    return False


def check_server(uri: str | None) -> None:
    """Check that the server of a tracking URI answers, before anything heavy is imported.

    Raises:
        InputError: it does not.
    """
    if not answers(uri):
        raise InputError(
            f"the tracking server {uri} does not answer: start it, open the tunnel to it, or correct "
            "tracking.uri; without it, finished runs are not known, and nothing begins"
        )


def validate_config(config: Any) -> Config:
    """Return a configuration that fits the schema, with every interpolation resolved.

    Args:
        config: as Hydra composes it, in which settings of a verb are left out; or in plain containers.

    Raises:
        InputError: a key or a value does not fit, or an interpolation cannot be resolved.
    """
    try:
        # Before a learner gets the settings of its optimizer, which have names of their own.
        check_numbers(OmegaConf.to_container(config) if isinstance(config, DictConfig) else config)
        if isinstance(config, DictConfig):
            plain = plain_settings(config)
            config = {name: plain[name] for name in Config.__annotations__ if name in plain}
        return cast(Config, OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(Config), config)))
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error


def refuse_unknown(config: DictConfig, own: Sequence[str] = ()) -> None:
    """Raise InputError where a composed configuration has a setting that neither it nor a verb knows.

    Args:
        config: as Hydra composes it.
        own: settings of the verb alone.
    """
    if unknown := {*config} - {"hydra", *Config.__annotations__, *own}:
        raise InputError(f"there is no setting {', '.join(map(str, unknown))}: --help lists them")


def plain_settings(config: DictConfig) -> dict[str, Any]:
    """Return a composed configuration in plain containers, without Hydra's own settings."""
    own = OmegaConf.masked_copy(config, [str(name) for name in config if name != "hydra"])
    return OmegaConf.to_container(own, resolve=True)  # type: ignore[return-value]


def check_numbers(settings: Any) -> None:
    """Raise InputError for numbers that no setting takes."""
    # NaN would pass most comparisons, and numbers of more than 64 bits overflow in arrays.
    for path, value in walk_settings(settings):
        unfit = "too large" if isinstance(value, int) and abs(value) >= 2**63 else ""
        if unfit or (isinstance(value, float) and isnan(value)):
            raise InputError(f"{'.'.join(path)} is {unfit or 'nan'}: give a number")
        counted = path in (("seconds",), ("gestures",), ("n",))  # settings of commands
        if counted and isinstance(value, int | float) and value < 0:
            raise InputError(f"{path[0]}={value:g} is below 0: give a number above 0")


def settings_of(config: Config) -> dict[str, Any]:
    """Return what a configuration sets, in plain containers."""
    return {key: value for key, value in asdict(config).items() if value not in (None, {})}


def settings_hash(settings: Mapping[str, Any]) -> str:
    """Return a hash of everything that results depend on, 16 digits: settings, files they name, version."""
    content = {key: value for key, value in settings.items() if key not in _STEERING}
    texts = {value for _, value in walk_settings(content) if isinstance(value, str)}
    files = {text: hashlib.sha256(path.read_bytes()).hexdigest() for text in texts if (path := _file(text))}
    text = json.dumps([_counted(content), files, __version__], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def fingerprint(config: Config) -> str:
    """Return a hash of everything that the results of a configuration depend on."""
    # Unset keys belong to other commands; a new command must not change the fingerprint of finished runs.
    return settings_hash(settings_of(config))


def tags(config: Config) -> dict[str, str]:
    """Return the tags that identify a run."""
    return {
        "fingerprint": fingerprint(config),
        "row": str(config.row),
        "simulator": simulator(config.device),
        "seed": str(config.seed),
    }


def simulator(device: Mapping[str, Any]) -> str:
    """Return the name of the simulator of a device, in its settings; without one, of the device."""
    name = "simulator" if "simulator" in device else "device"
    return name_option(device["simulator"] if name == "simulator" else device, name)


def name_option(part: Mapping[str, Any], name: str) -> str:
    """Return the name of the option that a part of a configuration, called ``name``, builds."""
    if "_target_" not in part:
        raise InputError(f"{name} chooses no option: leave it out, or give one that --help lists")
    return option_name(import_target(part["_target_"], f"{name}._target_"))


def name_run(identity: Mapping[str, str], changes: Mapping[str, str]) -> str:
    """Return the name of a run: its row, simulator, other changes and seed.

    Args:
        identity: as of :func:`tags`.
        changes: as of :func:`relevant_overrides`.
    """
    # The first ones are in the name in any case; the others choose the machine.
    omitted = ("experiment", "row", "seed", "simulator", *(f"trainer.{name}" for name in MACHINE))
    words = [f"{key.split('.')[-1]}={value}" for key, value in changes.items() if key not in omitted]
    name = " ".join(filter(None, (identity["row"], identity["simulator"], *words)))
    return shorten(name, f" seed {identity['seed']}")


def shorten(name: str, end: str = "") -> str:
    """Return the name of a run with its end, in at most 80 characters; other names stay other ones.

    The table of runs and the legends of charts show 80 characters.
    """
    other = f" {hashlib.sha256(name.encode()).hexdigest()[:8]}{end}"
    return name + end if len(name + end) <= 80 else name[: 80 - len(other)] + other


def relevant_overrides(learner: Mapping[str, Any]) -> dict[str, str]:
    """Return the overrides of the running command that affect its result; empty without a command.

    Args:
        learner: settings of its learner.
    """
    if not HydraConfig.initialized():
        return {}
    unused = unused_groups(learner)
    return {
        override.key_or_group: override.get_value_element_as_str()
        for override in OverridesParser.create().parse_overrides(overrides())
        if not override.is_delete()
        and not override.key_or_group.startswith(("hydra", "sweep", *_STEERING))
        and override.key_or_group.split(".")[0] not in unused
    }


def unused_groups(learner: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the groups that have no part in a run, because its learner holds no network."""
    return () if any("model" in path for path, _ in walk_settings(learner)) else NETWORK


def overrides() -> list[str]:
    """Return the overrides on the command line of the running command."""
    return list(HydraConfig.get().overrides.task)


# A run composed again, with the overrides of a command line.


# What the weights of a run depend on.
_FIXED = (
    "representation",
    "model",
    "fusion",
    "learner",
    "limits",
    "optimizer",
    "trainer",
    "experiment",
    "sweep",
    "seed",
)
# Groups of the skin and its touches, in the order of conf/skin.yaml; the others of a run come after them.
_SKIN = ("touch", "layout", "simulator", "contact", "device", "profile", "data", "body")


def recompose(stored: Config, overrides: Sequence[str]) -> Config:
    """Return the configuration of a run with the overrides of a command line, which Hydra composes over it.

    An option that the command line chooses replaces its group. It may set more than that: the file of a skin
    in docs/your-skin.md has a body, positions and a simulator.

    Args:
        stored: as :attr:`skin.runs.run.FinishedRun.stored` gives it.
        overrides: of the command line; those of a run count, and those of ``tracking``.

    Raises:
        InputError: an override, or an option, changes a setting that the weights depend on.
    """
    if not GlobalHydra.instance().is_initialized():  # in Python, not in a command
        with initialize_config_dir(str(CONF), version_base=None):
            return recompose(stored, overrides)
    parsed = OverridesParser.create().parse_overrides(list(overrides))
    lines = {override.key_or_group: str(override.input_line) for override in parsed}
    groups = {key: key.split(".")[0].split("/")[0] for key in lines}
    if fixed := [key for key, group in groups.items() if group in _FIXED]:
        raise InputError(f"{fixed[0]} was fixed when the run was trained: leave it out, or train another run")
    keys = [key for key, group in groups.items() if group in (*_SKIN, "task", "evaluation")]
    general = [key for key, group in groups.items() if group in ("hydra", "tracking")]
    fresh = compose("train", [lines[key] for key in (*general, *keys)])
    run = _restored(stored, _raw(fresh.device))
    whole = _compose_options(
        run, [lines[key] for key, group in groups.items() if key in _SKIN or group == "hydra"]
    )
    for group in _SKIN:
        other = (whole.get(group) or {}) != (run.get(group) or {}) and (
            (fresh.get(group) or {}).get("_target_") != (run[group] or {}).get("_target_")
        )
        if group in fresh and (group in keys or other):
            whole[group] = _raw(fresh)[group]
    for key in keys:
        if key not in _SKIN:
            # Unresolved, so that a device refers to the simulator of this run.
            OmegaConf.update(whole, key, reduce(getitem, key.split("."), _raw(fresh)), merge=False)
    whole.tracking = fresh.tracking
    leaves = iterate_leaves({group: _raw(whole)[group] for group in _FIXED if group in whole})
    changed = [name for path, value in leaves if OmegaConf.select(run, name := ".".join(path)) != value]
    # An alarm at other limits than those that the run learned would be late.
    changed += [
        f"{touch}.{name}"
        for touch in ("touch", "device.touch")
        for name in ("limits", "thresholds.pressure")
        if (settings := OmegaConf.select(whole, touch))
        and (OmegaConf.select(settings, name) or {}) != (OmegaConf.select(run.touch, name) or {})
    ]
    if changed:
        raise InputError(
            f"{changed[0]} was fixed when the run was trained: leave it out, also of the option that sets "
            "it, or train another run"
        )
    return validate_config(whole)


def _restored(stored: Config, device: Mapping[str, Any]) -> DictConfig:
    """Return the settings of a run, with the interpolations of its device to other groups.

    Stored configurations are resolved; without this ``simulator=naive`` would not reach ``device.simulator``.

    Args:
        stored: the run.
        device: settings of a composed device, with interpolations.
    """
    run = OmegaConf.create(asdict(stored))
    for name, value in device.items():
        refers = isinstance(value, str) and value.startswith("${") and name in run.device
        if refers and OmegaConf.select(run, value[2:-1]) == run.device[name]:
            run.device[name] = value
    return run


def _compose_options(run: DictConfig, options: Sequence[str]) -> DictConfig:
    """Return the settings of a run with those of chosen options over them."""
    settings = {key: value for key, value in _raw(run).items() if value not in (None, {})}
    skin = {key: value for key, value in settings.items() if key in _SKIN}
    defaults = ["stored_skin", *({group: None} for group in _SKIN), "_self_"]
    ConfigStore.instance().store("stored_skin", skin)
    ConfigStore.instance().store(
        "stored_run",
        {"defaults": defaults} | {key: value for key, value in settings.items() if key not in skin},
    )
    return OmegaConf.create(_raw(run) | _raw(compose("stored_run", list(options))))


def iterate_leaves(
    settings: dict[str, Any], above: tuple[str, ...] = ()
) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Yield all values with their paths; a list is one value."""
    for name, value in settings.items():
        if isinstance(value, dict) and value:
            yield from iterate_leaves(value, (*above, name))
        else:
            yield (*above, name), value


def _raw(config: DictConfig) -> dict[str, Any]:
    """Return plain containers with interpolations as they stand."""
    return OmegaConf.to_container(config, resolve=False)  # type: ignore[return-value]

"""The configuration: its schema, its fingerprint, and the entry point of every command.

Only Hydra is imported here: ``--help`` and a mistyped key must not import torch.
"""

from skin import interrupt  # isort: skip
import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import wraps
from math import isnan
from pathlib import Path
from typing import Any, cast

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin.errors import InputError
from skin.identity import digest
from skin.refusal import Refused, refusal, sentence

__all__ = [
    "CONF",
    "ROOT",
    "Config",
    "DictConfig",
    "checked",
    "command",
    "fingerprint",
    "interrupt",
    "overrides",
    "plain",
]

ROOT = Path(__file__).parents[1]
CONF = ROOT / "conf"

# They steer a run and change none of its results.
_STEERING = ("tracking", "trust")


@dataclass
class Data:
    """How many gestures a training draws (``conf/data``)."""

    name: str
    gestures: int
    padded: bool
    fresh: bool
    batch_size: int
    # Older runs have none of these.
    stream: bool = False
    direction: bool = False
    augment: dict[str, Any] = field(default_factory=dict)


@dataclass
class Evaluation:
    """On what a trained learner is tried (``conf/train.yaml``)."""

    devices: int
    layouts: int
    gestures: int
    false_alarm_rate: float
    safe_gestures: int = 5000  # older runs have none


@dataclass
class Tracking:
    """Where runs are logged, and whether finished ones are skipped (``conf/train.yaml``)."""

    uri: str | None
    artifacts: str | None
    experiment: str
    resume: bool
    threads: int | None


@dataclass
class Config:
    """What may stand at the top of a configuration; groups without a type here belong to their class."""

    row: str
    seed: int
    epochs: dict[str, int]
    touch: dict[str, Any]
    body: dict[str, Any]
    layout: dict[str, Any]
    simulator: dict[str, Any]
    device: dict[str, Any]
    representation: dict[str, Any]
    model: dict[str, Any]
    fusion: dict[str, Any]
    learner: dict[str, Any]
    data: Data
    optimizer: dict[str, Any]
    trainer: dict[str, Any]
    evaluation: Evaluation
    tracking: Tracking
    contact: dict[str, Any] | None = None  # older runs have none
    # What a command other than training adds.
    run: str | None = None
    trust: bool = False
    n: int | None = None
    out: str | None = field(default=None)
    view: str | None = None
    labels: list[str] | None = None
    shape: str | None = None
    index: int | None = None
    rows: Any = None
    stream: dict[str, Any] | None = None
    embeddings: dict[str, Any] | None = None
    moving: dict[str, Any] | None = None
    session: str | None = None
    presses: str | None = None
    calibrate: dict[str, Any] | None = None
    dead: dict[str, Any] | None = None
    port: str | None = None
    link: str | None = None
    seconds: float | None = None
    web: bool | None = None
    live: dict[str, Any] | None = None
    gestures: int | None = None
    format: str | None = None
    emulate: dict[str, Any] | None = None
    faults: dict[str, Any] | None = None
    record: dict[str, Any] | None = None
    compare: dict[str, Any] | None = None
    direction: dict[str, Any] | None = None
    physics: dict[str, Any] | None = None
    holds: dict[str, Any] | None = None


def checked(config: DictConfig) -> DictConfig:
    """Return a configuration that fits the schema, read-only.

    Raises:
        InputError: a key or a value does not fit.
    """
    try:
        whole = OmegaConf.merge(OmegaConf.structured(Config), config)
    except OmegaConfBaseException as error:
        raise InputError(sentence(error)) from error
    assert isinstance(whole, DictConfig)
    # It would pass every comparison that is not written for it.
    for name in _not_numbers(OmegaConf.to_container(whole)):
        raise InputError(f"{name} is nan: give a number")
    OmegaConf.set_readonly(whole, True)
    return whole


def _not_numbers(value: Any, name: str = "") -> Iterator[str]:
    """Yield the names of settings that are NaN."""
    if isinstance(value, float) and isnan(value):
        yield name
    elif isinstance(value, dict | list):
        for key, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _not_numbers(one, f"{name}.{key}" if name else str(key))


def plain(config: DictConfig) -> dict[str, Any]:
    """Return a configuration with every interpolation resolved, as plain containers.

    Raises:
        InputError: an interpolation leads nowhere.
    """
    try:
        return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise InputError(sentence(error)) from error


def fingerprint(config: DictConfig) -> str:
    """Return a hash of what a run's result depends on: configuration, the files it names, version."""
    # What is not set belongs to other commands; a new command must not make every finished run look unknown.
    groups = plain(config).items()
    content = {key: value for key, value in groups if key not in _STEERING and value is not None}
    return digest(content)


def overrides() -> list[str]:
    """Return what the command line of a running command asks for."""
    return list(HydraConfig.get().overrides.task)


def command(name: str = "train") -> Callable[[Callable[[DictConfig], Any]], Callable[[], None]]:
    """Make a command of a function that takes a checked configuration.

    Bad input ends it with one sentence and exit code 2. In a multirun the job fails and the others run on.

    Args:
        name: the primary configuration, a file in ``conf/``.
    """

    def decorate(task: Callable[[DictConfig], Any]) -> Callable[[], None]:
        started = []

        @wraps(task)
        def job(config: DictConfig) -> Any:
            started.append(True)
            try:
                return task(checked(config))
            except Exception as error:
                refused = refusal(error)
                if refused is None:
                    raise
                if HydraConfig.get().mode == RunMode.MULTIRUN:
                    raise Refused(str(refused)) from error
                print(refused, file=sys.stderr)
                sys.exit(2)

        composed = hydra.main(version_base="1.3", config_path=str(CONF), config_name=name)(job)

        def main() -> None:
            # Neither the shell nor Hydra's grammar knows ~ in device.path=~/x.csv.
            sys.argv[1:] = [value.replace("=~/", f"={Path.home()}/", 1) for value in sys.argv[1:]]
            warnings.formatwarning = lambda message, *_: f"warning: {message}\n"
            try:
                composed()
            except SystemExit as stop:
                # Hydra ends with 1 where the configuration could not be composed.
                if stop.code == 1 and not started:
                    sys.exit(2)
                raise

        return main

    return decorate

"""The configuration: its schema and its fingerprint.

Only Hydra is imported here: ``--help`` and a mistyped key must not import torch.
"""

from skin import interrupt  # noqa: F401  # isort: skip
import socket
from collections.abc import Iterator
from dataclasses import dataclass, field
from math import isnan
from typing import Any, cast
from urllib.parse import urlsplit

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin.error_messages import one_line
from skin.errors import InputError
from skin.evaluation.settings import Evaluation
from skin.fingerprint import config_hash

_TOO_LARGE = 2**63
_PATIENCE = 5.0  # s until a server that accepts no connection counts as away
PARENT = "SKIN_PARENT_RUN"
"""Environment variable by which a sweep tells its jobs the id of their parent run."""

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

    uri: str | None
    artifacts: str | None
    experiment: str
    resume: bool
    threads: int | None


@dataclass
class Config:
    """Top-level keys of a configuration; groups without a type here are checked by their class."""

    row: str | None = None
    seed: int | None = None
    epochs: dict[str, int] | None = None
    touch: dict[str, Any] | None = None
    body: dict[str, Any] | None = None
    layout: dict[str, Any] | None = None
    simulator: dict[str, Any] | None = None
    device: dict[str, Any] | None = None
    representation: dict[str, Any] | None = None
    model: dict[str, Any] | None = None
    fusion: dict[str, Any] | None = None
    learner: dict[str, Any] | None = None
    data: Data | None = None
    optimizer: dict[str, Any] | None = None
    trainer: dict[str, Any] | None = None
    evaluation: Evaluation | None = None
    tracking: Tracking | None = None
    contact: dict[str, Any] | None = None
    shard: str | None = None
    # What a command other than training adds.
    run: str | None = None
    name: str | None = None
    licence: str | None = None
    trust: bool = False
    n: int | None = None
    out: str | None = field(default=None)
    view: str | None = None
    labels: list[str] | None = None
    shape: str | None = None
    index: int | None = None
    session: str | None = None
    presses: str | None = None
    calibrate: dict[str, Any] | None = None
    port: str | None = None
    link: str | None = None
    seconds: float | None = None
    web: bool | None = None
    demo: bool | None = None
    live: dict[str, Any] | None = None
    export: dict[str, Any] | None = None
    gestures: int | None = None
    format: str | None = None
    emulate: dict[str, Any] | None = None
    faults: dict[str, Any] | None = None
    record: dict[str, Any] | None = None
    compare: dict[str, Any] | None = None
    study: dict[str, Any] | None = None
    smoke: bool | None = None
    table: dict[str, Any] | None = None
    results: dict[str, Any] | None = None
    design: dict[str, Any] | None = None
    adapt: dict[str, Any] | None = None


def is_server(uri: str | None) -> bool:
    """Return whether a tracking URI is the address of a server, not of a database."""
    return uri is not None and uri.startswith(("http://", "https://"))


def answers(uri: str | None) -> bool:
    """Return whether the server of a tracking URI accepts connections; True for a database."""
    if uri is None or not is_server(uri):
        return True
    place = urlsplit(uri)
    port = place.port or (443 if place.scheme == "https" else 80)
    try:
        socket.create_connection((place.hostname or "", port), timeout=_PATIENCE).close()
    except OSError:
        return False
    return True


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


def validate_config(config: DictConfig) -> DictConfig:
    """Return a configuration that fits the schema, read-only.

    Raises:
        InputError: a key or a value does not fit.
    """
    try:
        whole = OmegaConf.merge(OmegaConf.structured(Config), config)
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error
    assert isinstance(whole, DictConfig)
    # NaN would pass most comparisons, and numbers of more than 64 bits overflow in arrays.
    for name, reason in _not_numbers(OmegaConf.to_container(whole)):
        raise InputError(f"{name} is {reason}: give a number")
    OmegaConf.set_readonly(whole, True)
    return whole


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


def _not_numbers(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Yield the names of settings that are NaN or too large, with what they are."""
    if isinstance(value, float) and isnan(value):
        yield name, "nan"
    elif isinstance(value, int) and abs(value) >= _TOO_LARGE:
        yield name, "too large"
    elif isinstance(value, dict | list):
        for key, one in value.items() if isinstance(value, dict) else enumerate(value):
            yield from _not_numbers(one, f"{name}.{key}" if name else str(key))


def plain(config: DictConfig) -> dict[str, Any]:
    """Return a configuration with every interpolation resolved, as plain containers.

    Raises:
        InputError: an interpolation cannot be resolved.
    """
    try:
        return cast(dict[str, Any], OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise InputError(one_line(error)) from error


def fingerprint(config: DictConfig) -> str:
    """Return a hash of everything that results depend on: configuration, files it names, version."""
    # Unset keys belong to other commands; a new command must not change the fingerprint of finished runs.
    groups = plain(config).items()
    content = {key: value for key, value in groups if key not in _STEERING and value is not None}
    return config_hash(content)


def overrides() -> list[str]:
    """Return the overrides on the command line of the running command."""
    return list(HydraConfig.get().overrides.task)

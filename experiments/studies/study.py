"""Studies: what is trained, on what it is tried, and the statements that this decides (``conf/study``)."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.utils import get_object, instantiate
from omegaconf import DictConfig

from skin.config import overrides, plain, validate_config
from skin.errors import InputError
from skin.paths import CONF
from skin.settings import check_settings, configured
from skin.sweep import sweep_jobs

SMOKE = (
    "data.gestures=80",
    "device.test_gestures=48",
    "trainer.max_epochs=1",
    "evaluation.devices=0",
    "evaluation.layouts=0",
    "evaluation.safe_gestures=48",
    "tracking.experiment=smoke",
)
"""Overrides that shrink every run to a second; its scores are to be ignored."""
_OWN = ("study", "smoke", "out", "shard")
_NAMED = ("experiment", "simulator", "row")


Claim = Literal["greater", "less", "alike", "no better", "at most", "about", "ratio"]
"""What a statement says of two figures (:func:`experiments.studies.comparison.verdict`)."""


@dataclass(frozen=True)
class Statement:
    """A sentence that runs can test; ``conf/study.yaml`` explains the fields."""

    id: str
    says: str
    one: Mapping[str, str]
    metric: str
    claim: Claim
    section: str = ""
    others: Sequence[Mapping[str, str]] = ()
    level: float | None = None
    by: float = 0.0


@dataclass(frozen=True)
class Variant:
    """The configurations of one variant.

    Attributes:
        name: what tells it from the others of its study.
        chosen: the settings that its study gives it, as key -> value.
        configs: seed -> configuration.
    """

    name: str
    chosen: Mapping[str, str]
    configs: dict[str, DictConfig]


@dataclass(frozen=True)
class Study:
    """A comparison of runs; ``conf/study.yaml`` explains the fields.

    Raises:
        InputError: a setting that cannot be used.
    """

    name: str
    about: str
    seeds: Annotated[Sequence[Annotated[int, Ge(0)]], MinLen(1)]
    trainings: Sequence[Any] = ()
    common: Mapping[str, Any] = field(default_factory=dict)
    train: bool = True
    ensembles: Sequence[str] = ()
    rows: str | Sequence[str] | None = None
    run: str | None = None
    conditions: Mapping[str, Any] = field(default_factory=dict)
    test: Mapping[str, Any] = field(default_factory=dict)
    devices: Annotated[int, Ge(0)] = 0
    numbered: Sequence[str] = ()
    measure: Any = None
    metrics: Sequence[str] = ()
    differences: Claim | None = None
    statements: Sequence[Statement] = ()
    minutes: float | None = None
    axis: str | None = None

    @classmethod
    def of(cls, config: DictConfig) -> "Study":
        """Return the study of a configuration of ``skin study``.

        Raises:
            InputError: none is chosen, or a setting that it does not have or take.
        """
        name = HydraConfig.get().runtime.choices.get("study")
        if not name:
            known = ", ".join(sorted(path.stem for path in (CONF / "study").glob("*.yaml")))
            raise InputError(f"which study? choose one of {known}, as in study=norm")
        settings = plain(config)["study"]
        settings["name"] = settings["name"] or name
        check_settings(cls, settings, "study")
        statements = [
            configured(Statement, one, f"study.statements[{number}]")
            for number, one in enumerate(settings["statements"])
        ]
        if settings["measure"]:
            part = settings["measure"]
            check_settings(get_object(part["_target_"]), part, "study.measure")
            settings["measure"] = instantiate(part)
        if isinstance(settings["rows"], str) and settings["rows"] != "all":
            settings["rows"] = [settings["rows"]]
        return cls(**settings | {"statements": statements})


def passed_overrides() -> list[str]:
    """Return the overrides of the command line that are for trainings, or change finished runs' devices.

    What the default training does not have must be added (``+``), though a study's trainings may have it.
    """
    found = [one for one in overrides() if _key(one).split(".")[0] not in _OWN]
    return [f"++{one.lstrip('+')}" if one.startswith("+") else one for one in found]


def as_overrides(settings: Mapping[str, Any]) -> list[str]:
    """Return settings as overrides; a list is swept."""
    return [f"{key}={_text(value)}" for key, value in settings.items()]


def sweeps(study: Study, smoke: bool = False) -> Iterator[tuple[Mapping[str, Any], list[str]]]:
    """Yield each sweep that trains a study's variants: its own settings, and all of its overrides."""
    last = [f"seed={_text(study.seeds)}", *(SMOKE if smoke else ()), *passed_overrides()]
    rows = {} if study.rows is None else {"experiment": study.rows}
    fixed = {_key(one) for one in last}
    for block in study.trainings:
        own = {key: value for key, value in (block | rows).items() if key not in fixed}
        settings = {key: value for key, value in own.items() if key != "name"}
        shared = {key: value for key, value in study.common.items() if key not in own}
        yield own, [*as_overrides(settings), *as_overrides(shared), *last]


def variants(study: Study, smoke: bool = False) -> list[Variant]:
    """Return every variant that a study trains, with its configurations."""
    found = [one for block, line in sweeps(study, smoke) for one in _variants(block, line)]
    shared = set.intersection(*(set(named.items()) for named, _ in found)) if found else set()
    return [
        replace(one, name=" ".join(_short(*item) for item in named.items() if item not in shared))
        for named, one in found
    ]


def _variants(block: Mapping[str, Any], line: Sequence[str]) -> list[tuple[dict[str, str], Variant]]:
    """Return each variant of a sweep, with what may name it."""
    name, found = block.get("name"), dict[tuple[str, ...], tuple[dict[str, str], Variant]]()
    for job in sweep_jobs(list(line), {}):
        chosen = {key: job[key] for key in block if key != "name"}
        named = {
            key: value
            for key, value in chosen.items()
            if isinstance(block[key], list) or (not name and key in _NAMED)
        }
        config = validate_config(compose("train", [f"{key}={value}" for key, value in job.items()]))
        start = {"name": name} if name else {}
        _, variant = found.setdefault(
            tuple(chosen.values()), (start | named, Variant("", start | chosen, {}))
        )
        variant.configs[str(config.seed)] = config
    return list(found.values())


def _short(key: str, value: str) -> str:
    """Return a choice for a person: names, rows and simulators stand for themselves."""
    return value if key in ("name", *_NAMED) else f"{key.rpartition('.')[2]}={value}"


def _text(value: Any) -> str:
    """Return a value as an override has it."""
    if isinstance(value, list | tuple):
        return ",".join(map(_text, value))
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _key(override: str) -> str:
    return override.lstrip("+~").split("=")[0]

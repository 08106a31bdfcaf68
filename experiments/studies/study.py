"""Compare variants of trainings, or finished runs under conditions; give verdicts on statements.

    skin study study=table
    skin study study=models study.part=norm
    skin study -m study=models study.part=norm,ensemble simulator=naive
    skin study study=robustness study.part=dead study.rows=[features,gru]
    skin study study=margins study.run=latest
    skin study study=robustness study.part=[known_loads,known_loads_alarm]

A study is a file of conf/study; study.part=NAME chooses a comparison of a file with several. It trains the
runs that are missing, with the budget in that file; rerun to resume. Writes study_<name>.md, .csv and .png
into out=, with the name of the study or the part. A measure of single runs, such as margins, writes files for
each, and of several runs study_<name>.csv with all values. A study without runs measures skins, and writes
<name>.md, .csv and .png. Measurements are kept in results/trials.
"""

import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen
from hydra import compose
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.utils import get_object, instantiate
from omegaconf import OmegaConf

from experiments import peers
from skin.commands._command import command
from skin.core.files import CONF, results
from skin.core.settings import check_settings, configured
from skin.errors import InputError
from skin.runs.configuration import Config, overrides, validate_config
from skin.runs.sweep import sweep_jobs

_OWN = ("study", "smoke", "out", "shard")
_NAMED = ("experiment", "simulator", "row")
MEASURE = "measure."
"""Beginning of the names of conditions that are settings of the measure."""


@dataclass(frozen=True)
class Statement:
    """A sentence that runs can test; ``conf/study.yaml`` explains the fields.

    The quantity is ``one`` - other, or ``one`` / other; the sentence holds if it lies between ``minimum`` and
    ``maximum``.
    """

    id: str
    says: str
    one: Mapping[str, str]
    metric: str
    section: str = ""
    others: Sequence[Mapping[str, str]] = ()
    level: float | None = None
    ratio: bool = False
    minimum: float = float("-inf")
    maximum: float = float("inf")
    over_gestures: float = 0.0


@dataclass(frozen=True)
class Variant:
    """The configurations of one variant.

    Attributes:
        name: what tells it from the others of its study.
        chosen: the settings that its study gives it, as key -> value.
        configs: seed -> configuration.
        trained: whether the study trains it; else it is shown where it has finished.
    """

    name: str
    chosen: Mapping[str, str]
    configs: dict[str, Config]
    trained: bool = True


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
    finished: Sequence[Any] = ()
    vote: str | Sequence[str] = ()
    reference: str | None = None
    report_figures: bool = False
    jobs: Annotated[int, Ge(1)] = 1
    small: Sequence[str] = ()
    rows: str | Sequence[str] | None = None
    run: str | None = None
    conditions: Mapping[str, Any] = field(default_factory=dict)
    test: Mapping[str, Any] = field(default_factory=dict)
    devices: Annotated[int, Ge(0)] = 0
    numbered: Sequence[str] = ()
    measure: Any = None
    metrics: Sequence[str] = ()
    differences: Literal["greater", "less"] | None = None
    statements: Sequence[Statement] = ()
    minutes: float | None = None
    axis: str | None = None

    @property
    def has_runs(self) -> bool:
        """Whether runs are measured; else the skin of the command."""
        return bool(self.trainings) or self.rows is not None or self.run is not None


def chosen_studies(settings: dict[str, Any]) -> list[Study]:
    """Return the comparisons that a configuration of ``skin study`` chooses: its study, or parts of it.

    A part has the settings of the study, then its own, then those of the command line.

    Raises:
        InputError: no study or part is chosen, or a setting that it does not have or take.
    """
    option = HydraConfig.get().runtime.choices.get("study")
    if not option:
        options = ", ".join(sorted(path.stem for path in (CONF / "study").glob("*.yaml")))
        raise InputError(f"which study? choose one of {options}, as in study=models")
    settings = dict(settings)
    parts, part = settings.pop("parts"), settings.pop("part")
    names = [*parts] if part is None else [part] if isinstance(part, str) else part
    if unknown := [name for name in names if name not in parts]:
        options = ", ".join(parts) or "none"
        raise InputError(f"study.part={unknown[0]} is none of the parts of study={option}: {options}")
    if not parts:
        return [configured_study(settings, option)]
    if settings["name"] and len(names) > 1:
        raise InputError(
            f"study.name={settings['name']} names one part: choose it, as in study.part={names[0]}"
        )
    return [configured_study(_with_command_line(settings | parts[name]), name) for name in names]


def _with_command_line(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of a part with those of the command line, which are not for the choice of parts."""
    changed = OmegaConf.create({**settings})
    words = [word.lstrip("+") for word in overrides() if word.lstrip("+").startswith("study.")]
    for override in OverridesParser.create().parse_overrides(words):
        key = override.key_or_group.removeprefix("study.")
        if key.split(".")[0] not in ("part", "parts"):
            OmegaConf.update(changed, key, override.value(), force_add=True)
    return OmegaConf.to_container(changed, resolve=False)  # type: ignore[return-value]


def configured_study(settings: dict[str, Any], name: str) -> Study:
    """Return the study with some settings, checked."""
    settings["name"] = settings["name"] or name
    check_settings(Study, settings, "study")
    settings["statements"] = [
        configured(Statement, statement, f"study.statements[{number}]")
        for number, statement in enumerate(settings["statements"])
    ]
    if measure := settings["measure"]:
        check_settings(get_object(measure["_target_"]), measure, "study.measure")
        settings["measure"] = instantiate(measure)
    if isinstance(settings["rows"], str) and settings["rows"] != "all":
        settings["rows"] = [settings["rows"]]
    return Study(**settings)


def passed_overrides() -> list[str]:
    """Return the overrides of the command line that are for trainings, or change finished runs' devices.

    What the default training does not have must be added (``+``), though a study's trainings may have it.
    """
    words = [word for word in overrides() if _key(word).split(".")[0] not in _OWN]
    return [f"++{word.lstrip('+')}" if word.startswith("+") else word for word in words]


def as_overrides(settings: Mapping[str, Any]) -> list[str]:
    """Return settings as overrides; a list is swept."""
    return [f"{key}={_text(value)}" for key, value in settings.items()]


def sweeps(
    study: Study, blocks: Sequence[Mapping[str, Any]], smoke: bool = False
) -> Iterator[tuple[Mapping[str, Any], list[str]]]:
    """Yield each sweep of a study's trainings: its own settings, and all of its overrides."""
    last = [f"seed={_text(study.seeds)}", *(study.small if smoke else ()), *passed_overrides()]
    rows = {} if study.rows is None else {"experiment": study.rows}
    fixed = {_key(word) for word in last}
    for block in blocks:
        chosen = {key: value for key, value in {**block, **rows}.items() if key not in fixed}
        settings = {key: value for key, value in chosen.items() if key != "name"}
        common = {key: value for key, value in study.common.items() if value is not None}
        shared = {key: value for key, value in common.items() if key not in chosen}
        yield chosen, [*as_overrides(settings), *as_overrides(shared), *last]


def variants(study: Study, smoke: bool = False) -> list[Variant]:
    """Return every variant that a study trains or shows, with its configurations."""
    shown = () if study.rows is not None else study.finished
    blocks = [(True, *sweep) for sweep in sweeps(study, study.trainings, smoke)]
    blocks += [(False, *sweep) for sweep in sweeps(study, shown, smoke)]
    every = list[tuple[dict[str, str], Variant]]()
    for trained, block, line in blocks:
        # Rows of peers, which no study trains, are in a folder of their own.
        search = [] if trained else [f"hydra.searchpath=['file://{peers.CONF}']"]
        block_variants = dict[tuple[str, ...], tuple[dict[str, str], Variant]]()
        for job in sweep_jobs(line, {}):
            named, chosen = _settings(block, job)
            words = [*search, *(f"{key}={value}" for key, value in job.items())]
            config = validate_config(compose("train", words))
            new = named, Variant("", chosen, {}, trained)
            block_variants.setdefault(tuple(chosen.values()), new)[1].configs[str(config.seed)] = config
        every += block_variants.values()
    names = _names([named for named, _ in every])
    return [replace(variant, name=name) for name, (_, variant) in zip(names, every, strict=True)]


def trained_settings(study: Study) -> dict[str, Mapping[str, str]]:
    """Return the settings that a study gives each variant that it trains, by the variant's name."""
    rows = {} if study.rows is None else {"experiment": study.rows}
    pairs = []
    for block in study.trainings:
        chosen = {**block, **rows}
        words = as_overrides({key: value for key, value in chosen.items() if key != "name"})
        pairs += [_settings(chosen, job) for job in sweep_jobs(words, {})]
    return dict(zip(_names([named for named, _ in pairs]), (chosen for _, chosen in pairs), strict=True))


def _settings(block: Mapping[str, Any], job: Mapping[str, str]) -> tuple[dict[str, str], dict[str, str]]:
    """Return the settings of a job that may name its variant, and all that its study gives it."""
    chosen = {"name": block["name"]} if block.get("name") else {}
    swept = [key for key, value in block.items() if isinstance(value, list) or (not chosen and key in _NAMED)]
    return chosen | {key: job[key] for key in swept}, chosen | {
        key: job[key] for key in block if key != "name"
    }


def _names(every: Sequence[Mapping[str, str]]) -> list[str]:
    """Return a name for each variant, of what tells it from the others."""
    shared = set.intersection(*(set(named.items()) for named in every)) if every else set()
    return [" ".join(_short(*item) for item in named.items() if item not in shared) for named in every]


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


@command("study")
def main(config: Config, study: dict[str, Any], smoke: bool, out: str | None) -> None:
    """Train or find the runs of a study, measure them, and write and print the results."""
    folder = results(out) / ("smoke" if smoke else "")
    studies = chosen_studies(study)

    from experiments.studies.trials import run_study
    from skin.core.messages import quiet

    quiet()
    complete = [run_study(chosen, config, folder, smoke) for chosen in studies]
    if not all(complete):
        sys.exit(1)

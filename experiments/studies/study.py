"""Studies: the report's statements about variants, and the runs that test them."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf

from skin.config import CONF, ROOT, checked
from skin.errors import InputError
from skin.sweep import jobs

__all__ = [
    "SMOKE",
    "STATEMENTS",
    "Paired",
    "Statement",
    "Study",
    "Variant",
    "choose",
    "conclude",
    "paired",
    "read",
    "verdict",
]

STATEMENTS = ROOT / "data" / "report_statements.yaml"
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
FEWEST = 3
"""Paired seeds below which every verdict is ``undecided``."""


@dataclass(frozen=True)
class Statement:
    """A sentence of the report that runs can test; ``data/report_statements.yaml`` explains the fields."""

    id: str
    section: str
    says: str
    one: Mapping[str, str]
    metric: str
    claim: str
    others: Sequence[Mapping[str, str]] = ()
    level: float | None = None
    by: float = 0.0


@dataclass(frozen=True)
class Variant:
    """The configurations of one variant.

    Attributes:
        name: what tells it from the others of its sweep.
        chosen: the overrides of its sweep, as key -> value.
        configs: seed -> configuration.
    """

    name: str
    chosen: Mapping[str, str]
    configs: dict[str, DictConfig]


@dataclass(frozen=True)
class Study:
    """Statements about the variants that some sweeps train.

    Attributes:
        name: as the command takes it.
        about: what is varied.
        sweeps: files of ``conf/sweep``.
        minutes: estimated cost of three seeds on two idle cores.
        statements: what the report says.
        costly: whether ``all`` leaves it out.
        self_share: whether its table shows how much of a node's row is the node itself.
    """

    name: str
    about: str
    sweeps: Sequence[str]
    minutes: float
    statements: Sequence[Statement]
    costly: bool = False
    self_share: bool = False

    def __str__(self) -> str:
        cost = f"about {self.minutes:g} min with 3 seeds" + (", not among all" if self.costly else "")
        said = (f"  {one.section}  {one.says}" for one in self.statements)
        return "\n".join([f"{self.name}: {self.about} ({cost})", *said])

    def variants(self, overrides: Sequence[str]) -> list[Variant]:
        """Return every variant with its configurations, in the order of the sweeps.

        Args:
            overrides: of the command line, seeds among them.

        Raises:
            InputError: an override leaves more than one configuration for a variant and seed.
        """
        made = [each for sweep in self.sweeps for each in _composed(sweep, overrides)]
        common = set.intersection(*(set(chosen.items()) for chosen, _ in made))
        return [
            Variant(" ".join(_short(*item) for item in chosen.items() if item not in common), chosen, configs)
            for chosen, configs in made
        ]


@dataclass(frozen=True)
class Paired:
    """A difference or a ratio over seeds that two variants share.

    Attributes:
        mean: of one - other, or of one / other.
        error: standard error of that mean; infinite with a single seed.
        seeds: how many pairs there are.
    """

    mean: float
    error: float
    seeds: int


def read(path: Path = STATEMENTS) -> dict[str, Study]:
    """Return the studies of a file by name."""
    stored: Any = OmegaConf.to_container(OmegaConf.load(path))
    return {
        name: Study(name=name, **fields | {"statements": [Statement(**one) for one in fields["statements"]]})
        for name, fields in stored.items()
    }


def choose(studies: Mapping[str, Study], names: Sequence[str]) -> list[Study]:
    """Return the studies of those names; ``all`` stands for every one that is not costly.

    Raises:
        InputError: no name, or an unknown one.
    """
    known = f"give all or some of {', '.join(studies)}"
    if not names:
        raise InputError(f"which study? {known}")
    for name in names:
        if name not in (*studies, "all"):
            raise InputError(f"there is no study {name}: {known}")
    every = "all" in names
    return [study for name, study in studies.items() if name in names or (every and not study.costly)]


def paired(one: Mapping[str, float], other: Mapping[str, float], ratio: bool = False) -> Paired | None:
    """Compare two sets of figures seed by seed; None where they share no seed.

    The error is the sample deviation of the differences (or ratios) by the root of their number, as in a
    paired t-test.

    Args:
        one: seed -> figure.
        other: seed -> figure.
        ratio: take one / other instead of one - other.
    """
    pairs = [(one[seed], other[seed]) for seed in one if seed in other]
    each = [first / second if ratio else first - second for first, second in pairs]
    if not each:
        return None
    error = stdev(each) / math.sqrt(len(each)) if len(each) > 1 else math.inf
    return Paired(fmean(each), error, len(each))


def verdict(claim: str, found: Paired | None, by: float = 0.0) -> str:
    """Return ``agree``, ``disagree`` or ``undecided``.

    A claim is an interval in which the difference (for ``ratio``: the ratio) must lie. The verdict is
    ``agree`` if the mean with two standard errors on either side lies wholly inside, ``disagree`` if it lies
    wholly outside, else, and always with fewer than three paired seeds, ``undecided``.

    Args:
        claim: ``greater`` (0 to infinity), ``less`` (minus infinity to 0), ``alike`` (-by to by),
            ``no better`` (minus infinity to by), ``about`` or ``ratio`` (by / 2 to 2 by).
        found: the comparison, None without paired seeds.
        by: in the unit of the comparison.
    """
    least, most = {
        "greater": (0.0, math.inf),
        "less": (-math.inf, 0.0),
        "alike": (-by, by),
        "no better": (-math.inf, by),
        "about": (by / 2, 2 * by),
        "ratio": (by / 2, 2 * by),
    }[claim]
    if found is None or found.seeds < FEWEST:
        return "undecided"
    low, high = found.mean - 2 * found.error, found.mean + 2 * found.error
    if least < low and high < most:
        return "agree"
    return "disagree" if high < least or low > most else "undecided"


def conclude(verdicts: Sequence[str]) -> str:
    """Return the verdict of a statement about several others: it holds only if it holds against each."""
    if "disagree" in verdicts:
        return "disagree"
    return "agree" if verdicts and set(verdicts) == {"agree"} else "undecided"


def _composed(sweep: str, overrides: Sequence[str]) -> list[tuple[dict[str, str], dict[str, DictConfig]]]:
    """Return what a sweep chooses for each variant, and seed -> configuration."""
    parameters = OmegaConf.load(CONF / "sweep" / f"{sweep}.yaml").hydra.sweeper.params
    found: dict[tuple[str, ...], dict[str, DictConfig]] = {}
    with initialize_config_dir(str(CONF), version_base="1.3"):
        for job in jobs([f"sweep={sweep}", *overrides], parameters):
            configs = found.setdefault(tuple(job[key] for key in parameters), {})
            config = checked(compose("train", [f"{key}={value}" for key, value in job.items()]))
            if str(config.seed) in configs:
                raise InputError(
                    f"sweep={sweep} has several configurations of one variant and seed {config.seed}: "
                    "give every setting that the study is not about one value"
                )
            configs[str(config.seed)] = config
    return [(dict(zip(parameters, values, strict=True)), configs) for values, configs in found.items()]


def _short(key: str, value: str) -> str:
    """Return a choice for a person: rows and simulators by their name alone."""
    return value if key in ("experiment", "simulator") else f"{key.rpartition('.')[2]}={value}"

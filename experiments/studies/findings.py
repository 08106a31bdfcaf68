"""What a study found: the runs of each variant, and a verdict on each statement of the report."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from mlflow.entities import Run
from omegaconf import DictConfig

from skin.config import fingerprint
from skin.tracking import Store
from studies.study import Paired, Statement, Variant, conclude, paired, verdict

__all__ = ["COSTS", "Finding", "Outcome", "collect", "conclusions", "graph_share"]

COSTS = ("seconds_per_epoch", "parameters")
"""Metrics that are no shares."""


@dataclass(frozen=True)
class Finding:
    """The runs of one variant.

    Attributes:
        variant: what was run.
        runs: seed -> the newest run that finished.
        extra: further columns of the table, name -> text.
    """

    variant: Variant
    runs: Mapping[str, Run]
    extra: Mapping[str, str] = field(default_factory=dict)

    @property
    def missing(self) -> int:
        """How many seeds did not finish: failed, killed, or never started."""
        return len(self.variant.configs) - len(self.runs)

    def values(self, metric: str) -> dict[str, float]:
        """Return seed -> value of a metric, or of the difference ``a - b`` of two, where a run has it."""
        first, *rest = metric.split(" - ")
        logged = {seed: run.data.metrics for seed, run in self.runs.items()}
        return {
            seed: values[first] - sum(values[name] for name in rest)
            for seed, values in logged.items()
            if all(name in values for name in (first, *rest))
        }


@dataclass(frozen=True)
class Outcome:
    """A statement beside what was measured.

    Attributes:
        statement: of the report.
        compared: name of what it was compared with -> the comparison; shares in points of a hundred.
        verdict: agree, disagree or undecided.
    """

    statement: Statement
    compared: Mapping[str, Paired | None]
    verdict: str


def collect(store: Store, variants: Sequence[Variant], shares: bool = False) -> list[Finding]:
    """Return the finished runs of variants, found by the fingerprint of each configuration.

    Args:
        store: where runs are.
        variants: of a study.
        shares: add the column ``self``, :func:`graph_share` of a variant's graph.
    """
    findings = []
    for variant in variants:
        runs: dict[str, Run] = {}
        for seed, config in variant.configs.items():
            finished = store.find("FINISHED", fingerprint=fingerprint(config))
            if finished:
                runs[seed] = finished[0]
        extra = {}
        if shares and runs:
            extra = {"self": f"{graph_share(next(iter(variant.configs.values()))):.2f}"}
        findings.append(Finding(variant, runs, extra))
    return findings


def graph_share(config: DictConfig) -> float:
    """Return how much of its own row a node of the configured graph is, by ``self_share`` of the graphs."""
    from skin.build import build_data, build_device
    from skin.representation.graph import self_share

    data = build_data(config, build_device(config))
    graph = data.representation_for(data.touches("train").positions)
    return self_share(graph.adjacency)  # type: ignore[arg-type]


def conclusions(statements: Sequence[Statement], findings: Sequence[Finding]) -> list[Outcome]:
    """Return every statement with its comparisons and its verdict."""
    return [_outcome(statement, findings) for statement in statements]


def _outcome(statement: Statement, findings: Sequence[Finding]) -> Outcome:
    _, one = _figures(statement.one, statement.metric, findings)
    others = dict(_figures(other, statement.metric, findings) for other in statement.others)
    if statement.level is not None:
        scale = 1 if statement.metric in COSTS else 100
        others[f"{statement.level:g}"] = dict.fromkeys(one, scale * statement.level)
    compared = {name: paired(one, other, statement.claim == "ratio") for name, other in others.items()}
    verdicts = [verdict(statement.claim, found, statement.by) for found in compared.values()]
    return Outcome(statement, compared, conclude(verdicts))


def _figures(
    chosen: Mapping[str, str], metric: str, findings: Sequence[Finding]
) -> tuple[str, dict[str, float]]:
    """Return the name and, by seed, the figures of the variant that was so chosen; shares in per cent."""
    for finding in findings:
        if chosen.items() <= finding.variant.chosen.items():
            scale = 1 if metric in COSTS else 100
            values = finding.values(metric)
            return finding.variant.name, {seed: scale * value for seed, value in values.items()}
    return " ".join(chosen.values()), {}

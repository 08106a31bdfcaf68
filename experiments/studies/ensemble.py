"""Ensembles of several rows: votes and averaged probabilities."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from mlflow.entities import Run
from omegaconf import DictConfig, OmegaConf
from rich.console import Console
from rich.table import Table
from torch import Tensor

from skin.build import build_data, build_device, build_learner
from skin.config import fingerprint, plain
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.operating_point import choose, gestures
from skin.evaluation.report import columns, evaluate
from skin.labels import Task
from skin.recording import Touches, digest
from skin.reload import restore
from skin.run import conclude, describe, tags
from skin.tracking import Store
from studies.table import percent

__all__ = ["WAYS", "Outcome", "average", "combine", "decisions", "disagreement", "show", "vote"]

Way = Callable[[Tensor, Task], Tensor]
_DIFFER, _LEFT_OUT = "/disagreement", "left_out_"


@dataclass(frozen=True)
class Outcome:
    """What an ensemble is worth.

    Attributes:
        members: row -> metrics, of the rows that took part.
        ensembles: row -> metrics, one per way; ``same/<label>/disagreement`` and ``same/any/disagreement``
            are the shares of test gestures on which the members are not of one mind.
        missing: rows without a finished run.
        left_out: column -> the members that have no part in it, each with its reason.
    """

    members: dict[str, dict[str, float]]
    ensembles: dict[str, dict[str, float]]
    missing: tuple[str, ...]
    left_out: dict[str, str]


class _Known:
    """Answers to touches that all members saw before."""

    def __init__(self, chances: Mapping[str, Tensor], task: Task, way: Way) -> None:
        self._chances, self._task, self._way = chances, task, way

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probabilities (B, L) that the members give together."""
        chances = self._chances.get(digest(touches))
        if chances is None:
            raise InputError("no member takes these touches")
        return self._way(chances, self._task)


def decisions(chances: Tensor, task: Task) -> Tensor:
    """Return what members decide, (M, B, L), 0 or 1, from their probabilities (M, B, L).

    Of a direction, cosines of length 1.
    """
    if task.kind == "exclusive":
        return torch.nn.functional.one_hot(chances.argmax(-1), chances.shape[-1]).float()
    if task.direction:
        whole = torch.nn.functional.normalize(chances[..., -2:], dim=-1)
        return torch.cat([(chances[..., :-2] > 0.5).float(), whole], dim=-1)
    return (chances > 0.5).float()


def vote(chances: Tensor, task: Task) -> Tensor:
    """Return the share of members (M, B, L) that decide for each label, (B, L): a probability in M steps.

    A tie of an even number of members is a no.
    """
    return decisions(chances, task).mean(0)


def average(chances: Tensor, task: Task) -> Tensor:
    """Return the mean probability of members (M, B, L), (B, L)."""
    return chances.mean(0)


def disagreement(chances: Tensor, task: Task) -> dict[str, float]:
    """Return the shares of touches on which members (M, B, L) differ: per label, and ``any`` of them.

    A direction is left out: no two members say the same.
    """
    decided = decisions(chances, task)[..., : len(task.binary)]
    differs = decided.amax(0) != decided.amin(0)
    shares = dict(zip(task.binary, differs.float().mean(0).tolist(), strict=True))
    return shares | {"any": float(differs.any(1).float().mean())}


WAYS: dict[str, Way] = {"ensemble_vote": vote, "ensemble_average": average}
"""Row -> how it makes one answer of the members'."""


def combine(
    store: Store,
    members: Sequence[DictConfig],
    ways: Mapping[str, DictConfig],
    say: Callable[[str], None] = lambda doing: None,
) -> Outcome:
    """Evaluate ensembles of finished runs on every column and log each as a run of its own.

    What an ensemble of the same runs found before is not found again. Its run has the fingerprint of its
    configuration, by which the results table finds it, and the tag ``members`` with the ids of their runs.

    Args:
        store: of the members' runs and the ensembles'.
        members: configurations of one seed and simulator, one per row.
        ways: name in ``WAYS`` -> configuration of that seed and simulator, with the ensemble's ``row``.
        say: is told what happens.

    Raises:
        InputError: fewer than two members have a finished run.
    """
    runs = {config.row: _finished(store, config) for config in members}
    present = {row: run for row, run in runs.items() if run is not None}
    missing = tuple(row for row, run in runs.items() if run is None)
    if len(present) < 2:
        raise InputError(
            f"an ensemble needs two finished rows, got {', '.join(present) or 'none'} without "
            f"{', '.join(missing)}: skin train experiment={(missing or ('ROW',))[0]} makes one"
        )
    identity = " ".join(run.info.run_id for run in present.values())
    done = {name: _finished(store, config, members=identity) for name, config in ways.items()}
    if not all(done.values()):
        chosen = [(config, present[config.row]) for config in members if config.row in present]
        asked = _ask(store, chosen, build_device(next(iter(ways.values()))), say)
        for name, config in ways.items():
            say(f"evaluating {config.row}")
            done[name] = _log(store, config, asked, WAYS[name], identity)
    ensembles = {ways[name].row: run for name, run in done.items() if run is not None}
    return Outcome(
        {row: run.data.metrics for row, run in present.items()},
        {row: run.data.metrics for row, run in ensembles.items()},
        missing,
        _left_out(next(iter(ensembles.values()))),
    )


def show(outcome: Outcome, title: str, console: Console | None = None) -> None:
    """Print members and ensembles, overall accuracies in per cent, and how often the members differ."""
    console = console or Console()
    named = ("same", "holdout", "device_shift", "unseen_layout")
    table = Table("", *named, title=title)
    for row, metrics in (outcome.members | outcome.ensembles).items():
        shares = (metrics.get(f"{column}/overall/accuracy") for column in named)
        table.add_row(row, *("cannot" if share is None else percent(str(share)) for share in shares))
    console.print(table)
    best = max(outcome.members, key=lambda row: outcome.members[row]["same/overall/accuracy"])
    found = next(iter(outcome.ensembles.values()))
    differ = ", ".join(
        f"{name.split('/')[1]} {percent(str(share))}" for name, share in found.items() if _DIFFER in name
    )
    lines = [f"best member: {best}", f"share of test gestures on which the members differ: {differ} %"]
    lines += [f"without {', '.join(outcome.missing)}: no finished run"] if outcome.missing else []
    lines += [f"{column} without {reasons}" for column, reasons in outcome.left_out.items()]
    for line in lines:
        console.print(line, markup=False, highlight=False, soft_wrap=True)


@dataclass(frozen=True)
class _Asked:
    """What the members answered: digest of touches -> (M, B, L); and column -> who did not, and why."""

    device: AbstractDevice
    chances: dict[str, Tensor]
    left_out: dict[str, str]


def _ask(
    store: Store,
    members: Sequence[tuple[DictConfig, Run]],
    device: AbstractDevice,
    say: Callable[[str], None],
) -> _Asked:
    """Bring every member back and ask it about every column, of which it takes all sets or none."""
    say("drawing touches")
    settings = members[0][0].evaluation
    sets = {column: _drawn(drawn) for column, drawn in columns(device, settings).items()}
    sets["alarm"] = [gestures(device, settings)]
    answers: dict[str, list[Tensor]] = {}
    left_out: dict[str, str] = {}
    for config, run in members:
        say(f"asking {config.row}")
        learner = build_learner(config)
        restore(store, run, learner, build_data(config, device))
        for column, drawn in sets.items():
            try:
                given = [(digest(touches), learner.probabilities(touches)) for touches in drawn]
            except InputError as reason:
                left_out[column] = "; ".join(filter(None, [left_out.get(column), f"{config.row}: {reason}"]))
                continue
            for content, chances in given:
                answers.setdefault(content, []).append(chances)
    return _Asked(device, {content: torch.stack(given) for content, given in answers.items()}, left_out)


def _drawn(sets: Iterator[Touches]) -> list[Touches]:
    """Return all sets of a column; none where the sensors make no other layout, which the evaluation says."""
    try:
        return list(sets)
    except InputError:
        return []


def _log(store: Store, config: DictConfig, asked: _Asked, way: Way, identity: str) -> Run:
    """Evaluate one ensemble, log its run and return it."""
    device, known = asked.device, _Known(asked.chances, asked.device.task, way)
    about = {"members": identity} | {f"{_LEFT_OUT}{column}": who for column, who in asked.left_out.items()}
    with store.run(f"{config.row} {config.data.name} {config.seed}", tags(config) | about) as run:
        groups = ("representation", "model", "fusion", "learner", "optimizer", "trainer", "epochs")
        kept = {key: value for key, value in plain(config).items() if key not in groups}
        describe(store, run.info.run_id, OmegaConf.create(kept), device.touches("train"))
        point = choose(known, device, config.evaluation)
        report = evaluate(known, device, config.evaluation, point)
        chances = asked.chances[digest(next(columns(device, config.evaluation)["same"]))]
        differ = disagreement(chances, device.task)
        conclude(store, run, report, device.task, {f"same/{name}{_DIFFER}": x for name, x in differ.items()})
    return store.client.get_run(run.info.run_id)


def _finished(store: Store, config: DictConfig, **further: str) -> Run | None:
    """Return the newest finished run of a configuration."""
    found = store.find("FINISHED", fingerprint=fingerprint(config), **further)
    return found[0] if found else None


def _left_out(run: Run) -> dict[str, str]:
    """Return column -> who was left out, as the run's tags tell."""
    found = {name: text for name, text in run.data.tags.items() if name.startswith(_LEFT_OUT)}
    return {name.removeprefix(_LEFT_OUT): text for name, text in found.items()}

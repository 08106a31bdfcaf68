"""Ensembles of several rows: votes and averaged probabilities."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch
from mlflow.entities import Run
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from skin.build import build_data, build_device, build_learner
from skin.config import fingerprint, plain
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.operating_point import choose_operating_point, threshold_gestures
from skin.evaluation.report import columns, evaluate
from skin.finished_run import FinishedRun
from skin.labels import Task
from skin.recording import Touches, touches_hash
from skin.run import describe, log_report, simulator, tags
from skin.source import note_reuse
from skin.tracking import Store

Way = Callable[[Tensor, Task], Tensor]


class _Known:
    """Combined predictions for touches that all members have predicted."""

    def __init__(self, chances: Mapping[str, Tensor], task: Task, way: Way) -> None:
        self._chances, self._task, self._way = chances, task, way

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the combined probabilities (B, L) of the members."""
        chances = self._chances.get(touches_hash(touches))
        if chances is None:
            raise InputError("no member takes these touches")
        return self._way(chances, self._task)


def decisions(chances: Tensor, task: Task) -> Tensor:
    """Return the predicted classes of members, (M, B, L), 0 or 1, from their probabilities (M, B, L).

    Cosines of a direction are normalised to length 1.
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

    A direction is omitted, because the predictions of two members are never equal.
    """
    decided = decisions(chances, task)[..., : len(task.binary)]
    differs = decided.amax(0) != decided.amin(0)
    shares = dict(zip(task.binary, differs.float().mean(0).tolist(), strict=True))
    return shares | {"any": float(differs.any(1).float().mean())}


WAYS: dict[str, Way] = {"ensemble_vote": vote, "ensemble_average": average}
"""Row -> function that combines the predictions of the members."""


def combine(
    store: Store, members: Mapping[str, tuple[DictConfig, Run]], ways: Mapping[str, DictConfig]
) -> dict[str, Run]:
    """Evaluate ensembles of finished runs on every column and log each as a run of its own.

    What an ensemble of the same runs found before is not found again. Its run has the fingerprint of its
    configuration, by which the results table finds it, the tag ``members`` with their fingerprints, and the
    tags ``left_out_<column>`` with the members that have no part in a column. The metrics
    ``same/<label>/disagreement`` and ``same/any/disagreement`` are the shares of test gestures on which the
    members differ.

    Args:
        store: of the members' runs and the ensembles'.
        members: name -> configuration and finished run, of one seed and simulator.
        ways: name in ``WAYS`` -> configuration of that seed and simulator, with the ensemble's ``row``.

    Raises:
        InputError: there are fewer than two members.
    """
    if len(members) < 2:
        raise InputError(
            f"an ensemble needs two finished runs, got {', '.join(members) or 'none'}: skin train makes them"
        )
    identity = " ".join(run.data.tags["fingerprint"] for _, run in members.values())
    done = {
        name: store.find("FINISHED", fingerprint=fingerprint(config), members=identity)
        for name, config in ways.items()
    }
    if all(done.values()):
        for found in done.values():
            note_reuse(found[0])
        return {name: found[0] for name, found in done.items()}
    asked = _ask(store, list(members.values()), build_device(next(iter(ways.values()))))
    return {name: _log(store, config, asked, WAYS[name], identity) for name, config in ways.items()}


@dataclass(frozen=True)
class _Asked:
    """Predictions of the members: digest of touches -> (M, B, L); and column -> members left out, and why."""

    device: AbstractDevice
    chances: dict[str, Tensor]
    left_out: dict[str, str]


def _ask(store: Store, members: Sequence[tuple[DictConfig, Run]], device: AbstractDevice) -> _Asked:
    """Restore each member and predict each column; a member predicts all sets of a column or none."""
    settings = members[0][0].evaluation
    sets = {column: _drawn(drawn) for column, drawn in columns(device, settings).items()}
    sets["alarm"] = [threshold_gestures(device, settings)]
    answers: dict[str, list[Tensor]] = {}
    left_out: dict[str, str] = {}
    for config, run in members:
        learner = build_learner(config)
        FinishedRun(store, run).load_weights(learner, build_data(config, device))
        for column, drawn in sets.items():
            try:
                given = [(touches_hash(touches), learner.probabilities(touches)) for touches in drawn]
            except InputError as reason:
                left_out[column] = "; ".join(filter(None, [left_out.get(column), f"{config.row}: {reason}"]))
                continue
            for content, chances in given:
                answers.setdefault(content, []).append(chances)
    return _Asked(device, {content: torch.stack(given) for content, given in answers.items()}, left_out)


def _drawn(sets: Iterator[Touches]) -> list[Touches]:
    """Return all sets of a column; none if the sensors have no other layout, which the evaluation reports."""
    try:
        return list(sets)
    except InputError:
        return []


def _log(store: Store, config: DictConfig, asked: _Asked, way: Way, identity: str) -> Run:
    """Evaluate one ensemble, log its run and return it."""
    device, known = asked.device, _Known(asked.chances, asked.device.task, way)
    about = {"members": identity} | {f"left_out_{column}": who for column, who in asked.left_out.items()}
    with store.run(f"{config.row} {simulator(config)} seed {config.seed}", tags(config) | about) as run:
        groups = ("representation", "model", "fusion", "learner", "optimizer", "trainer", "epochs")
        kept = {key: value for key, value in plain(config).items() if key not in groups}
        describe(store, run.info.run_id, OmegaConf.create(kept), touches_hash(device.touches("train")))
        point = choose_operating_point(known, device, config.evaluation)
        report = evaluate(known, device, config.evaluation, point)
        chances = asked.chances[touches_hash(next(columns(device, config.evaluation)["same"]))]
        differ = disagreement(chances, device.task)
        log_report(
            store, run, report, device.task, {f"same/{name}/disagreement": x for name, x in differ.items()}
        )
    return store.client.get_run(run.info.run_id)

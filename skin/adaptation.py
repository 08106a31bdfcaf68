"""Adapt a finished run to another skin: fine-tune its network and log the result as a new run."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from hydra import compose
from mlflow.entities import Run
from omegaconf import DictConfig, OmegaConf
from rich.console import Console

from skin.build import build_data, build_device, build_learner
from skin.config import plain, validate_config
from skin.device._blank import Blank
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.metrics import metrics
from skin.evaluation.metrics_table import metrics_table
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point
from skin.evaluation.report import evaluate
from skin.fine_tuning import LEAST, Adaptation, FineTuning, fine_tune
from skin.learner.base import AbstractLearner
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.run import describe, log_learner, log_report, tags
from skin.settings import configured
from skin.source import note_reuse
from skin.stored_run import (
    TAG,
    apply_overrides,
    find_run,
    load_configuration,
    load_learner,
    load_operating_point,
)
from skin.tracking import Store

ADAPTED = "adapted"
"""Tag of an adapted run: the id of the run that it was made from."""

_DEFAULT = 48  # gestures of a simulated device
_OWN = ("adapt", "data", "evaluation")  # groups that are taken from the command, not from the run


@dataclass(frozen=True)
class _Job:
    """An adaptation.

    Attributes:
        parent: the run to adapt.
        stored: its configuration.
        device: the skin, or its recording.
        twin: a simulated device with the body and layout of the skin. Its imperfections are those of the run.
        config: of the adapted run.
    """

    parent: Run
    stored: DictConfig
    device: AbstractDevice
    twin: AbstractDevice
    config: DictConfig


def adapt(config: DictConfig, given: Sequence[str]) -> None:
    """Adapt a finished run to the skin of a configuration: log a new run and print the figures.

    Nothing is done if a run with the same fingerprint has finished, unless ``tracking.resume=false``.

    Args:
        config: of ``skin adapt``.
        given: overrides of the command line.

    Raises:
        InputError: the run is no network or does not fit the skin, the gestures have no labels, or there are
            fewer than wanted.
    """
    settings = configured(FineTuning, plain(config)["adapt"], "adapt")
    if config.tracking.threads:
        torch.set_num_threads(config.tracking.threads)
    store = Store.open(config.tracking)
    job = _plan(store, config, settings, [one for one in given if _group(one) not in _OWN])
    identity = tags(job.config) | {ADAPTED: job.parent.info.run_id, "target": " ".join(given)}
    done = store.find("FINISHED", fingerprint=identity["fingerprint"]) if config.tracking.resume else []
    if done:
        note_reuse(done[0])
        print(f"run {done[0].info.run_id} did this before: tracking.resume=false repeats it")
        return
    learner, data = build_learner(job.config), build_data(job.config, job.device.blank())
    load_learner(store, job.parent, learner, data)
    network = learner.network  # refuses another learner before gestures are read from a port
    touches, others = choose_gestures(job.device, settings)
    point = load_operating_point(job.parent, learner, job.stored, job.config.evaluation)
    values = {} if others is None else _before(learner, others, point)
    name = f"{job.config.row} {identity['simulator']} {len(touches)} gestures seed {settings.seed}"
    with store.run(name, identity, job.parent.info.run_id) as run:
        describe(store, run.info.run_id, job.config, touches)
        found = fine_tune(network, data, touches, settings)
        if found.better and point is not None:
            point = choose_operating_point(learner, job.twin, job.config.evaluation)
        log_learner(store, run, learner)
        values |= _validation(found, touches, job.device)
        values |= _log(store, run, learner, job, others, point, values)
        _log_trials(store, run, found)
    Console().print(metrics_table(values, f"{name}, run {run.info.run_id}"))
    print(_sentence(found, job.parent, others))


def _plan(store: Store, config: DictConfig, settings: FineTuning, given: Sequence[str]) -> _Job:
    """Find the run to adapt and build the devices."""
    parent = find_run(store, config.run)
    stored = load_configuration(store, parent, config.trust)
    there = apply_overrides(stored, config, given)
    # The device of the run, on this skin: its fresh gestures determine the threshold of the alarm.
    own = [one for one in given if _group(one) not in ("device", "profile")]
    own += [] if "simulator" in stored.device else ["device=simulated"]
    nominal = apply_overrides(stored, compose("adapt", own), own)
    if "test" in there.device:  # a recording, which is used as a whole
        there = validate_config(OmegaConf.merge(there, {"device": {"test": "all"}}))
    device, known = build_device(there), build_device(nominal)
    if device.simulation is None and device.reference is not None:
        raise InputError(
            f"run {parent.info.run_id} was trained on many skins: name the one to adapt to, as in "
            "device=recording device.path=session.parquet or device=simulated layout.path=sensors.csv"
        )
    twin = known.reference or known
    if device.task != twin.task:
        raise InputError(
            f"run {parent.info.run_id} predicts {', '.join(twin.task.names)}, the gestures have the labels "
            f"{', '.join(device.task.names)}: give gestures with the labels of the run"
        )
    content = plain(nominal if device.simulation is None else there)
    content |= {
        "evaluation": plain(config)["evaluation"],
        "row": f"{stored.row.removesuffix('_adapted')}_adapted",
    }
    content["data"]["augment"] = plain(config)["data"]["augment"]
    identity = {"run": parent.data.tags["fingerprint"], "device": plain(there)["device"]}
    content["adapt"] = asdict(settings) | identity
    if device.simulation is not None:
        drawn = {"gestures": simulated_budget(settings.gestures or _DEFAULT), "fresh": False}
        content["data"] |= drawn
        content["device"] |= drawn | {"data_seed": settings.seed}
    return _Job(parent, stored, device, twin, validate_config(OmegaConf.create(content)))


def _group(override: str) -> str:
    """Return the group of an override."""
    return override.lstrip("+~").split("=")[0].split(".")[0]


def choose_gestures(device: AbstractDevice, settings: FineTuning) -> tuple[Touches, AbstractDevice | None]:
    """Return the gestures to fine-tune on, and a device with others for the report.

    A simulated device draws as many as are wanted: the training split that ``skin train`` has with
    ``data.gestures`` = n / 0.8 and the same seed. The others are its test gestures. For all other devices, a
    part of the touches of :meth:`AbstractDevice.all_touches` is drawn, and the others are the rest.

    Raises:
        InputError: there are fewer gestures than wanted, or than can be used.
    """
    if device.simulation is not None:
        count = settings.gestures or _DEFAULT
        drawn = device.simulation.replace(
            gestures=simulated_budget(count), fresh=False, data_seed=settings.seed
        )
        return drawn.touches("train")[:count], drawn
    known = device.all_touches()
    known.known_labels  # noqa: B018 - raises InputError without labels
    count = settings.gestures or len(known)
    if len(known) < LEAST:
        raise InputError(f"{len(known)} gestures are too few to adapt to a skin: record {LEAST} or more")
    if count > len(known):
        raise InputError(
            f"adapt.gestures={count} is more than the {len(known)} gestures of the device: "
            f"use adapt.gestures={len(known)}"
        )
    order = torch.from_numpy(generator(Stream.SPLIT, settings.seed).permutation(len(known)))
    rest = known[order[count:]]
    return known[order[:count]], Blank(device.task, device.size, rest) if len(rest) else None


def simulated_budget(count: int) -> int:
    """Return the budget of gestures whose training split, 80 %, has ``count`` of them or one more."""
    return -(-count * 10 // 8)


def _before(
    learner: AbstractLearner, others: AbstractDevice, point: OperatingPoint | None
) -> dict[str, float]:
    """Return the metrics of the original network on the test gestures."""
    touches = others.touches("test")
    found = metrics(learner.probabilities(touches), touches.known_labels, others.task, point)
    return {f"before/{name}": value for name, value in found.items()}


def _validation(found: Adaptation, touches: Touches, device: AbstractDevice) -> dict[str, float]:
    """Return the metrics on the gestures, each held out once, of the original and of the result."""
    chances = {"validation_before": found.before, "validation": found.after if found.better else found.before}
    return {
        f"{column}/{name}": value
        for column, chance in chances.items()
        for name, value in metrics(chance, touches.known_labels, device.task).items()
    }


def _log(
    store: Store,
    run: Run,
    learner: AbstractLearner,
    job: _Job,
    others: AbstractDevice | None,
    point: OperatingPoint | None,
    values: dict[str, float],
) -> dict[str, float]:
    """Log metrics and operating point, and return the metrics on the test gestures, if there are any."""
    if others is None:
        store.client.set_tag(run.info.run_id, TAG, "null" if point is None else point.text())
        store.log_metrics(run, values)
        return {}
    report = evaluate(learner, others, job.config.evaluation, point)
    log_report(store, run, report, job.device.task, values)
    return {name: value for name, value in report.metrics.items() if name.startswith("same/")}


def _log_trials(store: Store, run: Run, found: Adaptation) -> None:
    """Log the held-out loss of each trial and epoch as ``adapt.csv``, and the choice as a tag."""
    rows = [
        f"{trial.layers},{trial.lr:g},{epoch},{loss:.6f}"
        for trial in found.trials
        for epoch, loss in enumerate(trial.losses)
    ]
    store.client.log_text(run.info.run_id, "\n".join(["layers,lr,epoch,loss", *rows, ""]), "adapt.csv")
    store.client.set_tag(run.info.run_id, "chosen", found.choice)


def _sentence(found: Adaptation, parent: Run, others: AbstractDevice | None) -> str:
    """Return what was done, and which gestures the figures are for."""
    about = "validation: the gestures to adapt on, each predicted by a network that was not trained on it"
    about += "" if others is None else "; before, same: other gestures of the skin"
    if found.better:
        return f"{about}\nfine-tuned: {found.choice}"
    return (
        f"{about}\nfine-tuning is not better on held-out gestures: the new run keeps the weights of run "
        f"{parent.info.run_id}"
    )

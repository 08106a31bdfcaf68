"""Trials: results of a study for its runs, under each condition, on each device, stored in MLflow."""

import hashlib
import json
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from hydra import compose
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from omegaconf import DictConfig

from experiments.studies.measures import Accuracy
from experiments.studies.runs import Planned, artifact_names, load_outcomes
from experiments.studies.study import Study, Variant, as_overrides, passed_overrides
from experiments.studies.subject import Finished, Measure, Subject
from experiments.studies.tables import publish_page
from skin.build import build_device
from skin.config import fingerprint
from skin.errors import InputError
from skin.evaluation.outcomes import OUTCOMES
from skin.finished_run import TAG, FinishedRun, MissingWeightsError
from skin.model_of_run import RunModel, load_model
from skin.source import note_reuse
from skin.tracking import Store


@dataclass(frozen=True)
class Trial:
    """Results for one run under one condition on one device.

    Attributes:
        variant: of the run.
        seed: of its training.
        condition: name; empty where the study has none.
        device: its number; empty: the run's own.
        run: its fingerprint; empty where none finished.
        metrics: name -> value.
        line: for a person; empty where there is only a table.
        files: of the measure.
        outcomes: of each test gesture (:func:`skin.evaluation.outcomes.encode`); None: not known.
        cannot: why the run does not accept the touches of the condition; empty where it does.
    """

    variant: Variant
    seed: str
    condition: str
    device: str
    run: str
    metrics: Mapping[str, float]
    line: str = ""
    files: Sequence[Path] = ()
    outcomes: np.ndarray | None = None
    cannot: str = ""


def run_trials(
    store: Store, planned: Planned, study: Study, config: DictConfig, folder: Path
) -> Iterator[Trial]:
    """Yield the results of a study for a run; earlier results are read from MLflow.

    Where the study is about all rows, runs that were imported without weights are left out unless all their
    results were imported, too.

    Args:
        store: of the run; results are logged there.
        planned: the run.
        study: what to measure.
        config: of the command.
        folder: for the files of a measure.

    Raises:
        MissingWeightsError: an imported run of a named row would have to be measured.
    """
    if planned.run is None:
        yield Trial(planned.variant, planned.seed, "", "", "", {})
        return
    own = planned.run.data.metrics if planned.variant.configs else {}
    identity = planned.run.data.tags.get("fingerprint", "")
    if study.measure is None and not study.conditions:
        outcomes = load_outcomes(store, planned.run)
        yield Trial(planned.variant, planned.seed, "", "", identity, own, outcomes=outcomes)
        return
    try:
        results = list(_measured(study, planned, _Run(store, planned.run, config)))
    except MissingWeightsError as error:
        if study.rows != "all":
            raise
        print(f"left out: {error}", file=sys.stderr, flush=True)
        return
    for condition, number, found in results:
        files = _fetched(store, found, folder)
        metrics, said = {**({} if condition else own), **found.data.metrics}, found.data.tags["outcome"]
        at = planned.variant, planned.seed, condition, number, identity
        cannot = found.data.tags.get("cannot", "")
        yield Trial(*at, metrics, said, files, load_outcomes(store, found), cannot)


def _measured(study: Study, planned: Planned, subject: "_Run") -> Iterator[tuple[str, str, Run]]:
    """Yield each condition, the number of the device, and the MLflow run with the results."""
    given, selected = passed_overrides(), f"simulator={subject.run.data.tags.get('simulator')}"
    # Trainings had these overrides. They change the device of other runs, whose simulator selected them.
    base, changes = (
        (given, []) if planned.variant.configs else ([], [one for one in given if one != selected])
    )
    for condition, settings in (study.conditions or {"": {}}).items():
        for number, own_settings in numbered_settings(study, settings):
            line = as_overrides({**study.test, **own_settings})
            yield condition, number, subject.measured(study, base, [*line, *changes])


def numbered_settings(study: Study, condition: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the settings of each device of a condition, with its number; empty where there is only one.

    Raises:
        InputError: lists of different lengths.
    """
    lists = {key: value for key, value in condition.items() if isinstance(value, list)}
    lists |= {key: list(range(1, study.devices + 1)) for key in study.numbered if study.devices}
    if not lists:
        yield "", condition
        return
    if len({len(each) for each in lists.values()}) > 1:
        raise InputError(f"the lists of a condition number its devices, so they need one length, got {lists}")
    for number, values in enumerate(zip(*lists.values(), strict=True), start=1):
        yield str(number), {**condition, **dict(zip(lists, values, strict=True))}


class _Run:
    """A finished run, which is restored at most once."""

    def __init__(self, store: Store, run: Run, config: DictConfig) -> None:
        self.store, self.run, self.config = store, run, config

        self.finished = FinishedRun(store, run, config.trust)

    @cached_property
    def trained(self) -> RunModel:
        return load_model(self.finished)

    def measured(self, study: Study, base: Sequence[str], line: Sequence[str]) -> Run:
        """Return the MLflow run with the results of a study on the device that the overrides describe."""
        own = self.finished.configured(compose("train", [*base, *line]), line)
        what = study.measure or Accuracy()
        asked = [repr(what), fingerprint(own), self.run.data.tags.get(TAG)]
        key = hashlib.sha256(json.dumps(asked).encode()).hexdigest()[:16]
        # Not the id of the run, which another database does not have.
        tags = {"evaluated": self.run.data.tags["fingerprint"], "study": key}
        known = self.store.find("FINISHED", **tags) if self.config.tracking.resume else []
        # A trial that began before the training ended is of an earlier training of this configuration.
        known = [one for one in known if one.info.start_time >= self.run.info.end_time]
        if not known:
            changed = any(not one.startswith("tracking.") for one in line)
            known = [self._measure(what, own, f"{study.name} of {self.run.info.run_name}", tags, changed)]
        note_reuse(known[0])
        return known[0]

    def _measure(self, what: Measure, own: DictConfig, name: str, tags: dict[str, str], changed: bool) -> Run:
        """Measure, and log it beside the run; ``changed``: not on the run's own device."""
        subject = Subject(
            own, build_device(own), Finished(self.store, self.run, self.finished.stored, self.trained)
        )
        with self.store.run(name, tags, self.run.info.run_id) as logged, TemporaryDirectory() as made:
            found = what(subject)
            self.store.log_metrics(logged, found.metrics)
            about = {"outcome": found.page.about if found.page else "", "cannot": found.cannot}
            for name, text in about.items():
                self.store.client.set_tag(logged.info.run_id, name, text)
            if found.page is not None:
                run = re.sub(r"\W+", "_", self.run.info.run_name)
                stem = f"{type(what).__name__.lower()}_{run}" + (f"_{tags['study'][:8]}" if changed else "")
                publish_page(found.page, subject.title, Path(made) / stem)
            if found.outcomes is not None:
                np.save(Path(made) / OUTCOMES, found.outcomes)
            self.store.client.log_artifacts(logged.info.run_id, made)
        return self.store.client.get_run(logged.info.run_id)


def _fetched(store: Store, run: Run, folder: Path) -> list[Path]:
    """Copy the files of a measure to a folder and return their paths there."""
    if not artifact_names(store, run) - {OUTCOMES}:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(dir=folder) as holder:
        fetched = download_artifacts(run_id=run.info.run_id, dst_path=holder, tracking_uri=store.uri)
        made = (path for path in sorted(Path(fetched).iterdir()) if path.name != OUTCOMES)
        return [path.replace(folder / path.name) for path in made]

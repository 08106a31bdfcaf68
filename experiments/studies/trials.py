"""The runs of a study, and its trials: results for a run, under each condition, on each device.

A trial that needs an evaluation is a Parquet file of one row in ``results/trials/<study>``, named by the
training and by all that the result depends on. A file has one writer and is written whole, so parallel jobs
and shards share none. All files of a folder together are one table: ``pandas.read_parquet`` reads it.
"""

import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from mlflow.entities import Run

from experiments.studies.measures import Accuracy, StudyMeasure, Subject
from experiments.studies.pages import publish_page
from experiments.studies.study import Study, Variant, as_overrides, passed_overrides, sweeps, variants
from skin.commands import train
from skin.core.files import whole
from skin.core.messages import PARENT
from skin.core.safe_loading import check_seal, write_parquet
from skin.errors import InputError
from skin.evaluation.metrics import OUTCOMES, decode, disagreement, vote
from skin.runs.build import build_device
from skin.runs.configuration import Config, fingerprint, source_tags
from skin.runs.finished_run import TAG, FinishedRun, find_run
from skin.runs.model_of_run import RunModel, load_model
from skin.runs.store import Store, note_reuse, note_source
from skin.runs.sweep import LEFT_OUT, Shard
from skin.runs.train import simulator
from skin.touch.labels import TOUCH

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Planned:
    """A run of a study.

    Attributes:
        variant: that it is of.
        seed: of the training.
        run: the newest that finished; None where none did: it failed, was killed, or never started.
    """

    variant: Variant
    seed: str
    run: Run | None


def train_study(study: Study, shard: Shard | None, smoke: bool = False) -> tuple[Store, list[Planned]]:
    """Train the missing runs of a study, or of a shard of it.

    Returns:
        The store, and all runs of the study or the shard.
    """
    every = variants(study, smoke)
    store = Store.open(next(iter(every[0].configs.values())).tracking)
    if shard:
        fingerprints = shard.part(
            fingerprint(config) for variant in every for config in variant.configs.values()
        )
        every = [replace(variant, configs=_only(variant.configs, fingerprints)) for variant in every]
    if study.train and any(run.run is None for run in _look(store, every) if run.variant.trained):
        parallel = ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={study.jobs}"] if study.jobs > 1 else []
        for _, line in sweeps(study, study.trainings, smoke):
            divided = [f"+hydra.callbacks.sweep.runs={sorted(fingerprints)}"] if shard else []
            multirun([*line, *parallel, *divided])
    return store, [run for run in _look(store, every) if run.run is not None or run.variant.trained]


def _only(configs: Mapping[str, Config], fingerprints: Collection[str]) -> dict[str, Config]:
    """Return the configurations with these fingerprints."""
    return {seed: config for seed, config in configs.items() if fingerprint(config) in fingerprints}


def find_runs(study: Study, config: Config, store: Store) -> list[Planned]:
    """Return finished runs: the named one, or the newest of rows and seeds on the simulator of ``config``.

    Runs of a row whose names differ in more than the seed are different variants.

    Raises:
        InputError: there is none, or a row that is named has none.
    """
    if study.rows is None:
        assert study.run is not None
        run = find_run(store, study.run).run
        row, seed = run.data.tags.get("row", ""), run.data.tags.get("seed", "")
        return [Planned(Variant(_name(run), {"row": row}, {}), seed, run)]
    newest: dict[tuple[str, str], Planned] = {}
    data = simulator(config)
    for run in store.find("FINISHED", simulator=data):
        tags, name = run.data.tags, _name(run)
        chosen = study.rows == "all" or tags["row"] in study.rows
        if chosen and "learned" in tags and int(tags["seed"]) in study.seeds:
            planned = Planned(Variant(name, {"row": tags["row"]}, {}), tags["seed"], run)
            newest.setdefault((name, tags["seed"]), planned)
    rows = {planned.variant.chosen["row"] for planned in newest.values()}
    missing = [] if study.rows == "all" else [row for row in study.rows if row not in rows]
    missing = missing or ([] if rows else ["features"])
    if missing:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {data} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={data} makes one"
        )
    return [newest[key] for key in sorted(newest)]


def row_and_simulator(variant: Variant) -> tuple[str, str]:
    """Return the names of row and simulator of a variant; empty where they are not known."""
    for config in variant.configs.values():
        return str(config.row), simulator(config)
    return variant.chosen.get("row", variant.chosen.get("experiment", "")), variant.chosen.get(
        "simulator", ""
    )


def newest_finished(store: Store, config: Config) -> Run | None:
    """Return the newest finished run of a configuration."""
    runs = store.find("FINISHED", fingerprint=fingerprint(config))
    if runs:
        note_reuse(runs[0])
    return runs[0] if runs else None


def multirun(line: Sequence[str]) -> int:
    """Train the sweep of some overrides, as ``skin train -m`` does, and return the exit code.

    Failed runs are reported and skipped.
    """
    sources = HydraConfig.get().runtime.config_sources
    folder = [source.path for source in sources if source.provider == "command-line"]  # of --config-dir
    return run_command(train.main, ["-m", *(["--config-dir", *folder] if folder else []), *line])


def run_command(main: Callable[[Sequence[str]], None], words: Sequence[str]) -> int:
    """Run a command of Hydra inside of another one and return its exit code.

    Raises:
        SystemExit: a signal ended it.
    """
    with _another_command():
        try:
            main(words)
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
            if code > 128:
                raise
            return code
    return 0


@contextmanager
def _another_command() -> Iterator[None]:
    """Let Hydra run a command inside of one."""
    state, traceback = Singleton.get_state(), os.environ.pop("HYDRA_FULL_ERROR", None)
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        Singleton.set_state(state)
        for name in (PARENT, LEFT_OUT):  # of a sweep, which has ended
            os.environ.pop(name, None)
        if traceback is not None:
            os.environ["HYDRA_FULL_ERROR"] = traceback


def load_outcomes(store: Store, run: Run) -> np.ndarray | None:
    """Return the outcomes of the test gestures of a run, (B,), uint8; None if it has none."""
    if OUTCOMES not in {file.path for file in store.client.list_artifacts(run.info.run_id)}:
        _log.warning(
            "%s keeps no outcomes of its test gestures: its intervals are over trainings alone",
            run.info.run_name,
        )
        return None
    with TemporaryDirectory() as folder:
        return np.load(FinishedRun(store, run).fetch(OUTCOMES, folder))


def _look(store: Store, every: Sequence[Variant]) -> list[Planned]:
    return [
        Planned(variant, seed, newest_finished(store, config))
        for variant in every
        for seed, config in variant.configs.items()
    ]


def _name(run: Run) -> str:
    """Return the name of a run without its seed."""
    return re.sub(r"( seed)? \d+$", "", run.info.run_name)


FOLDER = Path("results/trials")
"""Of all trials, in the current folder; those of a study are in a folder of its name."""

_SCHEMA = pa.schema(
    {
        "run": pa.string(),
        "name": pa.string(),
        "condition": pa.string(),
        "device": pa.string(),
        "measure": pa.string(),
        "source": pa.map_(pa.string(), pa.string()),
        "metrics": pa.map_(pa.string(), pa.float64()),
        "line": pa.string(),
        "cannot": pa.string(),
        "outcomes": pa.binary(),
        "files": pa.map_(pa.string(), pa.binary()),
    }
)
_MAPS = ("source", "metrics", "files")
_SHARES = (
    *(f"{label}/accuracy" for label in ("overall", *TOUCH.names)),
    "dangerous/alarm_recall",
    "dangerous/false_alarm_rate",
)


@dataclass(frozen=True)
class TrialResult:
    """Results for one run under one condition on one device.

    Attributes:
        variant: of the run.
        seed: of its training.
        condition: name; empty where the study has none.
        device: its number; empty: the run's own.
        run: its fingerprint; empty where none finished.
        metrics: name -> value.
        line: for a person; empty where there is only a table.
        files: of the measure, name -> content.
        outcomes: of each test gesture (:func:`skin.evaluation.metrics.encode`); None: not known.
        cannot: the columns (``same``, ``unseen_layout``) whose touches the run does not accept.
    """

    variant: Variant
    seed: str
    condition: str
    device: str
    run: str
    metrics: Mapping[str, float]
    line: str = ""
    files: Mapping[str, bytes] = field(default_factory=dict)
    outcomes: np.ndarray | None = None
    cannot: Sequence[str] = ()


def run_trials(store: Store, planned: Planned, study: Study, config: Config) -> Iterator[TrialResult]:
    """Yield the results of a study for a run; those that exist are not measured again.

    Args:
        store: of the run.
        planned: the run.
        study: what to measure.
        config: of the command.
    """
    variant, seed, run = planned.variant, planned.seed, planned.run
    if run is None:
        yield TrialResult(variant, seed, "", "", "", {})
        return
    tags, metrics = run.data.tags, run.data.metrics if variant.configs else {}
    identity = tags.get("fingerprint", "")
    if study.measure is None and not study.conditions:
        refused = [name.removeprefix("cannot_") for name in tags if name.startswith("cannot_")]
        outcomes = load_outcomes(store, run)
        yield TrialResult(variant, seed, "", "", identity, metrics, outcomes=outcomes, cannot=refused)
        return
    words, selected = passed_overrides(), f"simulator={tags.get('simulator')}"
    # Trainings had these overrides. They change the device of other runs, whose simulator selected them.
    base, changes = (words, []) if variant.configs else ([], [word for word in words if word != selected])
    restored = RestoredRun(store, run, config)
    for condition, settings in (study.conditions or {"": {}}).items():
        for number, numbered in numbered_settings(study, settings):
            line = [*as_overrides({**study.test, **numbered}), *changes]
            row = restored.measure(study, condition, number, base, line)
            yield TrialResult(
                variant,
                seed,
                condition,
                number,
                identity,
                {**({} if condition else metrics), **row["metrics"]},
                row["line"],
                row["files"],
                None if row["outcomes"] is None else np.frombuffer(row["outcomes"], np.uint8),
                ["same"] if row["cannot"] else (),
            )


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
    if len({len(values) for values in lists.values()}) > 1:
        raise InputError(f"the lists of a condition number its devices, so they need one length, got {lists}")
    for number, values in enumerate(zip(*lists.values(), strict=True), start=1):
        yield str(number), {**condition, **dict(zip(lists, values, strict=True))}


class RestoredRun:
    """A finished run, which is restored at most once.

    Args:
        store: of the run.
        run: the run.
        config: of the command.
    """

    def __init__(self, store: Store, run: Run, config: Config) -> None:
        self.run, self.config = run, config
        self.finished = FinishedRun(store, run, config.trust)

    @cached_property
    def trained(self) -> RunModel:
        """What it learned."""
        return load_model(self.finished)

    def measure(
        self, study: Study, condition: str, device: str, base: Sequence[str], line: Sequence[str]
    ) -> dict[str, Any]:
        """Return the row with the results of a study on the device that the overrides describe."""
        config = self.finished.configured(compose("train", [*base, *line]), line)
        measure, run = study.measure or Accuracy(), self.run
        # A training that was repeated has other weights, and ended at another time.
        depends = [repr(measure), fingerprint(config), run.data.tags.get(TAG), run.info.end_time]
        key = hashlib.sha256(json.dumps(depends).encode()).hexdigest()[:16]
        path = FOLDER / study.name / f"{run.data.tags['fingerprint']}-{key}.parquet"
        row = read_row(path) if self.config.tracking.resume else None
        if row is None:
            changed = any(not word.startswith("tracking.") for word in line)
            name = f"{type(measure).__name__.lower()}_" + re.sub(r"\W+", "_", run.info.run_name)
            row = self._measured(measure, config, name + (f"_{key[:8]}" if changed else ""))
            row |= {"condition": condition, "device": device}
            write_row(row, path)
        else:
            note_source(str(path), f"{study.name} of {run.info.run_name}", row["source"])
        return row

    def _measured(self, measure: StudyMeasure, config: Config, name: str) -> dict[str, Any]:
        """Measure, and return the row; its files have a name."""
        subject = Subject(config, build_device(config), self.run, self.trained)
        result = measure(subject)
        files: dict[str, bytes] = {}
        if result.page is not None:
            with TemporaryDirectory() as folder:
                paths = publish_page(result.page, subject.title, Path(folder) / name)
                files = {path.name: path.read_bytes() for path in paths}
        return {
            "run": self.run.data.tags["fingerprint"],
            "name": self.run.info.run_name,
            "measure": repr(measure),
            "source": source_tags(),
            "metrics": {metric: value for metric, value in result.metrics.items() if value == value},
            "line": result.page.about if result.page else "",
            "cannot": result.cannot,
            "outcomes": None if result.outcomes is None else result.outcomes.tobytes(),
            "files": files,
        }


def log_summary(store: Store, study: Study, trials: Sequence[TrialResult], files: Sequence[Path]) -> None:
    """Log what a study measured as one run: its files, and the mean of every metric over its trials.

    The next summary of this study replaces it.
    """
    values: dict[str, list[float]] = {}
    for trial in trials:
        for metric, value in trial.metrics.items():
            name = "/".join(part for part in (trial.variant.name, trial.condition, metric) if part)
            values.setdefault(re.sub(r"[^\w./: -]", "-", name), []).append(value)
    before = store.find("FINISHED", study=study.name)
    with store.run(f"study {study.name}", {"study": study.name}, again=next(iter(before), None)) as run:
        store.log_metrics(run, {name: float(np.mean(numbers)) for name, numbers in values.items()})
        for path in files:
            store.client.log_artifact(run.info.run_id, str(path))


def read_row(path: Path) -> dict[str, Any] | None:
    """Return the row of a file; None without the file.

    Raises:
        InputError: it is damaged.
    """
    if not path.exists():
        return None
    try:
        check_seal(path)
        table = pq.read_table(path, partitioning=None)
        if table.schema.remove_metadata() != _SCHEMA or len(table) != 1:
            raise ValueError("it is not one row of results")
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"{path} cannot be read: {error}: remove it, and it is measured again") from error
    (row,) = table.to_pylist()
    return row | {name: dict(row[name]) for name in _MAPS}


def write_row(row: Mapping[str, Any], path: Path) -> None:
    """Write a row as a file, whole."""
    table = pa.Table.from_pylist([{**row, **{name: [*row[name].items()] for name in _MAPS}}], schema=_SCHEMA)
    with whole(path) as partial:
        write_parquet(table, partial, compression="zstd")


def votes(study: Study, trials: Sequence[TrialResult]) -> Iterator[TrialResult]:
    """Yield what the models in ``study.vote`` decide together, for each seed and for equal other settings.

    It is computed from the outcomes of the runs on the same test gestures (report, 4.2).
    """
    groups: dict[tuple[tuple[tuple[str, str], ...], str], list[TrialResult]] = {}
    for trial in trials:
        row, simulator = row_and_simulator(trial.variant)
        others = {**trial.variant.chosen, "simulator": simulator}
        settings = tuple(item for item in others.items() if item[0] not in ("experiment", "row"))
        if trial.outcomes is not None and (study.vote == "all" or row in study.vote):
            groups.setdefault((settings, trial.seed), []).append(trial)
    several = len({settings for settings, _ in groups}) > 1
    for (settings, seed), members in groups.items():
        codes = [trial.outcomes for trial in members if trial.outcomes is not None]
        if len(codes) < 2 or len({len(code) for code in codes}) > 1:
            continue
        outcomes = vote(np.stack(codes))
        metrics = {"same/any/disagreement": disagreement(np.stack(codes))}
        for name in _SHARES:
            counted = decode(outcomes, name, TOUCH)
            if not np.isnan(counted).all():  # without dangerous gestures there is no recall
                metrics[f"same/{name}"] = float(np.nanmean(counted))
        name = " ".join([*(value for _, value in settings if several), "vote"])
        variant = Variant(name, {**dict(settings), "name": "vote"}, {})
        run = " ".join(trial.run for trial in members)
        yield TrialResult(variant, seed, "", "", run, metrics, outcomes=outcomes)

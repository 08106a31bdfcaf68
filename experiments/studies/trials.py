"""The runs of a study, and its trials: what a measure tells of a run, under each condition, on each device.

A measure is a frozen dataclass of settings that maps a :class:`Subject` to a data frame, with a row for
each touch or condition, or a single row of metrics. ``attrs`` of the frame may have ``about`` (a text for a
person), ``metrics`` (name -> value, where the rows are something else), and ``cannot`` (why the learner does
not accept the touches). Each frame is a Parquet file in ``results/trials/<study>``, named by the training and
by all that the frame depends on. A file has one writer and is written whole, so parallel jobs and shards
share none.

The trials of a study are a data frame with a row for each: ``variant``, ``seed``, ``condition``, ``device``
(its number; empty: the run's own), ``run`` (fingerprint; empty where none finished), ``row``, ``simulator``,
``chosen`` (settings of the variant), ``outcomes`` (:func:`skin.evaluation.metrics.encode`, bytes or None),
``cannot`` (columns such as ``same`` whose touches the run does not accept) and the metrics.
"""

import hashlib
import json
import logging
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np
import pandas as pd
import pyarrow as pa
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from hydra.utils import instantiate
from mlflow.entities import Run
from rich.console import Console
from rich.progress import track

from experiments.studies.measures import Accuracy
from experiments.studies.pages import Page, publish_page
from experiments.studies.report_figures import draw_report
from experiments.studies.study import (
    MEASURE,
    Study,
    Variant,
    as_overrides,
    passed_overrides,
    sweeps,
    variants,
)
from experiments.studies.study_page import publish_study, publish_tables
from skin.commands import train
from skin.core.files import whole
from skin.core.messages import PARENT
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.evaluation.alarm import choose_alarm_threshold
from skin.evaluation.metrics import OUTCOMES, decode, disagreement, vote
from skin.evaluation.operating_point import OperatingPoint
from skin.evaluation.settings import check_evaluation
from skin.learning.learner import AbstractLearner
from skin.runs.build import build_device
from skin.runs.configuration import Config, fingerprint, simulator, source_tags, validate_config
from skin.runs.run import TAG, FinishedRun, find_run
from skin.runs.store import Store, note_reuse, note_source
from skin.runs.sweep import LEFT_OUT, Shard
from skin.runs.torch_model import TorchModel, alarm_source, load_model, load_run
from skin.touch.labels import TOUCH

_log = logging.getLogger(__name__)
FOLDER = Path("results/trials")
"""Of all trials, in the current folder; those of a study are in a folder of its name."""

_FRACTIONS = (
    *(f"{label}/accuracy" for label in ("overall", *TOUCH.names)),
    "dangerous/alarm_recall",
    "dangerous/false_alarm_rate",
)


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


@dataclass(frozen=True)
class Subject:
    """The subject of a measure.

    Attributes:
        config: of the run, with the changes of the condition; that of the command without a run.
        device: as ``config`` describes it.
        run: as MLflow has it; None where a study has no runs.
        model: what the run learned, and the device that it was trained on.
        condition: name.
        changes: overrides of the condition.
    """

    config: Config
    device: AbstractDevice
    run: Run | None = None
    model: TorchModel | None = None
    condition: str = ""
    changes: Sequence[str] = ()

    @property
    def trained(self) -> TorchModel:
        """What the run learned.

        Raises:
            InputError: there is no run.
        """
        if self.model is None:
            raise InputError("this study needs a finished run: study.run=latest, or study.rows=[features]")
        return self.model

    @property
    def learner(self) -> AbstractLearner:
        """What the run learned."""
        return self.trained.learner

    @property
    def reloaded(self) -> TorchModel:
        """What the run learned, with the device of the condition."""
        assert self.trained.run is not None
        return load_model(self.trained.run, self.config)

    def load(self, name: str) -> Any:
        """Return a finished run, pretrained model or exported one for the skin of the configuration."""
        if name.endswith(".onnx"):
            return load_run(name)
        return load_run(name, body=instantiate(self.config.body), layout=instantiate(self.config.layout))

    def point(self) -> OperatingPoint:
        """Return where the run raises the alarm on this device."""
        run = self.trained.run
        point = self.trained.point
        if run is not None:
            point = choose_alarm_threshold(alarm_source(run, self.learner, self.config))
        return point or OperatingPoint.default(check_evaluation(self.config.evaluation).false_alarm_rate)


class StudyMeasure(Protocol):
    """A frozen dataclass of settings that measures; it may have ``page(frame, title)``."""

    def __call__(self, subject: Subject) -> pd.DataFrame:
        """Measure; InputError where the device or the learner cannot be measured so."""


def run_study(study: Study, config: Config, folder: Path, smoke: bool) -> bool:
    """Measure the runs of a study, publish the results, and return whether all runs have finished."""
    shard = Shard.parse(config.shard) if config.shard is not None else None
    store, planned = plan_runs(study, config, shard, smoke)
    trials, tables = list[dict[str, Any]](), list[tuple[dict[str, Any], Page]]()
    console = Console(stderr=True)
    runs = track(planned, "measuring", console=console, transient=True, disable=not console.is_terminal)
    for row, page, title, name in (trial for run in runs for trial in run_trials(store, run, study, config)):
        trials.append(row)
        if page is None or page.data.empty:
            continue
        tables.append((row, page))
        paths = publish_page(page, title, folder / name) if page.tables and store else []
        if page.about and store:
            print(f"{row['variant']} ({row['run'][:8]}): {page.about}", *paths, sep="\n", flush=True)
    if shard:
        print(f"shard {config.shard} is measured: the same command without shard= writes the results")
        return all(run.run for run in planned)
    frame = pd.DataFrame([*trials, *votes(study, pd.DataFrame(trials))])
    path = folder / (f"study_{study.name}" if store else study.name)
    if study.metrics and store:
        words = [word for word in passed_overrides() if not word.startswith("tracking.")]
        small = study.small if smoke else ()
        warning = "SMOKE, one epoch on little data, ignore the scores: " * smoke
        title = warning + ", ".join([f"{study.name}: {study.about}", *small, *words])
        paths = publish_study(study, title, frame, path)
    else:
        paths = publish_tables(study, tables, path)
    if study.report_figures:
        skins = {
            simulator(config.device): config for run in planned for config in run.variant.configs.values()
        }
        print(f"{len(draw_report(frame, skins, folder))} figures of the report in {folder}")
    if store and (study.measure or frame.condition.any()):
        log_summary(store, study, frame, paths)
    return not store or all(run.run for run in planned)


def plan_runs(
    study: Study, config: Config, shard: Shard | None, smoke: bool
) -> tuple[Store | None, list[Planned]]:
    """Return the store and the runs of a study, or of a shard of it; those to train are trained.

    A study without runs has no store, and one entry.

    Raises:
        InputError: there is nothing to measure, or to divide.
    """
    if study.trainings:
        return _train(study, shard, smoke)
    if not study.has_runs:
        if shard:
            raise InputError(f"study={study.name} has no runs to divide: leave out shard={config.shard}")
        if study.measure is None:
            raise InputError(
                f"study={study.name} has nothing to measure: set study.rows=all or study.trainings"
            )
        return None, [Planned(Variant("", {}, {}), "", None)]
    store = Store.open(config.tracking)
    planned = find_runs(study, config, store)
    if shard:
        chosen = shard.part(run.run.data.tags["fingerprint"] for run in planned if run.run)
        planned = [run for run in planned if run.run and run.run.data.tags["fingerprint"] in chosen]
    return store, planned


def _train(study: Study, shard: Shard | None, smoke: bool) -> tuple[Store, list[Planned]]:
    every = variants(study, smoke)
    store = Store.open(next(iter(every[0].configs.values())).tracking)
    prints = {fingerprint(config) for variant in every for config in variant.configs.values()}
    if shard:
        prints = shard.part(prints)
        every = [
            replace(each, configs={s: c for s, c in each.configs.items() if fingerprint(c) in prints})
            for each in every
        ]
    if study.train and any(run.run is None for run in _look(store, every) if run.variant.trained):
        parallel = ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={study.jobs}"] if study.jobs > 1 else []
        for _, line in sweeps(study, study.trainings, smoke):
            divided = [f"+hydra.callbacks.sweep.runs={sorted(prints)}"] if shard else []
            multirun([*line, *parallel, *divided])
    return store, [run for run in _look(store, every) if run.run is not None or run.variant.trained]


def _look(store: Store, every: Sequence[Variant]) -> list[Planned]:
    """Return the newest finished run of each configuration."""
    planned = []
    for variant in every:
        for seed, config in variant.configs.items():
            runs = store.find("FINISHED", fingerprint=fingerprint(config))
            if runs:
                note_reuse(runs[0])
            planned.append(Planned(variant, seed, runs[0] if runs else None))
    return planned


def find_runs(study: Study, config: Config, store: Store) -> list[Planned]:
    """Return finished runs: the named one, or the newest of rows and seeds on the simulator of ``config``.

    Runs of a row whose names differ in more than the seed are different variants.

    Raises:
        InputError: there is none, or a row that is named has none.
    """
    if study.rows is None:
        assert study.run is not None
        return [_found(find_run(config.tracking, study.run).run)]
    newest: dict[tuple[str, str], Planned] = {}
    data = simulator(config.device)
    for run in store.find("FINISHED", simulator=data):
        tags = run.data.tags
        chosen = study.rows == "all" or tags["row"] in study.rows
        if chosen and "learned" in tags and int(tags["seed"]) in study.seeds:
            planned = _found(run)
            newest.setdefault((planned.variant.name, planned.seed), planned)
    rows = {planned.variant.chosen["row"] for planned in newest.values()}
    missing = [] if study.rows == "all" else [row for row in study.rows if row not in rows]
    missing = missing or ([] if rows else ["features"])
    if missing:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {data} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={data} makes one"
        )
    return [newest[key] for key in sorted(newest)]


def _found(run: Run) -> Planned:
    tags, name = run.data.tags, re.sub(r"( seed)? \d+$", "", run.info.run_name)
    return Planned(Variant(name, {"row": tags.get("row", "")}, {}), tags.get("seed", ""), run)


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


def _load_outcomes(store: Store, run: Run) -> bytes | None:
    """Return the outcomes of the test gestures of a run; None if it has none."""
    if OUTCOMES not in {file.path for file in store.client.list_artifacts(run.info.run_id)}:
        _log.warning(
            "%s keeps no outcomes of its test gestures: its intervals are over trainings alone",
            run.info.run_name,
        )
        return None
    with TemporaryDirectory() as folder:
        return np.load(FinishedRun(store, run).fetch(OUTCOMES, folder)).tobytes()


Trial = tuple[dict[str, Any], Page | None, str, str]
"""Row of the trials, page, and title and name of the page."""


def run_trials(store: Store | None, planned: Planned, study: Study, config: Config) -> Iterator[Trial]:
    """Yield the trials of a run; measurements that exist are not made again.

    Args:
        store: of the run; None: a study without runs.
        planned: the run.
        study: what to measure.
        config: of the command.
    """
    variant, run = planned.variant, planned.run
    tags = {} if run is None else run.data.tags
    row: dict[str, Any] = {"variant": variant.name, "seed": planned.seed, "condition": "", "device": ""}
    row |= {"run": tags.get("fingerprint", ""), "chosen": variant.chosen, "outcomes": None, "cannot": ()}
    row |= _row_and_simulator(variant)
    logged = run.data.metrics if run is not None and variant.configs else {}
    if store and run is None:
        yield row, None, "", ""
        return
    if store and run and study.measure is None and not study.conditions:
        refused = [name.removeprefix("cannot_") for name in tags if name.startswith("cannot_")]
        yield row | {"outcomes": _load_outcomes(store, run), "cannot": refused} | logged, None, "", ""
        return
    words, selected = passed_overrides(), f"simulator={tags.get('simulator')}"
    # Trainings had these overrides. They change the device of other runs, whose simulator selected them.
    base, changes = (words, []) if variant.configs else ([], [word for word in words if word != selected])
    restored = RestoredRun(store, run, config)
    for condition, settings in (study.conditions or {"": {}}).items():
        for number, numbered in numbered_settings(study, settings):
            own = {key: value for key, value in numbered.items() if not key.startswith(MEASURE)}
            of_measure = {key.removeprefix(MEASURE): numbered[key] for key in numbered.keys() - own.keys()}
            measure = replace(study.measure or Accuracy(), **of_measure)
            line = [*as_overrides({**study.test, **own}), *changes]
            subject = partial(Subject, condition=condition, changes=as_overrides(own))
            frame, name = restored.measure(study.name, measure, subject, base, line)
            page, measured = _page(measure, frame, restored.title), {"condition": condition, "device": number}
            cannot = ("same",) if frame.attrs.get("cannot") else ()
            metrics = frame.attrs.get("metrics", frame.iloc[0].to_dict() if len(frame) == 1 else {})
            metrics = metrics if store else {}  # rows of a skin have texts
            results = ({} if condition else logged) | metrics | measured | {"cannot": cannot}
            yield row | results, page, restored.title, name


def _page(measure: StudyMeasure, frame: pd.DataFrame, title: str) -> Page:
    """Return what is published of a measurement."""
    if hasattr(measure, "page"):
        return measure.page(frame, title)
    tables = {} if len(frame) < 2 else {"Measured": frame.astype(str)}
    return Page(frame.attrs.get("about", ""), tables, frame)


def _row_and_simulator(variant: Variant) -> dict[str, str]:
    for config in variant.configs.values():
        return {"row": str(config.row), "simulator": simulator(config.device)}
    chosen = variant.chosen
    row = chosen.get("row", chosen.get("experiment", ""))
    return {"row": row, "simulator": chosen.get("simulator", "")}


def numbered_settings(study: Study, condition: Mapping[str, Any]) -> Iterator[tuple[str, Mapping[str, Any]]]:
    """Yield the settings of each device of a condition, with its number; empty where there is only one.

    Raises:
        InputError: lists of different lengths.
    """
    lists = {
        key: value
        for key, value in condition.items()
        if isinstance(value, list) and not key.startswith(MEASURE)
    }
    lists |= {key: list(range(1, study.devices + 1)) for key in study.numbered if study.devices}
    if not lists:
        yield "", condition
        return
    if len({len(values) for values in lists.values()}) > 1:
        raise InputError(f"the lists of a condition number its devices, so they need one length, got {lists}")
    for number, values in enumerate(zip(*lists.values(), strict=True), start=1):
        yield str(number), {**condition, **dict(zip(lists, values, strict=True))}


class RestoredRun:
    """A finished run, which is restored at most once; without one, the skin of the command.

    Args:
        store, run: None without a run.
        config: of the command.
    """

    def __init__(self, store: Store | None, run: Run | None, config: Config) -> None:
        self.run, self.config = run, config
        self.finished = FinishedRun(store, run, config.trust) if store and run else None

    @property
    def title(self) -> str:
        """The name of the run, for pages and figures; the id of a run differs between databases."""
        if self.run is None:
            return ""
        return (
            f"{self.run.info.run_name}, run {self.run.data.tags.get('fingerprint', self.run.info.run_id)[:8]}"
        )

    @cached_property
    def trained(self) -> TorchModel | None:
        """What it learned."""
        return load_model(self.finished) if self.finished else None

    def measure(
        self,
        study: str,
        measure: StudyMeasure,
        subject: Callable[..., Subject],
        base: Sequence[str],
        line: Sequence[str],
    ) -> tuple[pd.DataFrame, str]:
        """Return the frame of a measure on the device that overrides describe, and a name for its files."""
        if self.finished:
            general = [word for word in base if word.startswith(("hydra", "tracking"))]
            config = self.finished.configured([*general, *line])
        else:
            config = validate_config(compose("train", [*base, *line]))
        depends: list[Any] = [repr(measure), fingerprint(config)]
        identity, name = "skin", study
        if self.run is not None:
            # A training that was repeated has other weights, and ended at another time.
            depends += [self.run.data.tags.get(TAG), self.run.info.end_time]
            identity, name = self.run.data.tags["fingerprint"], self.run.info.run_name
        key = hashlib.sha256(json.dumps(depends).encode()).hexdigest()[:16]
        path = FOLDER / study / f"{identity}-{key}.parquet"
        frame = read_frame(path) if self.config.tracking.resume else None
        if frame is None:
            frame = measure(subject(config, build_device(config), self.run, self.trained))
            frame.attrs |= {"run": identity, "name": name, "measure": repr(measure), "source": source_tags()}
            write_frame(frame, path)
        else:
            note_source(str(path), f"{study} of {name}", frame.attrs["source"])
        changed = any(not word.startswith("tracking.") for word in line)
        name = f"{type(measure).__name__.lower()}_" + re.sub(r"\W+", "_", name)
        return frame, name + (f"_{key[:8]}" if changed else "")


def read_frame(path: Path) -> pd.DataFrame | None:
    """Return the frame of a file; None without the file.

    Raises:
        InputError: it is damaged.
    """
    if not path.exists():
        return None
    try:
        frame = pd.read_parquet(path, page_checksum_verification=True, partitioning=None)
        if "source" not in frame.attrs:
            raise ValueError("it is no measurement")
    except (OSError, ValueError, pa.ArrowException) as error:
        raise InputError(f"{path} cannot be read: {error}: remove it, and it is measured again") from error
    return frame


def write_frame(frame: pd.DataFrame, path: Path) -> None:
    """Write a frame and its ``attrs`` as a file, whole."""
    with whole(path) as partial:
        frame.to_parquet(partial, compression="zstd", write_page_checksum=True)


def log_summary(store: Store, study: Study, trials: pd.DataFrame, files: Sequence[Path]) -> None:
    """Log what a study measured as one run: its files, and the mean of every metric over its trials.

    The next summary of this study replaces it.
    """
    means = trials.groupby(["variant", "condition"], sort=False).mean(numeric_only=True).stack()
    named = {
        re.sub(r"[^\w./: -]", "-", "/".join(filter(None, name))): float(mean) for name, mean in means.items()
    }
    before = store.find("FINISHED", study=study.name)
    with store.run(f"study {study.name}", {"study": study.name}, again=next(iter(before), None)) as run:
        store.log_metrics(run, named)
        for path in files:
            store.client.log_artifact(run.info.run_id, str(path))


def votes(study: Study, trials: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield what the models in ``study.vote`` decide together, for each seed and for equal other settings.

    It is computed from the outcomes of the runs on the same test gestures (report, 4.2).
    """
    members = trials[trials.outcomes.notna() & ((study.vote == "all") | trials.row.isin([*study.vote]))]
    others = [
        tuple(
            item
            for item in {**chosen, "simulator": simulated}.items()
            if item[0] not in ("experiment", "row")
        )
        for chosen, simulated in zip(members.chosen, members.simulator, strict=True)
    ]
    several = len(set(others)) > 1
    for (settings, seed), group in members.groupby([pd.Series(others, members.index), "seed"], sort=False):
        codes = [np.frombuffer(outcomes, np.uint8) for outcomes in group.outcomes]
        if len(codes) < 2 or len({len(code) for code in codes}) > 1:
            continue
        outcomes = vote(np.stack(codes))
        metrics = {"same/any/disagreement": disagreement(np.stack(codes))}
        for metric in _FRACTIONS:
            counted = decode(outcomes, metric, TOUCH)
            if not np.isnan(counted).all():  # without dangerous gestures there is no recall
                metrics[f"same/{metric}"] = float(np.nanmean(counted))
        name = " ".join([*(value for _, value in settings if several), "vote"])
        row = {"variant": name, "seed": seed, "condition": "", "device": "", "run": " ".join(group.run)}
        row |= {"row": "", "simulator": dict(settings)["simulator"], "cannot": (), **metrics}
        yield row | {"chosen": dict(settings) | {"name": "vote"}, "outcomes": outcomes.tobytes()}

"""The runs of a study, and its trials: what a measure tells of a run, under each condition, on each device.

Each frame of a measure (:mod:`experiments.studies.measures`) is a Parquet file in ``results/trials/<study>``,
named by the training and by all that the frame depends on. A file has one writer and is written whole, so
parallel jobs and shards share none.

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
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from rich.console import Console
from rich.progress import track

from experiments.studies.measures import Accuracy, StudyMeasure, Subject
from experiments.studies.pages import Page, draw_report, publish_measured, publish_page, publish_study
from experiments.studies.study import (
    MEASURE,
    Study,
    Variant,
    as_overrides,
    passed_overrides,
    sweeps,
    variants,
)
from skin.commands import train
from skin.core.files import whole
from skin.core.messages import PARENT
from skin.errors import InputError
from skin.evaluation.metrics import OUTCOMES, decode, disagreement, vote
from skin.runs.build import TorchModel, load_model
from skin.runs.configuration import Config, fingerprint, simulator, source_tags, validate_config
from skin.runs.run import TAG, FinishedRun, find_run
from skin.runs.store import Store, note_reuse, note_source
from skin.runs.sweep import LEFT_OUT, Shard
from skin.touch.labels import TOUCH

_log = logging.getLogger(__name__)
FOLDER = Path("results/trials")
"""Of all trials, in the current folder; those of a study are in a folder of its name."""


@dataclass(frozen=True)
class StudyRun:
    """A run of a study.

    Attributes:
        variant: that it is of.
        seed: of the training.
        finished: the newest that finished; None where none did: it failed, was killed, or never started.
    """

    variant: Variant
    seed: str
    finished: FinishedRun | None = None

    @cached_property
    def tags(self) -> Mapping[str, str]:
        """Tags of the run; none of one that has not finished."""
        return self.finished.run.data.tags if self.finished else {}

    @cached_property
    def model(self) -> TorchModel | None:
        """What it learned."""
        return load_model(self.finished) if self.finished else None


def run_study(study: Study, config: Config, folder: Path, smoke: bool) -> bool:
    """Measure the runs of a study, publish the results, and return whether all runs have finished."""
    shard = Shard.parse(config.shard) if config.shard is not None else None
    store, planned = plan_runs(study, config, shard, smoke)
    trials, console = list[dict[str, Any]](), Console(stderr=True)
    runs = track(planned, "measuring", console=console, transient=True, disable=not console.is_terminal)
    for trial in (trial for run in runs for trial in run_trials(store, run, study, config)):
        trials.append(trial)
        page: Page = trial["page"]
        paths = publish_page(page, trial["title"], folder / trial["file"]) if page.tables and store else []
        if page.about:
            about = f"{trial['variant']} ({trial['run'][:8]}): {page.about}" if store else page.about
            print(about, *paths, sep="\n", flush=True)
    complete = not store or all(run.finished for run in planned)
    if shard:
        print(f"shard {config.shard} is measured: the same command without shard= writes the results")
        return complete
    frame = pd.DataFrame([*trials, *votes(study, pd.DataFrame(trials))])
    path = folder / ((f"study_{study.name}" if store else study.name) + "_incomplete" * (not complete))
    if study.metrics and store:
        words = [f"{study.name}: {study.about}", *(study.small if smoke else ())]
        words += [word for word in passed_overrides() if not word.startswith("tracking.")]
        warning = "SMOKE, one epoch on little data, ignore the scores: " if smoke else ""
        paths = publish_study(study, warning + ", ".join(words), frame, path)
    else:
        paths = publish_measured(study, frame, path)
    print(*paths, sep="\n")
    if study.report_figures:
        skins = {
            simulator(config.device): config for run in planned for config in run.variant.configs.values()
        }
        print(f"{len(draw_report(frame, skins, folder))} figures of the report in {folder}")
    return complete


def plan_runs(
    study: Study, config: Config, shard: Shard | None, smoke: bool
) -> tuple[Store | None, list[StudyRun]]:
    """Return the store and the runs of a study, or of a shard of it; those to train are trained.

    A study without runs has no store, and one entry.

    Raises:
        InputError: there is nothing to measure, or to divide.
    """
    if study.trainings:
        return _train(study, config, shard, smoke)
    if not study.has_runs:
        if shard:
            raise InputError(f"study={study.name} has no runs to divide: leave out shard={config.shard}")
        if study.measure is None:
            raise InputError(
                f"study={study.name} has nothing to measure: set study.rows=all or study.trainings"
            )
        return None, [StudyRun(Variant("", {}, {}), "")]
    store = Store.open(config.tracking)
    runs = find_runs(study, config, store)
    if shard:
        chosen = shard.part({run.tags["fingerprint"] for run in runs})
        runs = [run for run in runs if run.tags["fingerprint"] in chosen]
    return store, runs


def _train(study: Study, command: Config, shard: Shard | None, smoke: bool) -> tuple[Store, list[StudyRun]]:
    planned = [
        (fingerprint(config), StudyRun(variant, seed))
        for variant in variants(study, smoke)
        for seed, config in variant.configs.items()
    ]
    store = Store.open(next(iter(planned[0][1].variant.configs.values())).tracking)
    every = {print_ for print_, _ in planned}
    prints = shard.part(every) if shard else every

    def look() -> Iterator[StudyRun]:
        """Yield the runs, with the newest finished one of each configuration."""
        for print_, run in planned:
            if print_ in prints:
                found = next(iter(store.find("FINISHED", fingerprint=print_)), None)
                if found:
                    note_reuse(found)
                yield replace(run, finished=FinishedRun(store, found, command.trust) if found else None)

    if study.train and any(not run.finished for run in look() if run.variant.trained):
        parallel = ["hydra/launcher=joblib", f"hydra.launcher.n_jobs={study.jobs}"] if study.jobs > 1 else []
        divided = [f"+hydra.callbacks.sweep.runs={sorted(prints)}"] if shard else []
        for _, line in sweeps(study, study.trainings, smoke):
            multirun([*line, *parallel, *divided])
    return store, [run for run in look() if run.finished or run.variant.trained]


def find_runs(study: Study, config: Config, store: Store) -> list[StudyRun]:
    """Return finished runs: the named one, or the newest of rows and seeds on the simulator of ``config``.

    Runs of a row whose names differ in more than the seed are different variants.

    Raises:
        InputError: there is none, or a row that is named has none.
    """
    if study.rows is None:
        assert study.run is not None
        return [_found(find_run(config.tracking, study.run, config.trust))]
    newest: dict[tuple[str, str], StudyRun] = {}
    data = simulator(config.device)
    for each in store.find("FINISHED", simulator=data):
        run = _found(FinishedRun(store, each, config.trust))
        chosen = study.rows == "all" or run.tags["row"] in study.rows
        if chosen and "learned" in run.tags and int(run.seed) in study.seeds:
            newest.setdefault((run.variant.name, run.seed), run)
    rows = {run.variant.chosen["row"] for run in newest.values()}
    missing = [] if study.rows == "all" else [row for row in study.rows if row not in rows]
    missing = missing or ([] if rows else ["features"])
    if missing:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {data} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={data} makes one"
        )
    return [newest[key] for key in sorted(newest)]


def _found(finished: FinishedRun) -> StudyRun:
    tags, name = finished.run.data.tags, re.sub(r"( seed)? \d+$", "", finished.title)
    return StudyRun(Variant(name, {"row": tags.get("row", "")}, {}), tags.get("seed", ""), finished)


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
    state, traceback = Singleton.get_state(), os.environ.pop("HYDRA_FULL_ERROR", None)
    GlobalHydra.instance().clear()
    try:
        main(words)
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else int(stop.code is not None)
        if code > 128:
            raise
        return code
    finally:
        Singleton.set_state(state)
        for name in (PARENT, LEFT_OUT):  # of a sweep, which has ended
            os.environ.pop(name, None)
        if traceback is not None:
            os.environ["HYDRA_FULL_ERROR"] = traceback
    return 0


def run_trials(store: Store | None, run: StudyRun, study: Study, config: Config) -> Iterator[dict[str, Any]]:
    """Yield the trials of a run, with the ``page`` of each, its ``title`` and the name of its ``file``.

    Measurements that exist are not made again.

    Args:
        store: of the run; None: a study without runs.
        run: that is measured.
        study: what to measure.
        config: of the command.
    """
    variant, tags, finished = run.variant, run.tags, run.finished
    row: dict[str, Any] = {"variant": variant.name, "seed": run.seed, "condition": "", "device": ""}
    row |= {"run": tags.get("fingerprint", ""), "chosen": variant.chosen, "outcomes": None, "cannot": ()}
    row |= _row_and_simulator(variant) | {"page": Page("")}
    if store and not finished:
        yield row
        return
    logged = finished.run.data.metrics if finished and variant.configs else {}
    if finished and study.measure is None and not study.conditions:
        refused = [name.removeprefix("cannot_") for name in tags if name.startswith("cannot_")]
        yield row | {"outcomes": _load_outcomes(finished), "cannot": refused} | logged
        return
    # Trainings had these overrides. They change the device of other runs, whose simulator selected them.
    words, selected = passed_overrides(), f"simulator={tags.get('simulator')}"
    base, changes = (words, []) if variant.configs else ([], [word for word in words if word != selected])
    # The name of a run, and not its id, which differs between databases.
    name = finished.title if finished else study.name
    title = f"{name}, run {tags.get('fingerprint', finished.identity)[:8]}" if finished else ""
    for condition, number, settings in numbered_settings(study):
        own = {key: value for key, value in settings.items() if not key.startswith(MEASURE)}
        of_measure = {key.removeprefix(MEASURE): settings[key] for key in settings.keys() - own.keys()}
        measure = replace(study.measure or Accuracy(), **of_measure)
        line = [*as_overrides({**study.test, **own}), *changes]
        if finished:
            general = [word for word in base if word.startswith(("hydra", "tracking"))]
            changed = finished.configured([*general, *line])
        else:
            changed = validate_config(compose("train", [*base, *line]))
        subject = Subject(changed, condition=condition, changes=as_overrides(own))
        frame, key = measure_once(study.name, measure, run, subject, config.tracking.resume)
        metrics = frame.attrs.get("metrics", frame.iloc[0].to_dict() if len(frame) == 1 else {})
        file = f"{type(measure).__name__.lower()}_" + re.sub(r"\W+", "_", name)
        file += f"_{key[:8]}" if any(not word.startswith("tracking.") for word in line) else ""
        page = {"page": _page(measure, frame, title), "title": title, "file": file}
        trial = {
            "condition": condition,
            "device": number,
            "cannot": ("same",) if frame.attrs.get("cannot") else (),
        }
        # Rows of a skin have texts.
        yield row | ({} if condition else logged) | (metrics if store else {}) | trial | page


def _row_and_simulator(variant: Variant) -> dict[str, str]:
    for config in variant.configs.values():
        return {"row": str(config.row), "simulator": simulator(config.device)}
    chosen = variant.chosen
    row = chosen.get("row", chosen.get("experiment", ""))
    return {"row": row, "simulator": chosen.get("simulator", "")}


def _load_outcomes(finished: FinishedRun) -> bytes | None:
    """Return the outcomes of the test gestures of a run; None if it has none."""
    assert finished.store is not None
    if OUTCOMES not in {file.path for file in finished.store.client.list_artifacts(finished.identity)}:
        _log.warning(
            "%s keeps no outcomes of its test gestures: its intervals are over trainings alone",
            finished.title,
        )
        return None
    with TemporaryDirectory() as folder:
        return np.load(finished.fetch(OUTCOMES, folder)).tobytes()


def _page(measure: StudyMeasure, frame: pd.DataFrame, title: str) -> Page:
    """Return what is published of a measurement."""
    if hasattr(measure, "page"):
        return measure.page(frame, title)
    tables = {} if len(frame) < 2 else {"Measured": frame.astype(str)}
    return Page(frame.attrs.get("about", ""), tables, frame)


def numbered_settings(study: Study) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Yield each condition, with the number and settings of each device; no number where there is only one.

    Raises:
        InputError: lists of different lengths.
    """
    numbers = {key: list(range(1, study.devices + 1)) for key in study.numbered if study.devices}
    for name, condition in (study.conditions or {"": {}}).items():
        settings = condition | numbers
        lists = {
            key: each
            for key, each in settings.items()
            if isinstance(each, list) and not key.startswith(MEASURE)
        }
        if len({len(values) for values in lists.values()}) > 1:
            raise InputError(
                f"the lists of a condition number its devices, so they need one length, got {lists}"
            )
        for number, values in enumerate(zip(*lists.values(), strict=True) if lists else [()], start=1):
            yield name, str(number) if lists else "", settings | dict(zip(lists, values, strict=True))


def measure_once(
    study: str, measure: StudyMeasure, run: StudyRun, subject: Subject, resume: bool = True
) -> tuple[pd.DataFrame, str]:
    """Return the frame of a measure, from its file if there is one, and a key of all that it depends on.

    Args:
        study: name.
        measure: with its settings.
        run: that is measured.
        subject: of the run, without its model.
        resume: whether to read the file.
    """
    depends: list[Any] = [repr(measure), fingerprint(subject.config), subject.condition]
    identity, name = "skin", study
    if run.finished:
        # A training that was repeated has other weights, and ended at another time.
        depends += [run.tags.get(TAG), run.finished.run.info.end_time]
        identity, name = run.tags["fingerprint"], run.finished.title
    key = hashlib.sha256(json.dumps(depends).encode()).hexdigest()[:16]
    path = FOLDER / study / f"{identity}-{key}.parquet"
    # What is behind the name of a predictor may have changed.
    frame = read_frame(path) if resume and not hasattr(measure, "predictor") else None
    if frame is None:
        frame = measure(replace(subject, model=run.model))
        frame.attrs |= {"run": identity, "name": name, "measure": repr(measure), "source": source_tags()}
        write_frame(frame, path)
    else:
        note_source(frame.attrs["source"])
    return frame, key


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


def votes(study: Study, trials: pd.DataFrame) -> Iterator[dict[str, Any]]:
    """Yield what the models in ``study.vote`` decide together, for each seed and for equal other settings.

    It is computed from the outcomes of the runs on the same test gestures (report, 4.2).
    """
    members = trials[trials.outcomes.notna() & ((study.vote == "all") | trials.row.isin([*study.vote]))]
    chosen = [
        each | {"simulator": data} for each, data in zip(members.chosen, members.simulator, strict=True)
    ]
    others = [tuple(item for item in each.items() if item[0] not in ("experiment", "row")) for each in chosen]
    several = len(set(others)) > 1
    names = ("dangerous/alarm_recall", "dangerous/false_alarm_rate")
    fractions = [f"{label}/accuracy" for label in ("overall", *TOUCH.names)]
    for (settings, seed), group in members.groupby([pd.Series(others, members.index), "seed"], sort=False):
        codes = [np.frombuffer(outcomes, np.uint8) for outcomes in group.outcomes]
        if len(codes) < 2 or len({len(code) for code in codes}) > 1:
            continue
        outcomes = vote(np.stack(codes))
        metrics = {"same/any/disagreement": disagreement(np.stack(codes))}
        for metric in (*fractions, *names):
            counted = decode(outcomes, metric, TOUCH)
            if not np.isnan(counted).all():  # without dangerous gestures there is no recall
                metrics[f"same/{metric}"] = float(np.nanmean(counted))
        name = " ".join([*(value for _, value in settings if several), "vote"])
        row = {"variant": name, "seed": seed, "condition": "", "device": "", "run": " ".join(group.run)}
        row |= {"row": "", "simulator": dict(settings)["simulator"], "cannot": (), **metrics}
        yield row | {"chosen": dict(settings) | {"name": "vote"}, "outcomes": outcomes.tobytes()}

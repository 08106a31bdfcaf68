"""Compare variants of trainings, or finished runs under conditions; give verdicts on statements.

    skin study study=norm
    skin study -m study=norm,activation simulator=naive
    skin study study=dead study.rows=[features,gru]
    skin study study=margins study.run=latest

A study is a file of conf/study. It trains the runs that are missing, with the budget in that file; rerun to
resume. Writes study_<name>.md, .csv and .png into out=. A measure of single runs, such as margins, writes
files for each, and of several runs study_<name>.csv with all values. study.rows=all leaves out runs that
were imported without the results that it needs.
"""

import sys
from pathlib import Path

from omegaconf import DictConfig

from experiments.studies.study import SMOKE, Study, as_overrides, passed_overrides
from skin.command import command
from skin.config import validate_config
from skin.errors import InputError
from skin.files import results


@command("study")
def main(config: DictConfig) -> None:
    """Train or find the runs of a study, measure them, and write and print the results."""
    study = Study.of(config)
    folder = results(config.out) / ("smoke" if config.smoke else "")

    from skin.console import quiet

    quiet()
    if not study.trainings and study.rows is None and study.run is None:
        if config.shard is not None:
            raise InputError(f"study={study.name} has no runs to divide: leave out shard={config.shard}")
        _measure_skin(study, folder)
    else:
        _compare(study, config, folder)


def _compare(study: Study, config: DictConfig, folder: Path) -> None:
    """Measure the runs of a study; exit code 1 if one is missing."""
    from rich.console import Console
    from rich.progress import track

    from experiments.studies.runs import find_runs, train_study
    from experiments.studies.study_page import publish_files, publish_study
    from experiments.studies.trials import run_trials
    from skin.shard import Shard
    from skin.tracking import Store

    shard = Shard.parse(config.shard) if config.shard is not None else None
    if study.trainings:
        store, planned = train_study(study, shard, config.smoke)
    else:
        store = Store.open(config.tracking)
        planned = find_runs(study, config, store)
        if shard:
            own = shard.part(one.run.data.tags["fingerprint"] for one in planned if one.run)
            planned = [one for one in planned if one.run and one.run.data.tags["fingerprint"] in own]
    found, console = [], Console(stderr=True)
    shown = track(planned, "measuring", console=console, transient=True, disable=not console.is_terminal)
    for trial in (trial for one in shown for trial in run_trials(store, one, study, config, folder)):
        found.append(trial)
        if trial.line:
            print(f"{trial.variant.name} ({trial.run[:8]}): {trial.line}", *trial.files, sep="\n", flush=True)
    if shard:
        print(f"shard {config.shard} is measured: the same command without shard= writes the results")
    elif not found:
        raise InputError(f"study={study.name} has nothing to publish: all its runs were left out")
    elif study.metrics:
        smoke = "SMOKE, one epoch on little data, ignore the scores: " * config.smoke
        settings = [word for word in passed_overrides() if not word.startswith("tracking.")]
        title = smoke + ", ".join([f"{study.name}: {study.about}", *(SMOKE if smoke else ()), *settings])
        publish_study(study, title, found, folder / f"study_{study.name}")
    else:
        publish_files(study, found, folder / f"study_{study.name}.csv")
    if any(one.run is None for one in planned):
        sys.exit(1)


def _measure_skin(study: Study, folder: Path) -> None:
    """Apply the measure of a study without runs to the skin."""
    from hydra import compose

    from experiments.studies.subject import Subject
    from experiments.studies.tables import publish_page
    from skin.build import build_device

    if study.measure is None:
        raise InputError(f"study={study.name} has nothing to measure: set study.rows=all or study.trainings")
    config = validate_config(compose("train", [*as_overrides(study.test), *passed_overrides()]))
    page = study.measure(Subject(config, build_device(config))).page
    print(
        page.about,
        *publish_page(page, f"{study.name}: {study.about}", folder / f"study_{study.name}"),
        sep="\n",
    )

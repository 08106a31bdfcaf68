"""Compare variants of trainings, or finished runs under conditions; give verdicts on statements.

    skin study study=table
    skin study study=graphs study.part=norm
    skin study -m study=graphs,late_early simulator=naive
    skin study study=robustness study.part=dead study.rows=[features,gru]
    skin study study=margins study.run=latest

A study is a file of conf/study; study.part=NAME chooses a comparison of a file with several. It trains the
runs that are missing, with the budget in that file; rerun to resume. Writes study_<name>.md, .csv and .png
into out=, with the name of the study or the part. A measure of single runs, such as margins, writes files for
each, and of several runs study_<name>.csv with all values. Evaluations are kept in results/trials.
"""

import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from experiments.studies.study import Study, as_overrides, chosen_studies, passed_overrides
from skin.commands._command import command
from skin.core.files import results
from skin.errors import InputError
from skin.runs.configuration import validate_config

if TYPE_CHECKING:
    from experiments.studies.trials import Trial
    from skin.runs.store import Store


@command("study")
def main(config: DictConfig) -> None:
    """Train or find the runs of a study, measure them, and write and print the results."""
    studies = chosen_studies(config)
    folder = results(config.out) / ("smoke" if config.smoke else "")

    from skin.core.messages import quiet

    quiet()
    missing = False
    for study in studies:
        if not study.trainings and study.rows is None and study.run is None:
            if config.shard is not None:
                raise InputError(f"study={study.name} has no runs to divide: leave out shard={config.shard}")
            _measure_skin(study, folder)
        else:
            missing |= _compare(study, config, folder)
    if missing:
        sys.exit(1)


def _compare(study: Study, config: DictConfig, folder: Path) -> bool:
    """Measure the runs of a study, publish the results, and return whether a run is missing."""
    from rich.console import Console
    from rich.progress import track

    from experiments.studies.runs import find_runs, train_study
    from experiments.studies.trials import run_trials, votes
    from skin.core.files import whole
    from skin.runs.store import Store
    from skin.runs.sweep import Shard

    shard = Shard.parse(config.shard) if config.shard is not None else None
    if study.trainings:
        store, planned = train_study(study, shard, config.smoke)
    else:
        store = Store.open(config.tracking)
        planned = find_runs(study, config, store)
        if shard:
            fingerprints = shard.part(run.run.data.tags["fingerprint"] for run in planned if run.run)
            planned = [run for run in planned if run.run and run.run.data.tags["fingerprint"] in fingerprints]
    trials, console = list["Trial"](), Console(stderr=True)
    runs = track(planned, "measuring", console=console, transient=True, disable=not console.is_terminal)
    for trial in (trial for run in runs for trial in run_trials(store, run, study, config)):
        trials.append(trial)
        for name, content in trial.files.items():
            with whole(folder / name) as partial:
                partial.write_bytes(content)
        if trial.line:
            names = [folder / name for name in trial.files]
            print(f"{trial.variant.name} ({trial.run[:8]}): {trial.line}", *names, sep="\n", flush=True)
    if shard:
        print(f"shard {config.shard} is measured: the same command without shard= writes the results")
    else:
        _publish(study, [*trials, *votes(study, trials)], store, config, folder)
    return any(run.run is None for run in planned)


def _publish(
    study: Study, trials: Sequence["Trial"], store: "Store", config: DictConfig, folder: Path
) -> None:
    """Write and print the results of a study, and log their summary."""
    from experiments.studies.study_page import publish_files, publish_study

    path = folder / f"study_{study.name}"
    if not study.metrics:
        paths = publish_files(study, trials, path.with_suffix(".csv"))
    else:
        smoke = "SMOKE, one epoch on little data, ignore the scores: " * config.smoke
        settings = [word for word in passed_overrides() if not word.startswith("tracking.")]
        small = study.small if smoke else ()
        title = smoke + ", ".join([f"{study.name}: {study.about}", *small, *settings])
        paths = publish_study(study, title, trials, path)
        _log_summary(study, trials, store, paths)
    if study.report_figures:
        from experiments.studies.report_figures import draw_report

        paths = draw_report(trials, folder)
        print(f"{len(paths)} figures of the report in {folder}")


def _log_summary(study: Study, trials: Sequence["Trial"], store: "Store", paths: Sequence[Path]) -> None:
    """Log the means and the files of a study in its run in MLflow, the same one each time."""
    from experiments.studies.outcomes import group_trials, values

    earlier = store.find(study=study.name)
    with store.run(f"study {study.name}", {"study": study.name}, again=next(iter(earlier), None)) as run:
        means = {}
        for (variant, condition), group in group_trials(trials).items():
            for metric in study.metrics:
                if figures := values(group, metric):
                    # MLflow takes these characters only.
                    name = re.sub(r"[^\w\-. :/]", "_", "/".join(filter(None, (variant, condition, metric))))
                    means[name] = sum(figures.values()) / len(figures)
        store.log_metrics(run, means)
        for path in paths:
            store.client.log_artifact(run.info.run_id, str(path))


def _measure_skin(study: Study, folder: Path) -> None:
    """Apply the measure of a study without runs to the skin."""
    from hydra import compose

    from experiments.studies.measures import Subject
    from experiments.studies.tables import publish_page
    from skin.runs.build import build_device

    if study.measure is None:
        raise InputError(f"study={study.name} has nothing to measure: set study.rows=all or study.trainings")
    config = validate_config(compose("train", [*as_overrides(study.test), *passed_overrides()]))
    page = study.measure(Subject(config, build_device(config))).page
    paths = publish_page(page, f"{study.name}: {study.about}", folder / f"study_{study.name}")
    print(page.about, *paths, sep="\n")

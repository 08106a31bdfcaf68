"""The runs that a study is about: those that it trains, and finished ones."""

import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory

import numpy as np
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from omegaconf import DictConfig

from experiments.studies.study import Study, Variant, sweeps, variants
from skin.commands import train
from skin.core.messages import PARENT
from skin.errors import InputError
from skin.evaluation.metrics import OUTCOMES
from skin.runs.configuration import fingerprint
from skin.runs.finished_run import find_run
from skin.runs.store import Store, note_reuse
from skin.runs.sweep import LEFT_OUT, Shard
from skin.runs.train import SWEPT, simulator


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


def _only(configs: Mapping[str, DictConfig], fingerprints: Collection[str]) -> dict[str, DictConfig]:
    """Return the configurations with these fingerprints."""
    return {seed: config for seed, config in configs.items() if fingerprint(config) in fingerprints}


def find_runs(study: Study, config: DictConfig, store: Store) -> list[Planned]:
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


def newest_finished(store: Store, config: DictConfig) -> Run | None:
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
        for name in (PARENT, SWEPT, LEFT_OUT):  # of a sweep, which has ended
            os.environ.pop(name, None)
        if traceback is not None:
            os.environ["HYDRA_FULL_ERROR"] = traceback


def load_outcomes(store: Store, run: Run) -> np.ndarray | None:
    """Return the outcomes of the test gestures of a run, (B,), uint8; None if it has none."""
    if OUTCOMES not in {file.path for file in store.client.list_artifacts(run.info.run_id)}:
        return None
    with TemporaryDirectory() as folder:
        path = download_artifacts(
            run_id=run.info.run_id, artifact_path=OUTCOMES, dst_path=folder, tracking_uri=store.uri
        )
        outcomes: np.ndarray = np.load(path)
        return outcomes


def _look(store: Store, every: Sequence[Variant]) -> list[Planned]:
    return [
        Planned(variant, seed, newest_finished(store, config))
        for variant in every
        for seed, config in variant.configs.items()
    ]


def _name(run: Run) -> str:
    """Return the name of a run without its seed."""
    return re.sub(r"( seed)? \d+$", "", run.info.run_name)

"""The runs that a study is about: those that it trains, and finished ones."""

import os
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from tempfile import TemporaryDirectory

import numpy as np
from hydra import compose
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.singleton import Singleton
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from omegaconf import DictConfig

from experiments.studies.row_ensembles import combine
from experiments.studies.study import SMOKE, Study, Variant, as_overrides, passed_overrides, sweeps, variants
from skin.commands import train
from skin.config import PARENT, fingerprint, validate_config
from skin.errors import InputError
from skin.evaluation.outcomes import OUTCOMES
from skin.finished_run import find_run
from skin.run import SWEPT, simulator
from skin.shard import LEFT_OUT, Shard
from skin.source import note_reuse
from skin.tracking import Store


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
        The store, and all runs of the study or the shard; only all runs together make ensembles.
    """
    every = variants(study, smoke)
    store = Store.open(next(iter(every[0].configs.values())).tracking)
    if shard:
        own = shard.part(fingerprint(config) for one in every for config in one.configs.values())
        every = [replace(one, configs=_those(one.configs, own)) for one in every]
    if study.train and any(one.run is None for one in _look(store, every)):
        for _, line in sweeps(study, smoke):
            multirun([*line, f"+hydra.callbacks.sweep.runs={sorted(own)}"] if shard else line)
    planned = _look(store, every)
    return store, planned if shard else planned + _ensembles(study, store, planned, smoke)


def _those(configs: Mapping[str, DictConfig], fingerprints: Collection[str]) -> dict[str, DictConfig]:
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
        return [Planned(Variant(_name(run), {}, {}), run.data.tags.get("seed", ""), run)]
    found: dict[tuple[str, str], Planned] = {}
    data = simulator(config)
    for run in store.find("FINISHED", simulator=data):
        row = run.data.tags["row"]
        wanted = study.rows == "all" or row in study.rows
        if wanted and "learned" in run.data.tags and int(run.data.tags["seed"]) in study.seeds:
            one = Planned(Variant(_name(run), {"row": row}, {}), run.data.tags["seed"], run)
            found.setdefault((one.variant.name, one.seed), one)
    rows = {one.variant.chosen["row"] for one in found.values()}
    missing = [] if study.rows == "all" else [row for row in study.rows if row not in rows]
    missing = missing or ([] if rows else ["features"])
    if missing:
        raise InputError(
            f"no finished run of {', '.join(missing)} on {data} data in {store.uri}: "
            f"skin train experiment={missing[0]} simulator={data} makes one"
        )
    return [found[key] for key in sorted(found)]


def newest_finished(store: Store, config: DictConfig) -> Run | None:
    """Return the newest finished run of a configuration."""
    found = store.find("FINISHED", fingerprint=fingerprint(config))
    if found:
        note_reuse(found[0])
    return found[0] if found else None


def multirun(line: Sequence[str]) -> int:
    """Train the sweep of some overrides, as ``skin train -m`` does, and return the exit code.

    Failed runs are reported and skipped.
    """
    sources = HydraConfig.get().runtime.config_sources
    folder = [one.path for one in sources if one.provider == "command-line"]  # of --config-dir
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
    state, shown = Singleton.get_state(), os.environ.pop("HYDRA_FULL_ERROR", None)
    GlobalHydra.instance().clear()
    try:
        yield
    finally:
        Singleton.set_state(state)
        for name in (PARENT, SWEPT, LEFT_OUT):  # of a sweep, which has ended
            os.environ.pop(name, None)
        if shown is not None:
            os.environ["HYDRA_FULL_ERROR"] = shown


def load_outcomes(store: Store, run: Run) -> np.ndarray | None:
    """Return the outcomes of the test gestures of a run, (B,), uint8; None if it has none."""
    if OUTCOMES not in artifact_names(store, run):
        return None
    with TemporaryDirectory() as folder:
        path = download_artifacts(
            run_id=run.info.run_id, artifact_path=OUTCOMES, dst_path=folder, tracking_uri=store.uri
        )
        outcomes: np.ndarray = np.load(path)
        return outcomes


def artifact_names(store: Store, run: Run) -> set[str]:
    """Return the names of the files and folders that were logged with a run."""
    return {one.path for one in store.client.list_artifacts(run.info.run_id)}


def _look(store: Store, every: Sequence[Variant]) -> list[Planned]:
    return [
        Planned(variant, seed, newest_finished(store, config))
        for variant in every
        for seed, config in variant.configs.items()
    ]


def _ensembles(study: Study, store: Store, members: Sequence[Planned], smoke: bool) -> list[Planned]:
    """Return the ensembles of the finished runs of each seed, in each way that the study names."""
    suffix = "" if study.rows is None else "_of_" + "_".join(study.rows)
    ways = {way: Variant(way, {"row": way}, {}) for way in study.ensembles}
    planned = []
    for seed in dict.fromkeys(one.seed for one in members) if ways else ():
        for way, variant in ways.items():
            line = [*as_overrides(study.common), *(SMOKE if smoke else ()), *passed_overrides()]
            line += [f"seed={seed}", f"row={way}{suffix}"]
            variant.configs[seed] = validate_config(compose("train", line))
        present = {
            one.variant.name: (one.variant.configs[seed], one.run)
            for one in members
            if one.seed == seed and one.run is not None
        }
        runs = combine(store, present, {way: variant.configs[seed] for way, variant in ways.items()})
        planned += [Planned(ways[way], seed, run) for way, run in runs.items()]
    return planned


def _name(run: Run) -> str:
    """Return the name of a run without its seed."""
    return re.sub(r"( seed)? \d+$", "", run.info.run_name)

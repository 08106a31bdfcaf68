"""A sweep: one parent run in MLflow, one line of progress per job. The UI of MLflow compares its runs."""

import atexit
import os
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, cast

from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from skin.core.messages import PARENT, to_input_error
from skin.errors import InputError
from skin.runs.configuration import (
    check_server,
    fingerprint,
    refuse_unknown,
    shorten,
    validate_config,
)

if TYPE_CHECKING:
    from skin.runs.store import Store


# Shards: parts of the jobs of a multirun or a study, for the tasks of a job array.


LEFT_OUT = "SKIN_LEFT_OUT"
"""Environment variable with the numbers of the jobs of a multirun that belong to other shards."""


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count`` disjoint parts that together are complete.

    Attributes:
        number: of this part, from 1.
        count: number of parts.
    """

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Return the shard that a setting names, such as ``3/8``.

        Raises:
            InputError: the text names no shard.
        """
        match = re.fullmatch(r"([0-9]+)/([0-9]+)", text)
        number, count = map(int, match.groups()) if match else (0, 0)
        if not 1 <= number <= count:
            raise InputError(
                f"shard={text} names no part: give i/n with i from 1 to n, as in shard=3/8; an array that "
                "counts from 0 needs i + 1"
            )
        return cls(number, count)

    def part(self, names: Iterable[str]) -> set[str]:
        """Return every ``count``-th of the different names, sorted, from this shard's number on.

        The order of the names does not matter. Names that are fingerprints of runs mix cheap and expensive
        ones, and runs that several jobs have in common are in one part.
        """
        return set(sorted(set(names))[self.number - 1 :: self.count])


def belongs_to_other_shard() -> bool:
    """Return whether the running job of a multirun belongs to another shard."""
    return str(HydraConfig.get().job.num) in os.environ.get(LEFT_OUT, "").split()


def sweep_jobs(overrides: list[str], parameters: Mapping[str, str]) -> list[dict[str, str]]:
    """Return the overrides of each job of a multirun, in the order of Hydra's own sweeper.

    Args:
        overrides: of the command line; of equal keys the last one counts.
        parameters: ``hydra.sweeper.params``.

    Raises:
        InputError: an interval, which has no discrete values.
    """
    # glob(...) needs a loader to list options.
    loader = GlobalHydra.instance().config_loader() if GlobalHydra.instance().is_initialized() else None
    lines = [f"{key}={value}" for key, value in parameters.items()] + overrides
    parsed = OverridesParser.create(loader).parse_overrides(lines)
    swept = [override for override in parsed if override.is_sweep_override()]
    if drawn := [override for override in swept if not override.is_discrete_sweep()]:
        raise InputError(
            f"{drawn[0].input_line} names no values to try: give {drawn[0].get_key_element()}=1,2 or a "
            "sweeper that draws them, as hydra/sweeper=optuna"
        )
    (jobs,) = BasicSweeper.split_arguments(parsed, None)
    return [_parse_choices(job) for job in jobs]


def sweep_title(jobs: Sequence[Mapping[str, str]], swept: Sequence[str]) -> str:
    """Return the swept settings, such as ``model.norm=none,layer × seed=0,1``, for the name of a run."""
    values = {key: dict.fromkeys(job[key] for job in jobs) for key in swept}
    return " × ".join(f"{key.lstrip('+')}={','.join(tried)}" for key, tried in values.items())


def _parse_choices(overrides: Iterable[str]) -> dict[str, str]:
    """Return the keys and values of overrides."""
    return dict(override.split("=", 1) for override in overrides)  # type: ignore[misc]


def _words(config: DictConfig) -> list[str]:
    """Return the overrides of a command line or a job, with interpolations as they were written."""
    return cast(list[str], OmegaConf.to_container(config.hydra.overrides.task))


class SweepCallback(Callback):
    """Hydra's callback of every command: opens and closes the parent run, tells how each job ended.

    The parent exists before the first job, and with it database and experiment: jobs that start at once must
    not race to make them. Hydra does not call ``on_multirun_end`` when a job has failed, so the parent is
    closed at exit, as FAILED. A parent that has no children by then, because each job was finished before or
    refused, is deleted.

    Only Hydra's own sweeper has a list of jobs. Others choose each by the objectives of those before it.

    Args:
        parent: whether the jobs are runs; a command whose jobs run sweeps of their own has no parent run.
        runs: fingerprints of the runs to train; None: those of the shard.
    """

    def __init__(self, parent: bool = True, runs: Collection[str] | None = None) -> None:
        self._wanted, self._runs = parent, runs
        self._store: Store | None = None
        self._held = ExitStack()  # the lock of the parent
        self._jobs: list[int] = []  # numbers of the jobs of this shard; empty: unknown
        self._swept: list[str] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return what jobs in other processes need: they print how they ended."""
        return vars(self) | {"_held": None}

    def on_run_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Refuse to divide a single job."""
        if self._wanted and (shard := config.get("shard")) is not None:
            _refuse(InputError(f"shard={shard} divides the jobs of a multirun or a study: add -m"))

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Open the parent run, and pass it to the jobs."""
        try:
            if self._wanted:
                self._begin(config)
        except Exception as error:
            refused = to_input_error(error)
            if refused is None:
                raise
            _refuse(refused)

    def _begin(self, config: DictConfig) -> None:
        """Choose the jobs, and make the parent run."""
        words = _words(config)
        # Swept or not, Hydra lists only what belongs to jobs here.
        if config.hydra.sweeper._target_.endswith(f".{BasicSweeper.__name__}"):
            jobs = sweep_jobs(words, config.hydra.sweeper.params or {})
            self._swept = [key for key in jobs[0] if len({job[key] for job in jobs}) > 1]
        elif config.get("shard") is not None:
            raise InputError(f"shard={config.shard} divides a list of jobs, which this sweeper does not have")
        else:
            jobs, parsed = [], OverridesParser.create().parse_overrides(words)
            self._swept = [override.get_key_element() for override in parsed if override.is_sweep_override()]
        if config.hydra.job.config_name == "train":
            refuse_unknown(config)
        self._choose(config, jobs)
        if "tracking" not in config:
            return
        settings = validate_config(config).tracking
        check_server(settings.uri)
        config.tracking.uri = settings.uri  # without its password, for the file that Hydra writes

        from joblib import cpu_count, effective_n_jobs

        from skin.runs.store import Store

        title = sweep_title(jobs or [_parse_choices(words)], self._swept)
        name = shorten(config.hydra.runtime.choices.get("sweep") or title or "sweep")
        self._store = Store.open(settings)
        self._parent = self._store.create(name, {"sweep": name}).info.run_id
        self._held.enter_context(self._store.hold(self._parent))
        atexit.register(self._close)
        os.environ[PARENT] = self._parent
        parallel = config.hydra.launcher.get("n_jobs") or 1  # of joblib's launcher
        if parallel != 1:
            # Two jobs with two threads each are several times slower than two with one.
            threads = max(1, cpu_count() // effective_n_jobs(parallel))
            os.environ.setdefault("OMP_NUM_THREADS", str(threads))

    def _choose(self, config: DictConfig, jobs: Sequence[Mapping[str, str]]) -> None:
        """Choose the jobs of this shard, and tell the others that they have nothing to do."""
        shard = None if config.get("shard") is None else Shard.parse(config.shard)
        divided = (shard or self._runs is not None) and config.hydra.job.config_name == "train"
        names = [_identify_job(config, job) if divided else str(job) for job in jobs]
        chosen = (shard or Shard(1, 1)).part(names) if self._runs is None else self._runs
        self._jobs = [number for number, name in enumerate(names) if name in chosen]
        os.environ[LEFT_OUT] = " ".join(str(n) for n in range(len(names)) if n not in self._jobs)
        if jobs and not self._jobs:
            if self._runs is None:
                print(f"shard {config.shard} has no job: the sweep has only {len(set(names))}")
            sys.exit(0)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Print how a job ended."""
        # A single run has no number.
        if self._store is None or str(config.hydra.job.num) in os.environ.get(LEFT_OUT, "").split():
            return
        number, value = config.hydra.job.num, job_return._return_value  # of a failed job, its exception
        count = f"{self._jobs.index(number) + 1}/{len(self._jobs)}" if self._jobs else f"{number + 1}"
        job, failed = _parse_choices(_words(config)), job_return.status == JobStatus.FAILED
        label = f"[{count}] {' '.join(f'{key}={job[key]}' for key in self._swept or job)}"
        scored = "" if failed or value is None else f", {value:.4f} on validation gestures"
        print(
            f"{label}: {value if failed else 'done'}{scored}",
            file=sys.stderr if failed else sys.stdout,
            flush=True,
        )

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Close the parent run: no job has failed."""
        self._close(ended=True)

    def _close(self, ended: bool = False) -> None:
        """End the parent run, once: FINISHED if no job failed; delete it without children."""
        store, self._store = self._store, None
        # Errors of the database were reported before; the next start closes the run.
        with suppress(Exception), self._held:
            if store is not None:
                store.end(self._parent, "FINISHED" if ended else "FAILED")
                if not store.find(**{"mlflow.parentRunId": self._parent}):
                    store.client.delete_run(self._parent)


def _refuse(error: InputError) -> NoReturn:
    """End the command; Hydra passes only exits on from a callback."""
    print(error, file=sys.stderr)
    sys.exit(2)


def _identify_job(config: DictConfig, job: Mapping[str, str]) -> str:
    """Return the fingerprint of a training; of one that will be refused, its overrides."""
    words = [f"{key}={value}" for key, value in job.items()]
    try:
        whole = GlobalHydra.instance().config_loader().load_sweep_config(config, words)
        return fingerprint(validate_config(whole))
    except InputError:
        return str(job)

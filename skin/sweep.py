"""A sweep: one parent run in MLflow, one line of progress per job."""

import atexit
import csv
import math
import os
import sys
import time
from collections.abc import Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from skin.config import CONF, ROOT, Tracking, checked
from skin.refusal import refusal

if TYPE_CHECKING:
    from skin.tracking import Store

__all__ = ["Progress", "Sweep", "jobs"]


def jobs(overrides: list[str], parameters: Mapping[str, str]) -> list[dict[str, str]]:
    """Return what Hydra's sweeper will choose in each job of a multirun, in its order.

    Args:
        overrides: of the command line; the later one of a key holds.
        parameters: ``hydra.sweeper.params``.
    """
    lines = [f"{key}={value}" for key, value in parameters.items()] + overrides
    choices: dict[str, list[str]] = {}
    for override in OverridesParser.create().parse_overrides(lines):
        swept = override.is_sweep_override()
        values = list(override.sweep_string_iterator()) if swept else [override.get_value_element_as_str()]
        choices[override.get_key_element()] = values
    return [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]


class Progress:
    """Counts jobs and estimates what is left.

    Args:
        seconds: what each job took before on some machine, in order; None where nobody knows.
    """

    def __init__(self, seconds: list[float | None]) -> None:
        known = [value for value in seconds if value is not None]
        typical = sum(known) / len(known) if known else 1.0
        self._expected = [typical if value is None else value for value in seconds]
        self._sure = bool(known)
        self._spent = self._done = 0.0

    def finish(self, number: int, seconds: float, skipped: bool) -> None:
        """Note that a job has ended; one that was skipped says nothing about the machine's speed."""
        if not skipped:
            self._spent += seconds
            self._done += self._expected[number]
        self._expected[number] = 0.0

    def left(self) -> float | None:
        """Return the estimated rest, s, scaled by this machine's speed so far; None if nothing is known."""
        if not self._done:
            return sum(self._expected) if self._sure else None
        return sum(self._expected) * self._spent / self._done


class Sweep(Callback):
    """Hydra's callback of every command: opens and closes the parent run, prints progress.

    The parent exists before the first job, and with it database and experiment: jobs that start at once must
    not race to make them. Hydra does not call ``on_multirun_end`` when a job has failed, so the parent is
    closed at exit.
    """

    def __init__(self) -> None:
        self._store: Store | None = None
        self._parent = ""
        self._failed = 0
        self._jobs: list[dict[str, str]] = []
        self._swept: list[str] = []
        self._progress = Progress([])
        self._began = 0.0

    def on_multirun_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Open the parent run and tell the jobs about it."""
        try:
            store = self._open(config)
        except Exception as error:
            refused = refusal(error)
            if refused is None:
                raise
            # What no job could accept is refused once, before any of them; Hydra lets only exits pass here.
            print(refused, file=sys.stderr)
            sys.exit(2)

        from skin.run import SWEPT

        _share_cores(config.hydra.launcher)
        atexit.register(self._close)
        # Swept or not, Hydra lists only what belongs to jobs here.
        self._jobs = jobs(list(config.hydra.overrides.task), config.hydra.sweeper.params or {})
        self._swept = [key for key in self._jobs[0] if len({job[key] for job in self._jobs}) > 1]
        os.environ[SWEPT] = " ".join(self._swept)
        self._progress = Progress([_seconds(store, job) for job in self._jobs])

    def _open(self, config: DictConfig) -> "Store":
        """Make the folder that Hydra writes to, and the parent run."""
        settings = _tracking(config)
        Path(config.hydra.sweep.dir).mkdir(parents=True, exist_ok=True)

        from skin.run import PARENT
        from skin.tracking import Store

        self._store = store = Store.open(settings)
        name = config.hydra.runtime.choices.get("sweep") or "sweep"
        self._parent = store.create(name, {"sweep": name}).info.run_id
        os.environ[PARENT] = self._parent
        return store

    def on_job_start(self, config: DictConfig, **kwargs: Any) -> None:
        """Print which job begins."""
        self._began = time.monotonic()
        if self._parent:
            print(f"{self._label(config)} …{self._rest()}", flush=True)

    def on_job_end(self, config: DictConfig, job_return: JobReturn, **kwargs: Any) -> None:
        """Print how a job ended."""
        if not self._parent:
            return
        number, seconds = int(config.hydra.job.num), time.monotonic() - self._began
        if job_return.status == JobStatus.FAILED:
            self._failed += 1
            print(f"{self._label(config)} failed: {job_return._return_value}", file=sys.stderr, flush=True)
        elif job_return._return_value is False:
            print(f"{self._label(config)} was finished before", flush=True)
        else:
            print(f"{self._label(config)} took {_clock(seconds)}", flush=True)
        self._progress.finish(number, seconds, job_return._return_value is False)

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        """Close the parent run."""
        self._close()

    def _close(self) -> None:
        """End the parent run, once: FINISHED only if every job came to its end."""
        store, self._store = self._store, None
        if store is None:
            return
        whole = self._failed == 0 and sum(self._progress._expected) == 0
        # A database that refuses was told of before, and nobody hears an exit; the next start closes the run.
        with suppress(Exception):
            store.client.set_terminated(self._parent, "FINISHED" if whole else "FAILED")

    def _label(self, config: DictConfig) -> str:
        number = int(config.hydra.job.num)
        job = self._jobs[number]
        chosen = " ".join(f"{key}={job[key]}" for key in self._swept or job)
        return f"[{number + 1}/{len(self._jobs)}] {chosen}"

    def _rest(self) -> str:
        left = self._progress.left()
        return "" if left is None else f" about {_clock(left)} left"


def _share_cores(launcher: DictConfig) -> None:
    """Give every job of a parallel launcher (joblib's, submitit's) its share of the cores.

    Two jobs with two threads each are several times slower than two with one.
    """
    parallel = launcher.get("n_jobs") or 1
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if parallel != 1:
        count = cores if parallel < 0 else min(parallel, cores)
        os.environ.setdefault("OMP_NUM_THREADS", str(max(1, cores // count)))


def _tracking(config: DictConfig) -> Tracking:
    """Return the settings that all jobs share; a multirun's own configuration has them too."""
    whole = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    return checked(whole).tracking


def _seconds(store: "Store", job: dict[str, str]) -> float | None:
    """Return how long the last finished run of the same row and simulator took, s.

    Where there is none, the published table tells: its seconds per epoch times the epochs of the row, and a
    third more for the evaluation.
    """
    row, simulator = job.get("experiment", "custom"), job.get("simulator", "fem")
    finished = store.find("FINISHED", row=row, simulator=simulator)
    if finished:
        info = finished[0].info
        return (info.end_time - info.start_time) / 1e3
    published, experiment = ROOT / "docs" / "results" / "table.csv", CONF / "experiment" / f"{row}.yaml"
    if not published.is_file() or not experiment.is_file():
        return None
    with published.open(newline="") as file:
        for line in csv.DictReader(file):
            if (line["row"], line["simulator"]) == (row, simulator) and line["seconds_per_epoch"]:
                epochs = OmegaConf.select(OmegaConf.load(experiment), f"epochs.{simulator}", default=1)
                return 5 + 1.3 * epochs * float(line["seconds_per_epoch"])
    return None


def _clock(seconds: float) -> str:
    minutes = math.ceil(seconds / 60)
    return f"{seconds:.0f} s" if seconds < 90 else f"{minutes} min"

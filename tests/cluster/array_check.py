"""Check that a job array loses no run, although processes are killed.

    python -m tests.cluster.array_check FOLDER http://127.0.0.1:5000

Trains 60 short runs on this machine, then as an array of 8 tasks on the server, of which two are killed with
-9; submits the array again, and compares the tables. Uses SLURM where ``SLURM_CONF`` names a cluster
(slurm.sh), otherwise one process after the other with the variables that SLURM would set.

Exit code 1 if the check fails.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from skin.core.files import ROOT
from skin.runs.configuration import Tracking
from skin.runs.run import PROCESS
from skin.runs.store import Store

FOLDER = ROOT / "experiments" / "cluster"
STUDY = ["study", "--config-dir", str(FOLDER / "conf"), "study=short_runs"]
TASKS, RUNS = 8, 60
EXPERIMENT = "studies"  # as in conf/study.yaml


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("uri")
    parser.add_argument("--kill", type=int, default=2, help="number of processes to kill")
    parser.add_argument("--seed", type=int, default=0, help="of the choice of the processes")
    sys.exit(0 if check_array(**vars(parser.parse_args())) else 1)


def check_array(folder: Path, uri: str, kill: int, seed: int) -> bool:
    """Kill processes of an array, and return whether each run is there once and the tables agree."""
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    expected = table(folder / "one_machine", f"sqlite:///{folder}/one_machine.db")
    store = Store.open(Tracking(uri, None, EXPERIMENT, True, None))
    killer = Killer(store, kill, random.Random(seed))
    first = submit(folder, uri, killer)
    lost = RUNS - len(store.find("FINISHED", row="rules"))
    print(f"killed {killer.killed} processes: exit codes {first}, {lost} runs missing", flush=True)
    second = submit(folder, uri, lambda: None)
    finished = Counter(run.data.tags["fingerprint"] for run in store.find("FINISHED", row="rules"))
    same = table(folder / "array", uri) == expected
    runs = f"{len(finished)} different runs of {finished.total()}"
    print(f"submitted again: exit codes {second}, {runs}; same table: {same}")
    return same and set(finished.values()) == {1} and len(finished) == RUNS and any(first)


class Killer:
    """Kills processes that are in the middle of a run.

    Args:
        store: of the runs.
        count: number of processes to kill.
        generator: of the choice among the running ones.
    """

    def __init__(self, store: Store, count: int, generator: random.Random) -> None:
        self._store, self._count, self._generator = store, count, generator
        self.killed: list[int] = []

    def __call__(self) -> None:
        """Kill one process, if enough runs have finished since the last one."""
        enough = len(self._store.find("FINISHED", row="rules")) >= 10 * (1 + len(self.killed))
        if len(self.killed) < self._count and enough and (pids := self._running()):
            pid = self._generator.choice(pids)
            os.kill(pid, signal.SIGKILL)
            self.killed.append(pid)

    def _running(self) -> list[int]:
        """Return the processes of this machine that train now."""
        return sorted(int(run.data.tags[PROCESS]) for run in self._store.find("RUNNING", row="rules"))


def table(folder: Path, uri: str) -> bytes:
    """Return the table of the study; runs that are missing are trained."""
    words = [*STUDY, f"tracking.uri={uri}", f"out={folder}"]
    subprocess.run([sys.executable, "-m", "skin", *words], cwd=folder.parent, env=environment(), check=True)
    return (folder / "study_short_runs.csv").read_bytes()


def submit(folder: Path, uri: str, meanwhile: Callable[[], None]) -> list[int]:
    """Run the array and return the exit codes of its tasks."""
    script = [str(FOLDER / "array.sh"), *STUDY, f"tracking.uri={uri}", f"out={folder}/array"]
    return (slurm if "SLURM_CONF" in os.environ else in_turn)(script, folder, meanwhile)


def slurm(script: Sequence[str], folder: Path, meanwhile: Callable[[], None]) -> list[int]:
    """Submit the script to SLURM and wait for its tasks."""
    command = ["sbatch", "--parsable", f"--array=1-{TASKS}", f"--output={folder}/slurm-%A_%a.log", *script]
    answer: Any = {"check": True, "capture_output": True, "text": True}
    job = subprocess.run(command, cwd=folder, env=environment(), **answer).stdout.strip()
    print(f"sbatch: job {job}, {TASKS} tasks", flush=True)
    ask = ["scontrol", "--oneliner", "show", "job", job]
    while True:
        lines = subprocess.run(ask, **answer).stdout.splitlines()
        tasks = [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines if line]
        if all(task["JobState"] in ("COMPLETED", "FAILED", "CANCELLED", "NODE_FAIL") for task in tasks):
            return [sum(map(int, task["ExitCode"].split(":"))) for task in tasks]
        meanwhile()
        time.sleep(1)


def in_turn(script: Sequence[str], folder: Path, meanwhile: Callable[[], None]) -> list[int]:
    """Run the tasks of the script as SLURM would, one after the other."""
    codes = []
    for task in range(1, TASKS + 1):
        variables = {"SLURM_ARRAY_TASK_ID": str(task), "SLURM_ARRAY_TASK_COUNT": str(TASKS)}
        with subprocess.Popen(script, cwd=folder, env=environment() | variables) as running:
            while running.poll() is None:
                meanwhile()
                with suppress(subprocess.TimeoutExpired):
                    running.wait(1)
        codes.append(running.returncode)
    return codes


def environment() -> dict[str, str]:
    return os.environ | {"PYTHON": sys.executable, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}


if __name__ == "__main__":
    main()

"""Runs commands, each in a fork of a process that has imported the heavy libraries once.

A line of standard input is a job, and its process's number the answer; or it asks for the exit code of such a
process. A job has a process of its own, with its own folder, environment, files and end, as one that a shell
starts; only imports are shared, and the empty database that MLflow takes seconds to make. Where there is no
fork (Windows), or none that libraries bear (macOS), it is started anew.
"""

import atexit
import gc
import json
import os
import runpy
import shutil
import signal
import subprocess
import sys
import threading
from importlib import import_module
from pathlib import Path
from typing import Any

__all__ = ["main"]

WARM = (
    "alembic.command",
    "mlflow.store.tracking.sqlalchemy_store",
    "pytorch_lightning.callbacks",
    "skfem",
    "skin.learner.features",
    "skin.learner.network",
    "skin.evaluation.show",
    "skin.run",
)


def main() -> None:
    """Run jobs until standard input ends; returns in every fork, too, which then runs its script."""
    forks = hasattr(os, "fork") and sys.platform != "darwin"
    started: dict[int, subprocess.Popen[bytes]] = {}
    made = _warm() if forks else {}
    if forks:
        _share_database(Path(os.environ["SKIN_CACHE"]) / "empty.db")
        assert threading.active_count() == 1, "a fork keeps one thread"
        gc.freeze()  # else every fork would copy what it never changes
    for line in sys.stdin:
        job = json.loads(line)
        if (number := job.get("ended")) in started:
            answer = started[number].wait() if job["wait"] else started[number].poll()
        elif number is not None:
            ended, status = os.waitpid(number, 0 if job["wait"] else os.WNOHANG)
            answer = os.waitstatus_to_exitcode(status) if ended else None
        elif not forks:
            process = _started(job)
            started[answer := process.pid] = process
        elif (answer := os.fork()) == 0:
            _become(job, made)
            return
        print(json.dumps(answer), flush=True)


def _warm() -> dict[str, str]:
    """Import what nearly every command imports; return what that sets in the environment."""
    before = dict(os.environ)
    for name in WARM:
        import_module(name)
    return {name: value for name, value in os.environ.items() if before.get(name) != value}


def _share_database(empty: Path) -> None:
    """Let a store that does not exist yet begin as a copy of an empty one."""
    from mlflow import MlflowClient

    from skin.tracking import Store

    if (child := os.fork()) == 0:  # which takes its connections with it
        MlflowClient(f"sqlite:///{empty}").search_experiments()
        os._exit(0)
    os.waitpid(child, 0)
    as_it_is = Store.open

    def opened(settings: Any) -> Store:
        path = Path((settings.uri or "").removeprefix("sqlite:///"))
        if settings.uri and empty.exists() and path.parent.is_dir() and not path.exists():
            shutil.copy(empty, path)
        return as_it_is(settings)

    Store.open = opened  # type: ignore[method-assign, assignment]


def _become(job: dict[str, Any], made: dict[str, str]) -> None:
    """Turn this process into the command."""
    os.environ.clear()
    os.environ.update(made | job["environment"])
    os.chdir(job["folder"])
    for number, name in enumerate((job["in"], job["out"], job["err"])):
        file = os.open(name, os.O_RDWR)
        os.dup2(file, number)
        os.close(file)
    signal.alarm(job["seconds"])
    script, *arguments = job["command"]
    sys.argv, sys.path[0] = [script, *arguments], str(Path(script).parent)
    code = 0
    try:
        runpy.run_path(script, run_name="__main__")
    except SystemExit as end:
        if not isinstance(end.code, int | None):
            raise
        code = end.code or 0
    _end(code)


def _end(code: int) -> None:
    """End as the interpreter does, but do not free each object of every library: that takes half a second."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def _started(job: dict[str, Any]) -> subprocess.Popen[bytes]:
    with open(job["in"]) as given, open(job["out"], "w") as out, open(job["err"], "w") as err:
        command, files = [sys.executable, *job["command"]], {"stdin": given, "stdout": out, "stderr": err}
        return subprocess.Popen(command, cwd=job["folder"], env=job["environment"], **files)


if __name__ == "__main__":
    main()

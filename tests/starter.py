"""Runs commands, each in a fork of a process that has imported the heavy libraries once.

Processes that run tests connect to a socket. A line is a job, and its process's number the answer; or it asks
for the exit code and the processor time of such a process. A job has a process of its own, with its own
folder, environment, files and end, as one that a shell starts; only imports are shared, and an empty
database. It ends when nobody is connected any more.
"""

import atexit
import gc
import json
import os
import pickle
import runpy
import shutil
import signal
import socket
import sys
import threading
from collections.abc import Callable
from importlib import import_module
from io import StringIO
from pathlib import Path
from select import select
from typing import Any, TextIO

__all__ = ["copying", "main", "remembering"]
WARM = ["alembic.command", "mlflow.store.tracking.sqlalchemy_store", "scipy.stats"]
WARM += [
    f"skin.{name}"
    for name in ("learning.boosted_trees", "learning.training", "evaluation.report", "runs.train")
]


def main() -> None:
    """Run jobs until nobody is connected; returns in every fork, too, which then runs its script."""
    folder = Path(sys.argv[1])
    gc.disable()
    made = _warm()
    from omegaconf import OmegaConf

    from skin.core.files import CONF
    from skin.runs.store import Store

    Store.open = copying(lambda: Path(sys.argv[2]))  # type: ignore[method-assign, assignment]
    OmegaConf.load = staticmethod(remembering(OmegaConf.load))  # type: ignore[method-assign]
    for path in CONF.rglob("*.yaml"):
        with path.open() as file:
            OmegaConf.load(file)
    assert threading.active_count() == 1, "a fork keeps one thread"
    gc.freeze()  # else every fork would copy what it never changes
    gc.enable()
    server = socket.socket(socket.AF_UNIX)
    server.bind(str(folder / "jobs"))
    server.listen()
    print("ready", flush=True)
    clients: dict[socket.socket, TextIO] = {}
    _accept(server, clients)
    while clients:
        for ready in select([server, *clients], [], [])[0]:
            if ready is server:
                _accept(server, clients)
            elif not (line := clients[ready].readline()):
                clients.pop(ready).close()
                ready.close()
            else:
                job = json.loads(line)
                if "ended" in job:
                    answer = _ended(job["ended"])
                elif (answer := os.fork()) == 0:
                    server.close()
                    _become(job, made)
                    return
                print(json.dumps(answer), file=clients[ready], flush=True)


def _accept(server: socket.socket, clients: dict[socket.socket, TextIO]) -> None:
    """Add the next connection, and greet it: who reads no greeting came too late."""
    client = server.accept()[0]
    clients[client] = client.makefile("rw")
    print("ready", file=clients[client], flush=True)


def _ended(number: int) -> tuple[int, float] | None:
    """Return the exit code of a process and its processor time, s; None while it runs."""
    ended, status, used = os.wait4(number, os.WNOHANG)
    return (os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime) if ended else None


def _warm() -> dict[str, str]:
    """Import what nearly every command imports; return what that sets in the environment."""
    before = dict(os.environ)
    for name in WARM:
        import_module(name)
    return {name: value for name, value in os.environ.items() if before.get(name) != value}


def copying(empty: Callable[[], Path]) -> Callable[[Any], Any]:
    """Return ``Store.open``, but a store that does not exist yet begins as a copy of an empty database."""
    from skin.runs.store import Store

    as_it_is = Store.open

    def opened(settings: Any) -> Store:
        path = Path((settings.uri or "").removeprefix("sqlite:///"))
        if settings.uri and path.parent.is_dir() and not path.exists() and empty().exists():
            try:
                shutil.copy(empty(), path)
            except OSError:  # such as a full disk, of which the store tells
                path.unlink()
        return as_it_is(settings)

    return opened


def remembering(load: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Return ``OmegaConf.load``, which parses the text of an open file once: a third of each composition.

    A pickle makes a copy in a seventh of the time of ``deepcopy``.
    """
    parsed: dict[str, bytes] = {}

    def loaded(file: Any) -> Any:
        if not hasattr(file, "read"):
            return load(file)
        if (text := file.read()) not in parsed:
            parsed[text] = pickle.dumps(load(StringIO(text)))
        return pickle.loads(parsed[text])

    return loaded


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
    sys.path[1:1] = filter(None, job["environment"].get("PYTHONPATH", "").split(os.pathsep))
    script, *arguments = job["command"]
    sys.argv = [script, *arguments]
    code = 0
    try:
        if script == "-m":
            sys.path[0] = job["folder"]
            module, *sys.argv[1:] = arguments
            runpy.run_module(module, run_name="__main__", alter_sys=True)
        else:
            sys.path[0] = str(Path(script).parent)
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


if __name__ == "__main__":
    main()

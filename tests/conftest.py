"""What all tests share."""

import gc
import hashlib
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import traceback
import warnings

# Where tests run in the background Ctrl-C may be ignored, and commands that they start would inherit that.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests are many small problems: a second thread only waits, and for long where the machine is busy.
os.environ.setdefault("OMP_NUM_THREADS", "1")

from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from copy import deepcopy
from functools import partial
from importlib.metadata import version
from io import StringIO
from itertools import count
from pathlib import Path
from tempfile import mkdtemp
from time import monotonic, sleep
from typing import Any, TextIO

import pytest
from filelock import FileLock
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from skin.core.files import ROOT
from skin.runs.configuration import Config, validate_config
from tests.budget import Budget, charge, free
from tests.starter import copying, remembering

# The imports of all tests make a million objects that live to the end. To search them for garbage again and
# again takes a third of the collection.
gc.disable()

CONF = ROOT / "conf"
OPERATORS = ("body", "touch", "mechanics")  # rooms that operators depend on
PATIENCE = 600  # s: machines are busy at times


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Budget(), "budget")


def pytest_xdist_auto_num_workers() -> int:
    """Use as many processes as there are cores: each further one imports and collects for 20 s."""
    return os.cpu_count() or 1


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put files with slow tests first: what is left at the end is shared well among the processes."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


def pytest_collection_finish() -> None:
    """Search for garbage from now on, but only in what tests make."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def shared(tmp_path_factory) -> Path:
    """Return the folder that all processes of one run of the tests share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def kept(request, shared) -> Path:
    """Return the folder that outlives this run, or the shared one if pytest keeps no cache."""
    cache = getattr(request.config, "cache", None)
    return cache.mkdir("skin") if cache else shared


@pytest.fixture(scope="session")
def empty_database(kept) -> Callable[[], Path]:
    """Return a function that returns an empty database, which takes MLflow seconds to make.

    It is kept for as long as the version of MLflow is. It does not exist if its disk is full, as some tests
    let it be.
    """
    path = kept / f"empty-{version('mlflow')}.db"

    def made() -> Path:
        with FileLock(f"{path}.lock"), free():
            if not path.exists():
                create = f"import mlflow; mlflow.MlflowClient('sqlite:///{path}.new').search_experiments()"
                if not subprocess.run([sys.executable, "-c", create], capture_output=True).returncode:
                    path.with_name(f"{path.name}.new").rename(path)
        return path

    return made


@pytest.fixture(scope="session", autouse=True)
def stores_are_copied(empty_database):
    """Let new stores begin as copies of an empty database."""
    with pytest.MonkeyPatch.context() as patch:
        if tracking := sys.modules.get("skin.runs.store"):  # else no test opens a store
            patch.setattr(tracking.Store, "open", copying(empty_database))
        yield


@pytest.fixture(scope="session", autouse=True)
def files_are_parsed_once():
    """Let the hundreds of compositions parse each file of the configuration once."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OmegaConf, "load", staticmethod(remembering(OmegaConf.load)))
        yield


@pytest.fixture(scope="session", autouse=True)
def own_cache(kept, shared):
    """Keep operators of tests, until their sources change, and checks apart from the user's; commands too."""
    path = kept / f"cache-{hash_of_sources()}"
    for old in set(kept.glob("cache-*")) - {path}:
        shutil.rmtree(old, ignore_errors=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKIN_CACHE", str(path))
        patch.setenv("SKIN_DATA", str(shared / "data"))
        yield


def hash_of_sources() -> str:
    """Return a hash of all that operators depend on; what else is kept has a key of its own sources."""
    sources = [path for room in OPERATORS for path in sorted((ROOT / "skin" / room).rglob("*.py"))]
    return hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]


@pytest.fixture(scope="module", autouse=True)
def no_thread_survives():
    """Fail where a thread that the tests of a file started goes on after them."""
    before = set(threading.enumerate())
    yield
    deadline = monotonic() + 10
    # MLflow's pool and tqdm's monitor end with the interpreter. Threads of pytest-xdist may appear any time.
    lasting = ("Mlflow", "tqdm_monitor", "Dummy-")
    new = lambda thread: thread not in before and not thread.name.startswith(lasting)  # noqa: E731
    while left := [thread for thread in threading.enumerate() if new(thread)]:
        if monotonic() > deadline:
            pytest.fail(f"still running: {left}")
        sleep(0.01)


@pytest.fixture
def played() -> Iterator[Callable[[Callable[[socket.socket, threading.Event], None]], str]]:
    """Return a function that serves one reader after the other with ``say(reader, stop)`` at an address."""
    running = []

    def begin(say: Callable[[socket.socket, threading.Event], None]) -> str:
        server, stop = socket.create_server(("127.0.0.1", 0)), threading.Event()

        def serve() -> None:
            while not stop.is_set():
                with suppress(OSError):
                    reader, _ = server.accept()
                    with reader:
                        if not stop.is_set():
                            say(reader, stop)

        thread = threading.Thread(target=serve)
        thread.start()
        running.append((server, stop, thread))
        return f"socket://127.0.0.1:{server.getsockname()[1]}"

    yield begin
    for server, stop, thread in running:
        stop.set()
        # To close it would not wake a thread that waits in accept().
        with suppress(OSError), socket.create_connection(server.getsockname(), timeout=5):
            thread.join(20)
        server.close()


@pytest.fixture(scope="session")
def configured() -> Callable[..., Config]:
    made = {}

    def make(*overrides: str) -> Config:
        if overrides not in made:
            with initialize_config_dir(str(CONF), version_base="1.3"):
                made[overrides] = validate_config(compose("train", overrides=list(overrides)))
        return deepcopy(made[overrides])

    return make


class Command:
    """A command in the background, with what tests need of ``subprocess.Popen``; its output goes to files."""

    def __init__(self, begin: Callable[[dict], tuple[int, Callable[[], int | None]]], job: dict) -> None:
        self.args, self.returncode = job["command"], None
        self._out, self._err = Path(job["out"]), Path(job["err"])
        self._read = {self._out: 0, self._err: 0}
        self.pid, self._ended = begin(job)

    def __enter__(self) -> "Command":
        return self

    def __exit__(self, *_) -> None:
        self.kill()
        self.wait()

    @property
    def out(self) -> str:
        return self._out.read_text()

    @property
    def err(self) -> str:
        return self._err.read_text()

    def lines(self, errors: bool = False) -> Iterator[str]:
        """Yield the lines that were not read yet, as they come, until the command ends."""
        path = self._err if errors else self._out
        ended = False
        while not ended:
            ended = self.poll() is not None
            with path.open() as file:
                file.seek(self._read[path])
                while (line := file.readline()).endswith("\n"):
                    self._read[path] = file.tell()
                    yield line.rstrip()
            sleep(0.02)

    def poll(self) -> int | None:
        """Return the exit code, or None while the command runs."""
        if self.returncode is None:
            self.returncode = self._ended()
        return self.returncode

    def wait(self, timeout: float = PATIENCE) -> int:
        """Return the exit code once the command has ended."""
        deadline = monotonic() + timeout
        while self.poll() is None:
            if monotonic() > deadline:
                self.kill()
                raise TimeoutError(f"{self.args} goes on after {timeout} s: {self.out} {self.err}")
            sleep(0.01)
        return self.returncode

    def completed(self) -> subprocess.CompletedProcess:
        """Return what the command said and its exit code, once it has ended."""
        return subprocess.CompletedProcess(self.args, self.wait(), self.out, self.err)

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)


@pytest.fixture(scope="session")
def starter(shared, empty_database) -> Iterator[TextIO]:
    """Connect to the process that forks commands for all who run tests, started once: tests/starter.py."""
    named, process = shared / "starter", None
    with FileLock(f"{named}.lock"):
        if not named.exists() or not (connection := connected(named.read_text())):
            folder = mkdtemp(prefix="skin-")  # a socket's path must be short
            script = Path(__file__).with_name("starter.py")
            command = [sys.executable, str(script), folder, str(empty_database())]
            process = subprocess.Popen(command, stdout=subprocess.PIPE)
            process.stdout.readline()
            named.write_text(folder)
            connection = connected(folder)
    yield connection
    connection.close()
    if process:
        with process:
            process.wait()
        shutil.rmtree(folder)


def connected(folder: str) -> TextIO | None:
    """Return a connection to the starter of this folder, None if it has ended."""
    with suppress(OSError), socket.socket(socket.AF_UNIX) as one:
        one.connect(f"{folder}/jobs")
        file = one.makefile("rw")
        if file.readline():
            return file
        file.close()
    return None


def named(command: str | Path) -> list[str]:
    """Return what Python is told to run: a script at a path, or a verb of ``skin`` (or ``verb.py``)."""
    path = Path(command)
    return [str(path)] if path.is_absolute() else ["-m", "skin", path.stem]


def forked(starter: TextIO, job: dict) -> tuple[int, Callable[[], int | None]]:
    """Begin a command as a fork of the starter; return its process's number and what gives its exit code."""

    def ask(what: dict) -> Any:
        print(json.dumps(what), file=starter, flush=True)
        return json.loads(starter.readline())

    def ended() -> int | None:
        if answer := ask({"ended": number}):
            charge(answer[1])
            return answer[0]
        return None

    number = ask(job)
    return number, ended


@pytest.fixture(scope="session")
def begin(request, tmp_path_factory) -> Callable[..., Command]:
    """Return a function that starts a verb of ``skin``, or a script at a path, in a folder.

    The command is a process of its own that shares its imports with others. ``stdin`` is the path of what it
    reads, such as a terminal.
    """
    said, numbers = tmp_path_factory.mktemp("said"), count()

    def begin(folder, script, *arguments, stdin=os.devnull) -> Command:
        files = [said / f"{next(numbers)}" for _ in range(2)]
        for file in files:
            file.touch()
        job = {"command": [*named(script), *map(str, arguments)], "folder": str(folder)}
        job |= {"in": stdin, "out": str(files[0]), "err": str(files[1])}
        job |= {"environment": dict(os.environ), "seconds": PATIENCE}
        return Command(partial(forked, request.getfixturevalue("starter")), job)

    return begin


@pytest.fixture(scope="session")
def run(begin, stores_are_copied) -> Callable[..., subprocess.CompletedProcess]:
    """Return a function that runs a command, named as for ``begin``, in a folder with a store of its own.

    ``store=False`` names no store. A verb of ``skin`` runs in this process; ``apart=True``, or ``.py`` behind
    it, gives it a process of its own as ``begin`` does.
    """

    def run(folder, script, *arguments, store=True, apart=False) -> subprocess.CompletedProcess:
        settings = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]
        words = [*map(str, arguments), *(settings if store else [])]
        if apart or Path(script).suffix:
            return begin(folder, script, *words).completed()
        return run_here(folder, [str(script), *words])

    return run


def _print_warning(message, category, filename, lineno, file=None, line=None) -> None:
    """Print a warning to the standard error stream of the moment, as Python does outside of pytest."""
    (file or sys.stderr).write(warnings.formatwarning(message, category, filename, lineno, line))


def run_here(folder: Path, words: list[str]) -> subprocess.CompletedProcess:
    """Run ``skin`` with these words in this process; leave its state as it was."""
    import torch
    from hydra.core.global_hydra import GlobalHydra
    from hydra.core.singleton import Singleton

    import skin.runs.store  # noqa: F401  # it sets variables of the environment, which stay
    from skin.__main__ import main

    state, environment, here = Singleton.get_state(), dict(os.environ), Path.cwd()
    threads = torch.get_num_threads()
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    root = logging.getLogger()
    levels, loggers = root.level, list(root.handlers)
    out, err, argv = StringIO(), StringIO(), sys.argv
    GlobalHydra.instance().clear()
    os.chdir(folder)
    sys.argv = ["skin", *words]
    sys.path.insert(0, str(folder))
    code = 0
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("default")
            warnings.showwarning = _print_warning  # pytest collects warnings where a person sees them
            main(words)
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc(file=err)
        code = 1
    finally:
        Singleton.set_state(state)
        os.environ.clear()
        os.environ.update(environment)
        os.chdir(here)
        sys.argv = argv
        sys.path.remove(str(folder))
        for name, module in list(sys.modules.items()):
            if str(getattr(module, "__file__", None) or "").startswith(f"{folder}{os.sep}"):
                del sys.modules[name]
        torch.set_num_threads(threads)
        for number, handler in handlers.items():
            signal.signal(number, handler)
        root.handlers[:], root.level = loggers, levels
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


@pytest.fixture
def made_up_device():
    from tests.made_up import MadeUpDevice

    return MadeUpDevice()

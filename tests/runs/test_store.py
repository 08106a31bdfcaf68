"""A run's status can be trusted, whatever ends it."""

import signal
import sqlite3
import subprocess
import sys
from base64 import b64encode
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

import pytest
from mlflow import MlflowClient

from skin.core.files import ROOT
from skin.errors import InputError
from skin.runs.build import load_run
from skin.runs.configuration import Tracking, hide_password, reveal_password
from skin.runs.run import FinishedRun
from skin.runs.store import Store
from tests.budget import free

BEGIN = f"""
import sys, time
sys.path.insert(0, {str(ROOT)!r})
from skin.runs.configuration import Tracking
from skin.runs.store import Store
store = Store.open(Tracking(sys.argv[1], sys.argv[2]))
"""
WAIT = """
with store.run("waiting", {"fingerprint": "f"}):
    print("open", flush=True)
    time.sleep(120)
"""


@pytest.fixture(scope="module")
def settings(tmp_path_factory):
    folder = tmp_path_factory.mktemp("store")
    return Tracking(f"sqlite:///{folder / 'm.db'}", str(folder / "artifacts"))


@pytest.fixture(scope="module")
def store(settings):
    return Store.open(settings)


def status(store, run):
    return store.client.get_run(run.info.run_id).info.status


@pytest.mark.parametrize(
    ("error", "expected"), [(None, "FINISHED"), (ValueError, "FAILED"), (KeyboardInterrupt, "KILLED")]
)
def test_a_run_is_finished_only_if_it_ends_by_itself(store, error, expected):
    identity = f"print {expected}"
    with suppress(ValueError, KeyboardInterrupt), store.run("run", {"fingerprint": identity}) as run:
        assert status(store, run) == "RUNNING"
        assert not store.find("FINISHED", fingerprint=identity)
        if error:
            raise error("broken")
    assert status(store, run) == expected
    assert len(store.find("FINISHED", fingerprint=identity)) == (error is None)


@pytest.mark.slow("trains until a signal")
@pytest.mark.parametrize(
    ("number", "expected"),
    [(signal.SIGTERM, "KILLED"), (signal.SIGINT, "KILLED"), (signal.SIGKILL, "RUNNING")],
)
def test_a_signal_leaves_no_finished_run(begin, tmp_path, settings, store, number, expected):
    (tmp_path / "wait.py").write_text(BEGIN + WAIT)
    with begin(ROOT, tmp_path / "wait.py", settings.uri, settings.artifacts) as process:
        assert next(process.lines()) == "open"
        process.send_signal(number)
        process.wait(60)
    assert store.find(fingerprint="f")[0].info.status == expected
    assert not store.find("FINISHED", fingerprint="f")
    # Whatever starts next tells what nobody could tell at the end.
    assert Store.open(settings).find(fingerprint="f")[0].info.status == "KILLED"


def test_a_second_signal_does_not_interrupt_the_end_of_a_run(store, monkeypatch):
    before, ended = signal.getsignal(signal.SIGTERM), []
    end = lambda store, run, status: (signal.raise_signal(signal.SIGTERM), ended.append(status))  # noqa: E731
    monkeypatch.setattr(Store, "end", end)
    # Else a signal that is not expected would end the tests.
    signal.signal(signal.SIGTERM, lambda *_: pytest.fail("a signal was not expected"))
    try:
        with pytest.raises(SystemExit, match="143"), store.run("stopped twice", {}):
            signal.raise_signal(signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended == ["KILLED"]


def test_a_run_without_a_process_is_closed(settings, store):
    """One whose lock is not here is one of another machine."""
    abandoned, elsewhere = (store.create(name, {}) for name in ("abandoned", "elsewhere"))
    (store.folder / f"{abandoned.info.run_id}.lock").touch()
    with store.run("mine", {}) as mine:
        Store.open(settings)
        ended = [status(store, run) for run in (abandoned, elsewhere, mine)]
    assert ended == ["KILLED", "RUNNING", "RUNNING"]
    assert not (store.folder / f"{mine.info.run_id}.lock").exists()


def test_a_store_is_opened_again_with_its_files_and_read_while_it_is_written(settings, store):
    assert Store.open(settings).experiment == Store.existing(settings).experiment == store.experiment
    tags = store.client.get_experiment(store.experiment).tags
    assert tags["mlflow.experimentKind"] == "custom_model_development"
    with store.run("with a file", {}) as run:
        store.client.log_text(run.info.run_id, "hello", "note.txt")
    (found,) = (ROOT / settings.artifacts).glob("**/note.txt")
    assert found.read_text() == "hello"
    with closing(sqlite3.connect(settings.uri.removeprefix("sqlite:///"))) as database:
        assert database.execute("PRAGMA journal_mode").fetchone() == ("wal",)


@pytest.mark.slow("imports MLflow in several processes")
def test_processes_that_start_at_once_share_one_new_database(tmp_path):
    command = [sys.executable, "-c", BEGIN + "print(store.experiment)"]
    command += [f"sqlite:///{tmp_path}/m.db", str(tmp_path / "a")]

    def start(_):
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    with ThreadPoolExecutor(2) as pool:
        done = list(pool.map(start, range(2)))
    assert [one.returncode for one in done] == [0, 0], done[-1].stderr
    assert len({one.stdout for one in done}) == 1


@pytest.mark.parametrize("name", ["a%20b", "what? #1"])
def test_a_working_folder_may_have_any_name(name, tmp_path, monkeypatch):
    folder = tmp_path / name
    folder.mkdir()
    monkeypatch.chdir(folder)
    assert Store.existing(Tracking()).find("FINISHED", fingerprint="a") == []
    assert not list(folder.iterdir())
    store = Store.open(Tracking())
    with store.run("here", {}) as run:
        store.client.log_text(run.info.run_id, "text", "note.txt")
    assert FinishedRun(store, run).fetch("note.txt", str(tmp_path)).read_text() == "text"
    assert (folder / "mlflow.db").is_file()


@pytest.mark.parametrize(
    "words",
    ["evaluate run=latest", "live run=none", "export run=latest out=x.onnx",
     "train simulator=fem body=arm layout=grid"],
)  # fmt: skip
def test_a_refused_command_leaves_no_database(words, run, tmp_path):
    run(tmp_path, *words.split(), store=False, code=2)
    assert not list(tmp_path.glob("mlflow.db*"))


@pytest.mark.parametrize(
    ("uri", "hidden"),
    [
        ("http://me:geheim@h:5000", "http://me:***@h:5000"),
        ("postgresql+pg8000://me:a/b@c@h/runs?x=y", "postgresql+pg8000://me:***@h/runs?x=y"),
        ("https://me@h/x", None),
        ("http://h:5000/a@b", None),
        ("sqlite:////tmp/a:b@c/m.db", None),
    ],
)
def test_a_password_is_hidden_and_found_again(uri, hidden):
    assert Tracking(uri).uri == (hidden or uri)
    assert Tracking(hidden or uri).uri == (hidden or uri)
    assert hide_password(f"tracking.uri='{uri}'") == f"tracking.uri='{hidden or uri}'"
    assert reveal_password(hidden or uri) == uri


def test_a_server_gets_the_password_and_messages_do_not(monkeypatch):
    """The store is of a server that refuses everything."""
    monkeypatch.setenv("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "0")
    sent = []

    class Refusing(BaseHTTPRequestHandler):
        def do_GET(self):
            sent.append(self.headers["Authorization"])
            self.send_error(401)

        def log_message(self, *arguments):
            pass

    with HTTPServer(("127.0.0.1", 0), Refusing) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        address = f"127.0.0.1:{server.server_port}"
        with pytest.raises(InputError, match=rf"the runs in http://me:\*\*\*@{address}: ") as refused:
            Store.open(Tracking(f"http://me:geheim@{address}"))
        server.shutdown()
        thread.join()
    assert "geheim" not in str(refused.value)
    assert sent[0] == f"Basic {b64encode(b'me:geheim').decode()}"


def test_a_pretrained_model_needs_no_database(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with free():  # its operator is computed once for all tests
        window = load_run("any_skin").window
    assert window == 30
    assert not list(tmp_path.glob("mlflow.db*"))


def test_two_tasks_make_an_experiment_at_the_same_time(settings, store, monkeypatch):
    look, looked = MlflowClient.get_experiment_by_name, []

    def missing_at_first(client, name):
        looked.append(name)
        return look(client, name) if len(looked) > 1 else None

    monkeypatch.setattr(MlflowClient, "get_experiment_by_name", missing_at_first)
    assert Store.open(settings).experiment == store.experiment
    assert len(looked) == 2

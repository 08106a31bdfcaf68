"""Runs in MLflow: one SQLite file, one experiment, and a status that is true after a crash."""

import os

# Before mlflow is imported, because it sends telemetry by default.
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
# Seconds, not minutes, until a server counts as away: waits of 0, 2 and 4 s between the attempts.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "3")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR", "1")

import json
import platform
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import psutil
from alembic.util import CommandError
from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import Metric, Run, ViewType
from mlflow.exceptions import MlflowException
from mlflow.protos.databricks_pb2 import RESOURCE_ALREADY_EXISTS, ErrorCode
from mlflow.store.tracking import SEARCH_MAX_RESULTS_THRESHOLD
from mlflow.utils.mlflow_tags import MLFLOW_PARENT_RUN_ID
from sqlalchemy.exc import SQLAlchemyError

from skin.config import Tracking
from skin.errors import InputError
from skin.files import whole
from skin.interrupt import ends_on_signal
from skin.outbox import OutboxClient
from skin.run_table import TAGS, table_link, tag_experiment
from skin.server import check_server, is_server
from skin.source import source_tags

PROCESS = "process"
"""Tag of the process that makes a run."""

_SET_CLOCK = 60  # s by which the clock of a machine may be set without a process looking like another one


@dataclass(frozen=True)
class Store:
    """An MLflow experiment in a database that exists.

    Attributes:
        client: of the tracking store.
        uri: of the tracking store.
        experiment: id of the experiment.
    """

    client: MlflowClient
    uri: str
    experiment: str

    @classmethod
    def open(cls, settings: Tracking) -> "Store":
        """Return the experiment, made with its database where they are missing.

        Raises:
            InputError: the database is none, belongs to another version of MLflow, or cannot be written; or
                the server does not answer.
        """
        uri = settings.uri or database_uri(Path.cwd() / "mlflow.db")
        artifacts = Path(settings.artifacts or "mlartifacts").expanduser()
        remote = is_server(uri)
        check_server(uri)
        try:
            with _alone(uri, artifacts):
                client = OutboxClient(uri, artifacts / "kept") if remote else MlflowClient(tracking_uri=uri)
                # A server keeps the artifacts of its runs, unless a folder is given.
                served = remote and settings.artifacts is None
                location = None if served else (artifacts / settings.experiment).resolve().as_uri()
                identity = _experiment(client, settings.experiment, location)
        except (MlflowException, SQLAlchemyError, CommandError, sqlite3.Error, OSError) as error:
            reason = next(iter(str(error.__cause__ or error).splitlines()), type(error).__name__)
            raise InputError(
                f"cannot use the runs in {uri}: {reason}: give another place, as in "
                "tracking.uri=sqlite:////FOLDER/runs.db"
            ) from error
        store = cls(client, uri, identity)
        if isinstance(client, OutboxClient):
            client.upload()
        store._close_abandoned()
        return store

    @classmethod
    def existing(cls, settings: Tracking) -> "Store":
        """Return the experiment like :meth:`open`; without a database, one without runs, and make no file.

        For a command that may still be refused. The client of such a store cannot be used.

        Raises:
            InputError: as of :meth:`open`.
        """
        uri = settings.uri or database_uri(Path.cwd() / "mlflow.db")
        if uri.startswith("sqlite:///") and not _database(uri).exists():
            return cls(cast(MlflowClient, None), uri, "")
        return cls.open(settings)

    def find(self, status: str | None = None, **tags: str) -> list[Run]:
        """Return the runs that have the tags, newest first; ``status`` as MLflow calls it (``FINISHED``)."""
        if not self.experiment:
            return []
        terms = [f"tags.`{name}` = '{value}'" for name, value in tags.items()]
        terms += [f"attributes.status = '{status}'"] if status else []
        return self.client.search_runs(
            [self.experiment],
            " and ".join(terms),
            ViewType.ACTIVE_ONLY,
            max_results=SEARCH_MAX_RESULTS_THRESHOLD,
            order_by=["attributes.start_time DESC"],
        )

    def create(self, name: str, tags: dict[str, str]) -> Run:
        """Return a new run, tagged with this process; the caller must end it."""
        return self.client.create_run(self.experiment, tags=tags | {PROCESS: _me()}, run_name=name)

    def _close_abandoned(self) -> None:
        """Set the status of runs whose process no longer exists to KILLED.

        Only processes of this machine can be checked. Runs without the tag are left unchanged.
        """
        for run in self.find("RUNNING"):
            if is_gone(run.data.tags.get(PROCESS, "")):
                self.client.set_terminated(run.info.run_id, "KILLED")

    @contextmanager
    def run(
        self, name: str, tags: dict[str, str], parent: str | None = None, again: Run | None = None
    ) -> Iterator[Run]:
        """Open a run; it is FINISHED only if the block ends by itself, else FAILED, or KILLED by a signal.

        Args:
            name: of the run.
            tags: of the run.
            parent: id of the run of its sweep.
            again: a killed run to open instead of a new one.
        """
        tags = tags | source_tags() | ({MLFLOW_PARENT_RUN_ID: parent} if parent else {})
        run = again or self.create(name, tags)
        if again:
            self.client.update_run(run.info.run_id, status="RUNNING")
            for key, value in (tags | {PROCESS: _me()}).items():
                self.client.set_tag(run.info.run_id, key, value)
        status = "KILLED"
        try:
            with ends_on_signal(lambda: self.client.set_terminated(run.info.run_id, status)):
                yield run
            status = "FINISHED"
        except Exception as error:
            status = "FAILED"
            self.client.set_tag(run.info.run_id, "error", f"{type(error).__name__}: {error}"[:500])
            raise
        finally:
            self.client.set_terminated(run.info.run_id, status)

    def log_metrics(self, run: Run, values: dict[str, float]) -> None:
        """Log final metrics, 1000 in one transaction; what is not defined (NaN) is left out."""
        now = int(1000 * time.time())
        metrics = [Metric(name, value, now, 0) for name, value in values.items() if value == value]
        for start in range(0, len(metrics), 1000):
            self.client.log_batch(run.info.run_id, metrics[start : start + 1000], synchronous=True)


def _experiment(client: MlflowClient, name: str, location: str | None) -> str:
    """Return the id of an experiment, made if it is missing, perhaps by another process at the same time."""
    if (found := client.get_experiment_by_name(name)) is None:
        try:
            return client.create_experiment(name, artifact_location=location, tags=TAGS)
        except MlflowException as error:
            if error.error_code != ErrorCode.Name(RESOURCE_ALREADY_EXISTS):
                raise
            return _experiment(client, name, location)
    tag_experiment(client, found)
    return str(found.experiment_id)


def print_table_link(address: str = "http://127.0.0.1:5000") -> None:
    """Print the link to the runs of ``mlflow.db`` in the current folder, at a server that shows them."""
    print(f"runs: {table_link(address, Store.open(Tracking(None, None, 'skin', True, None)).experiment)}")


def _where() -> str:
    """Return an identifier of the machine, or of the container with its own process numbers."""
    try:
        space = os.readlink("/proc/self/ns/pid")
    except OSError:
        space = ""
    return f"{platform.node()} {space}"


def _me() -> str:
    """Return the tag of this process; its start time makes it unique."""
    return json.dumps([_where(), os.getpid(), psutil.Process().create_time()])


def is_gone(process: str) -> bool | None:
    """Return whether a tagged process no longer exists; None for those of other machines."""
    try:
        where, number, started = json.loads(process)
        if where != _where():
            return None
        return abs(psutil.Process(number).create_time() - started) > _SET_CLOCK
    except psutil.NoSuchProcess:
        return True
    except (ValueError, TypeError, psutil.Error):
        return None


def database_uri(path: Path) -> str:
    """Return the URI of a SQLite database, in which ``%`` and ``?`` have a meaning."""
    return "sqlite:///" + str(path).replace("%", "%25").replace("?", "%3F")


def _database(uri: str) -> Path:
    """Return the file of a SQLite database."""
    return Path(unquote(uri.removeprefix("sqlite:///").partition("?")[0]))


def _make(path: Path, artifacts: Path) -> None:
    """Create a database atomically: an incomplete one could not be opened again."""
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore  # heavy, and seldom needed

    with whole(path, "tracking.uri=sqlite:////FOLDER/runs.db") as partial:
        SqlAlchemyStore(database_uri(partial), str(artifacts)).engine.dispose()


@contextmanager
def _alone(uri: str, artifacts: Path) -> Iterator[Any]:
    """Lock the creation of a SQLite database, which fails in two processes at the same time."""
    if not uri.startswith("sqlite:///"):
        yield
        return
    path = _database(uri)
    path.parent.mkdir(parents=True, exist_ok=True)
    encoded = Path(uri.removeprefix("sqlite:///")).parent
    existed = encoded.exists()
    with FileLock(f"{path}.lock"):
        if not path.exists() or not path.stat().st_size:
            _make(path, artifacts)
        with closing(sqlite3.connect(path)) as connection:
            # Readers and writers at the same time; the mode stays with the file.
            connection.execute("PRAGMA journal_mode=WAL")
        yield
        if not existed:  # MLflow makes the folder of the URI without decoding it, and leaves it empty
            with suppress(OSError):
                os.removedirs(encoded)

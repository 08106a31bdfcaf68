"""Runs in MLflow: one SQLite file or a server, one experiment, and a status that is true after a crash.

A request to a server that is away is repeated by MLflow for two minutes.
"""

import os

# Before mlflow is imported, because it sends telemetry by default.
os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
os.environ.setdefault("MLFLOW_ENABLE_ARTIFACTS_PROGRESS_BAR", "false")
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
# Waits of 0, 2, 4, ... 64 s between the attempts: a server may start again meanwhile.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "7")
os.environ.setdefault("MLFLOW_HTTP_REQUEST_BACKOFF_FACTOR", "1")

import logging
import sqlite3
import time
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, cast
from urllib.parse import unquote

import psutil
from alembic.util import CommandError
from filelock import FileLock, Timeout
from mlflow import MlflowClient
from mlflow.entities import Metric, Run, ViewType
from mlflow.exceptions import MlflowException, RestException
from mlflow.store.tracking import SEARCH_MAX_RESULTS_THRESHOLD
from mlflow.utils.mlflow_tags import MLFLOW_PARENT_RUN_ID
from sqlalchemy.exc import SQLAlchemyError

from skin.core.files import unwritable, whole
from skin.core.interrupt import ends_on_signal
from skin.errors import InputError
from skin.runs.configuration import (
    Tracking,
    answers,
    check_server,
    is_server,
    reveal_password,
    shorten,
    source_tags,
)
from skin.runs.run import PROCESS

_log = logging.getLogger(__name__)
# Which of its two interfaces MLflow shows.
_TAGS = {"mlflow.experimentKind": "custom_model_development"}


@dataclass(frozen=True)
class Store:
    """An MLflow experiment in a database that exists.

    Attributes:
        client: of the tracking store.
        uri: of the tracking store, without its password.
        experiment: id of the experiment.
        folder: of checkpoints and locks, which all processes that train the same runs share.
    """

    client: MlflowClient
    uri: str
    experiment: str
    folder: Path

    @classmethod
    def open(cls, settings: Tracking) -> "Store":
        """Return the experiment, made with its database where they are missing.

        Raises:
            InputError: the database is none, belongs to another version of MLflow, or cannot be written; or
                the server does not answer.
        """
        uri = settings.uri or database_uri(Path.cwd() / "mlflow.db")
        artifacts = Path(settings.artifacts or "mlartifacts").expanduser()
        check_server(uri)
        try:
            with _lock_creation(uri, artifacts):
                client = MlflowClient(tracking_uri=reveal_password(uri))
                # A server keeps the artifacts of its runs, unless a folder is given.
                served = is_server(uri) and settings.artifacts is None
                location = None if served else (artifacts / settings.experiment).resolve().as_uri()
                identity = _experiment(client, settings.experiment, location)
        except (MlflowException, SQLAlchemyError, CommandError, sqlite3.Error, OSError, ImportError) as error:
            reason = next(iter(str(error.__cause__ or error).splitlines()), type(error).__name__)
            raise InputError(
                f"cannot use the runs in {uri}: {reason.replace(reveal_password(uri), uri)}: give another "
                "place, as in tracking.uri=sqlite:////FOLDER/runs.db, or postgresql+pg8000://... after pip "
                'install "tactile-skin[server]"'
            ) from error
        store = cls(client, uri, identity, artifacts.resolve() / "unfinished")
        for run in store.find("RUNNING"):
            # Without a file of its lock here, the run is one of another machine, or of another folder.
            if (store.folder / f"{run.info.run_id}.lock").exists():
                with suppress(InputError), store.hold(run.info.run_id):
                    store.end(run.info.run_id, "KILLED")
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
            return cls(cast(MlflowClient, None), uri, "", Path())
        return cls.open(settings)

    def find(self, status: str | None = None, **tags: str) -> list[Run]:
        """Return the runs that have the tags, newest first; ``status`` as MLflow calls it (``FINISHED``)."""
        if not self.experiment:
            return []
        terms = [f"tags.`{name}` = '{value}'" for name, value in tags.items()]
        return self.client.search_runs(
            [self.experiment],
            " and ".join([*terms, *([f"attributes.status = '{status}'"] if status else [])]),
            ViewType.ACTIVE_ONLY,
            max_results=SEARCH_MAX_RESULTS_THRESHOLD,
            order_by=["attributes.start_time DESC"],
        )

    def create(self, name: str, tags: dict[str, str]) -> Run:
        """Return a new run, tagged with this process; the caller must hold its lock and end it."""
        return self.client.create_run(
            self.experiment, tags=tags | {PROCESS: str(os.getpid())}, run_name=shorten(name)
        )

    @contextmanager
    def hold(self, name: str) -> Iterator[None]:
        """Hold the lock of a run or of a training; the system frees that of a process that was killed.

        Args:
            name: id of the run, or fingerprint of the training.

        Raises:
            InputError: another process holds it, or the folder cannot be written.
        """
        lock = FileLock(self.folder / f"{name}.lock")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            lock.acquire(timeout=0)
        except Timeout:
            raise InputError(
                f"a training with the same configuration ({name}) is in progress in another process: "
                "wait for it"
            ) from None
        except OSError as error:
            raise unwritable(self.folder, error, "tracking.artifacts=FOLDER") from error
        try:
            yield
        finally:
            lock.release()

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

        Raises:
            InputError: the server stayed away.
        """
        tags = tags | source_tags() | ({MLFLOW_PARENT_RUN_ID: parent} if parent else {})
        run = again or self.create(name, tags)
        if again:
            self.client.update_run(run.info.run_id, status="RUNNING")
            for key, value in (tags | {PROCESS: str(os.getpid())}).items():
                self.client.set_tag(run.info.run_id, key, value)
        status = "KILLED"
        with self.hold(run.info.run_id), ends_on_signal(lambda: self.end(run.info.run_id, status)):
            try:
                yield run
                self.client.set_terminated(run.info.run_id, "FINISHED")  # waits for the server
                status = "FINISHED"
            except Exception as error:
                if self._lost(error):
                    raise InputError(
                        f"the tracking server {self.uri} does not answer, and run {run.info.run_id} is not "
                        "complete: repeat the command when it does; a training continues after its last epoch"
                    ) from error
                status = "FAILED"
                raise
            finally:
                self.end(run.info.run_id, status)

    def _lost(self, error: Exception) -> bool:
        """Return whether an error means that the server gives no answer; what it answers is another one."""
        return (
            is_server(self.uri)
            and isinstance(error, MlflowException)
            and not isinstance(error, RestException)
            and str(error).startswith("API request to")
        )

    def end(self, run: str, status: str) -> None:
        """End a run, and remove its lock; the caller holds it.

        Without the server the run stays RUNNING until the next start closes it.
        """
        if answers(self.uri):
            self.client.set_terminated(run, status)
            (self.folder / f"{run}.lock").unlink(missing_ok=True)

    def log_metrics(self, run: Run, values: dict[str, float]) -> None:
        """Log final metrics, 1000 in one transaction; what is not defined (NaN) is left out."""
        now = int(1000 * time.time())
        metrics = [Metric(name, value, now, 0) for name, value in values.items() if value == value]
        for start in range(0, len(metrics), 1000):
            self.client.log_batch(run.info.run_id, metrics[start : start + 1000], synchronous=True)


def _experiment(client: MlflowClient, name: str, location: str | None) -> str:
    """Return the id of an experiment, made if it is missing."""
    if (experiment := client.get_experiment_by_name(name)) is None:
        try:
            return client.create_experiment(name, artifact_location=location, tags=_TAGS)
        except MlflowException:
            # Perhaps another process has made it at the same time.
            if (experiment := client.get_experiment_by_name(name)) is None:
                raise
    return str(experiment.experiment_id)


def database_uri(path: Path) -> str:
    """Return the URI of a SQLite database, in which ``%`` and ``?`` have a meaning."""
    return "sqlite:///" + str(path).replace("%", "%25").replace("?", "%3F")


def _database(uri: str) -> Path:
    """Return the file of a SQLite database."""
    return Path(unquote(uri.removeprefix("sqlite:///").partition("?")[0]))


@contextmanager
def _lock_creation(uri: str, artifacts: Path) -> Iterator[Any]:
    """Lock the creation of a SQLite database, which fails in two processes at the same time."""
    if not uri.startswith("sqlite:///"):
        yield
        return
    path = _database(uri)
    path.parent.mkdir(parents=True, exist_ok=True)
    with FileLock(f"{path}.lock"):
        if not path.exists() or not path.stat().st_size:
            from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore  # heavy, and seldom needed

            # Atomically: an incomplete one could not be opened again.
            with whole(path, "tracking.uri=sqlite:////FOLDER/runs.db") as partial:
                SqlAlchemyStore(database_uri(partial), str(artifacts)).engine.dispose()
        with closing(sqlite3.connect(path)) as connection:
            # Readers and writers at the same time; the mode stays with the file.
            connection.execute("PRAGMA journal_mode=WAL")
        yield


def note_reuse(run: Run) -> None:
    """Note that this command uses a finished run, unless it was made by this process."""
    if run.info.start_time < 1000 * psutil.Process().create_time():
        note_source(run.data.tags)


def note_source(tags: Mapping[str, str]) -> None:
    """Note that this command uses an earlier result with some tags (:func:`source_tags`).

    The first one of other code gives a warning: of another commit, or with files that differ from the commit
    then or now.
    """
    code = source_tags()
    same = tags.get("source_commit") == code["source_commit"]
    if not same or "true" in (tags.get("source_dirty"), code["source_dirty"]):
        _warn_of_other_code()


@cache
def _warn_of_other_code() -> None:
    """Print a warning once."""
    _log.warning(
        "warning: results of other code are reused (tags source_commit and source_dirty): "
        "tracking.resume=false repeats them"
    )

"""Keep what is logged to a tracking server that does not answer, and upload it later."""

import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from filelock import FileLock
from mlflow import MlflowClient
from mlflow.entities import Metric, Param, RunTag
from mlflow.exceptions import MlflowException, RestException

from skin.server import PATIENCE, answers

_log = logging.getLogger(__name__)


class OutboxClient(MlflowClient):
    """A client of a server that writes what it cannot log to files.

    Once an entry of a run is kept, the later ones are too, in order, until :meth:`upload` has sent them. Only
    existing runs are covered: nothing begins without the server.

    Args:
        uri: of the server.
        folder: of the files, one folder per run.
    """

    def __init__(self, uri: str, folder: Path) -> None:
        super().__init__(tracking_uri=uri)
        self._uri, self._folder, self._seen = uri, folder, 0.0

    def log_batch(
        self,
        run_id: str,
        metrics: Sequence[Metric] = (),
        params: Sequence[Param] = (),
        tags: Sequence[RunTag] = (),
        synchronous: bool | None = None,
    ) -> None:
        """Log metrics, parameters and tags."""
        content = {
            "metrics": [[one.key, one.value, one.timestamp, one.step] for one in metrics],
            "params": [[one.key, one.value] for one in params],
            "tags": [[one.key, one.value] for one in tags],
        }
        self._log(run_id, content)

    def set_tag(self, run_id: str, key: str, value: Any, synchronous: bool | None = None) -> None:
        """Set a tag."""
        self._log(run_id, {"tags": [[key, str(value)]]})

    def update_run(self, run_id: str, status: str | None = None, name: str | None = None) -> None:
        """Change status or name."""
        self._log(run_id, {"update": {"status": status, "name": name}})

    def set_terminated(self, run_id: str, status: str | None = None, end_time: int | None = None) -> None:
        """End a run."""
        self._log(run_id, {"end": {"status": status, "end_time": end_time or int(1000 * time.time())}})

    def log_artifact(self, run_id: str, local_path: str, artifact_path: str | None = None) -> None:
        """Log a file or folder."""
        self._log(run_id, {"artifact": artifact_path}, Path(local_path))

    def log_artifacts(self, run_id: str, local_dir: str, artifact_path: str | None = None) -> None:
        """Log the files in a folder."""
        for path in sorted(Path(local_dir).iterdir()):
            self.log_artifact(run_id, str(path), artifact_path)

    def upload(self) -> None:
        """Send what was kept, also by other processes; what the server does not take stays."""
        for place in sorted(self._folder.glob("*/")):
            with FileLock(f"{place}.lock"):
                if not place.exists():  # another process was faster
                    continue
                try:
                    for entry in _entries(place):
                        self._send(place.name, entry, place / entry["file"] if "file" in entry else None)
                except MlflowException as error:
                    _log.warning("what was kept of run %s is not uploaded: %s", place.name, error)
                    continue
                shutil.rmtree(place, ignore_errors=True)
            _log.warning("uploaded what was kept of run %s", place.name)

    def _log(self, run: str, entry: dict[str, Any], file: Path | None = None) -> None:
        """Send an entry, or keep it."""
        place = self._folder / run
        if not place.exists() and self._present():
            try:
                self._send(run, entry, file)
                return
            except MlflowException as error:
                # Only a failed connection: what the server itself says is an error.
                if isinstance(error, RestException) or not str(error).startswith("API request to"):
                    raise
        self._keep(place, entry, file)

    def _present(self) -> bool:
        """Return whether the server answers, or did in the last seconds."""
        if time.monotonic() > self._seen + PATIENCE:
            if not answers(self._uri):
                return False
            self._seen = time.monotonic()
        return True

    def _keep(self, place: Path, entry: dict[str, Any], file: Path | None) -> None:
        """Append an entry to the file of a run."""
        place.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(f"{place}.lock"):
            if not place.exists():
                _log.warning(
                    "the tracking server %s does not answer: run %s goes on, what it logs is kept in %s, and "
                    "the next command that reaches the server uploads it",
                    *(self._uri, place.name, place),
                )
                place.mkdir()
            if file is not None:
                number = sum(1 for _ in place.iterdir())
                entry = entry | {"file": f"{number}/{file.name}"}
                (place / str(number)).mkdir()
                (shutil.copytree if file.is_dir() else shutil.copy)(file, place / entry["file"])
            with (place / "log.jsonl").open("a") as log:
                log.write(json.dumps(entry) + "\n")

    def _send(self, run: str, entry: dict[str, Any], file: Path | None) -> None:
        """Send an entry to the server."""
        if "artifact" in entry:
            super().log_artifact(run, str(file), entry["artifact"])
        elif "end" in entry:
            super().set_terminated(run, **entry["end"])
        elif "update" in entry:
            super().update_run(run, **entry["update"])
        else:
            kinds: dict[str, Callable[..., Any]] = {"metrics": Metric, "params": Param, "tags": RunTag}
            values = {kind: [make(*one) for one in entry.get(kind, ())] for kind, make in kinds.items()}
            super().log_batch(run, **values, synchronous=True)


def _entries(place: Path) -> Iterator[dict[str, Any]]:
    """Yield the entries of a run; a last line that was cut off by a kill is left out."""
    path = place / "log.jsonl"
    for line in path.read_text().splitlines(keepends=True) if path.exists() else ():
        if line.endswith("\n"):
            yield json.loads(line)

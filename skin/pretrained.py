"""Pretrained models: folders in ``models/`` with weights and configuration of a finished run, and a card.

A folder holds ``run.json`` (:data:`RECORD`), ``config.yaml``, the file of weights, ``README.md`` (the card),
and ``SHA256SUMS`` with the hashes of the others, which ``sha256sum --check`` reads.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge, Le
from mlflow.entities import LifecycleStage, Metric, Run, RunData, RunInfo, RunStatus, RunTag

from skin.checksum import file_sha256
from skin.errors import InputError
from skin.paths import candidates
from skin.safe_loading import TEXT, parse_json, read_file
from skin.settings import check_settings

FORMAT = 1
"""Version of the content of the folder. Raise it when older folders can no longer be read."""
MODELS = "models"
"""The folder of all models, in the current folder and beside the package."""
RECORD, CONFIG, CARD, SUMS = "run.json", "config.yaml", "README.md", "SHA256SUMS"


@dataclass(frozen=True)
class _Record:
    """What is read of :data:`RECORD`; ``start_time`` in ms since 1970."""

    run: str
    start_time: Annotated[int, Ge(0), Le(2**53)]
    tags: dict[str, str]
    metrics: dict[str, float]


def find_pretrained(name: str) -> Run | None:
    """Return a pretrained model as the finished run that it is a copy of; None if no model has this name.

    The artifacts of the run are the files of the folder.

    Raises:
        InputError: the folder has another format, or a file of it was altered.
    """
    if not is_name(name):
        return None
    folder = next((path for path in candidates(Path(MODELS) / name) if path.is_dir()), None)
    return None if folder is None else _run(name, folder, _record(folder))


def is_name(name: str) -> bool:
    """Return whether a model may have this name: lower-case letters, digits and ``_``, and no id of a run."""
    known = re.fullmatch(r"[a-z][a-z0-9_]*", name) is not None
    return known and name != "latest" and re.fullmatch("[0-9a-f]+", name) is None


def checksums(folder: Path, learned: str) -> str:
    """Return the hashes of the files of a model, as ``sha256sum`` writes them.

    Args:
        folder: with the files.
        learned: name of the file of weights.
    """
    return "".join(
        f"{file_sha256(folder / name)}  {name}\n" for name in sorted((RECORD, CONFIG, CARD, learned))
    )


def _record(folder: Path) -> dict[str, Any]:
    """Return the content of :data:`RECORD`, after the format and the hashes were checked.

    Raises:
        InputError: the folder is not as it was written.
    """
    try:
        record = parse_json(read_file(folder / RECORD, TEXT))
        found = record["format"]
    except (OSError, ValueError, TypeError, LookupError) as error:
        raise InputError(f"{folder} is no pretrained model, {RECORD} cannot be read: {error}") from error
    if found != FORMAT:
        raise InputError(
            f"{folder} has format {found!r} and this version reads format {FORMAT}: install the version of "
            "the package that wrote it, or write it again with skin publish"
        )
    try:
        known = read_file(folder / SUMS, TEXT).decode("utf-8").splitlines()
        current = checksums(folder, Path(record["tags"]["learned"]).name).splitlines()
    except (OSError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise InputError(f"{folder} is no complete pretrained model: {error}") from error
    if altered := [line.split()[1] for line in current if line not in known]:
        raise InputError(
            f"{', '.join(altered)} in {folder} differs from {SUMS}: restore the folder, or write it again "
            "with skin publish"
        )
    needed = {name: record[name] for name in _Record.__annotations__ if name in record}
    check_settings(_Record, needed, f"{RECORD} of {folder}", whole=True)
    return record


def _run(name: str, folder: Path, record: dict[str, Any]) -> Run:
    """Return a finished run with the artifacts, tags and metrics of a model."""
    info = RunInfo(
        run_id=record["run"],
        experiment_id="",
        user_id="",
        status=RunStatus.to_string(RunStatus.FINISHED),
        start_time=record["start_time"],
        end_time=record["start_time"],  # a record does not say when the training ended
        lifecycle_stage=LifecycleStage.ACTIVE,
        artifact_uri=folder.resolve().as_uri(),
        run_name=name,
    )
    metrics = [Metric(key, value, record["start_time"], 0) for key, value in record["metrics"].items()]
    return Run(info, RunData(metrics=metrics, tags=[RunTag(*tag) for tag in record["tags"].items()]))

"""Results of finished runs as a small file, which replaces a lost database.

The file has one row per run: experiment, name, start and end (ms since 1970), tags, parameters, metrics, and
the small files that other commands read (the configuration of a training, what a trial publishes). It has
no weights and no predictions.
"""

import csv
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
from mlflow.entities import Param, Run, RunInfo
from mlflow.utils.mlflow_tags import MLFLOW_PARENT_RUN_ID
from omegaconf import OmegaConf

from skin.checksum import check_seal, write_parquet
from skin.config import Tracking
from skin.errors import InputError
from skin.evaluation.metrics import OUTCOMES
from skin.files import whole
from skin.tracking import PROCESS, RECORDED, Store

Record = dict[str, Any]
Key = tuple[str, ...]

_TEXTS = pa.map_(pa.string(), pa.string())
_SCHEMA = pa.schema(
    {
        "experiment": pa.string(),
        "name": pa.string(),
        "start": pa.int64(),
        "end": pa.int64(),
        "tags": _TEXTS,
        "params": _TEXTS,
        "metrics": pa.map_(pa.string(), pa.float64()),
        "files": pa.map_(pa.string(), pa.binary()),
    }
)
_MAPS = ("tags", "params", "metrics", "files")
_IDENTITY = ("fingerprint", "members", "evaluated", "study")
_CONFIGURATION = "config.yaml"
_ROWS, _VALUES, _SIZE = 10**5, 10**7, 1 << 30  # a thousand times those of the published results
_KEPT = (_CONFIGURATION, OUTCOMES)  # files of a training that are recorded


def read_records(path: Path) -> list[Record]:
    """Return the records of a file; none if there is no file.

    Raises:
        InputError: the file cannot be read, is damaged, or has other columns.
    """
    if not path.exists():
        return []
    try:
        check_seal(path)
        with pq.ParquetFile(path, page_checksum_verification=True) as file:
            _check_size(file.metadata)
            table = file.read()
            if table.schema.remove_metadata() != _SCHEMA:
                raise ValueError("it has other columns")
            return [_checked(record) for record in table.to_pylist()]
    except (OSError, ValueError, TypeError, OverflowError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"{path} holds no results of `skin results`: {reason}: restore it, or results.file=FILE names "
            "another"
        ) from error


def _check_size(about: pq.FileMetaData) -> None:
    """Check what a file claims to hold before memory is allocated for it."""
    groups = [about.row_group(number) for number in range(about.num_row_groups)]
    columns = [group.column(number) for group in groups for number in range(about.num_columns)]
    values = max((column.num_values for column in columns), default=0)
    size = sum(column.total_uncompressed_size for column in columns)
    if about.num_rows > _ROWS or values > _VALUES or not 0 <= size <= _SIZE:
        raise ValueError(f"it claims {about.num_rows} runs of {size} bytes")


def _checked(row: dict[str, Any]) -> Record:
    """Return a row as a record, whose entries have names and values."""
    record = row | {name: dict(row[name]) for name in _MAPS}
    empty = [name for name, value in record.items() if value is None]
    empty += [name for name in _MAPS if None in record[name].values()]
    if empty:
        raise ValueError(f"a run has no {empty[0]}")
    return record


def write_records(records: list[Record], path: Path) -> None:
    """Write records atomically, in an order that does not depend on the database."""
    ordered = sorted(records, key=lambda one: (_key(one), one["start"]))
    lines = [one | {name: sorted(one[name].items()) for name in _MAPS} for one in ordered]
    with whole(path, "results.file=FILE") as partial:
        table = pa.Table.from_pylist(lines, schema=_SCHEMA)
        write_parquet(table, partial, compression="zstd", compression_level=19)


def import_runs(settings: Tracking, path: Path) -> int:
    """Log the records of a file as finished runs; return their number.

    Left out are those of which the database has a run with the same identity that is as new.

    Args:
        settings: of the database; each run is logged in the experiment that it was recorded from.
        path: of the file, whose name becomes the tag ``RECORDED`` of these runs.
    """
    # Trials last, since they are nested under their trainings.
    records, count = sorted(read_records(path), key=lambda one: "evaluated" in one["tags"]), 0
    for experiment in sorted({one["experiment"] for one in records}):
        store = Store.open(replace(settings, experiment=experiment, recorded=True))
        known = {_identity(run.data.tags): run.info for run in reversed(store.find("FINISHED"))}
        for one in records:
            identity = _identity(one["tags"])
            before = known.get(identity)
            if one["experiment"] == experiment and (before is None or before.start_time < one["start"]):
                parent = known.get((one["tags"].get("evaluated", ""), "", "", ""))
                known[identity] = _log(store, one, path.name, parent.run_id if parent else None)
                count += 1
    return count


def export_runs(settings: Tracking, path: Path, folder: Path) -> int:
    """Write the runs that published files name, and the trials on them, to a file; return their number.

    Of runs with the same identity, the newest counts. Records of the file that the database lacks are kept as
    long as a published file names them.

    Args:
        settings: of the database.
        path: of the file.
        folder: with the published CSV files, whose column ``run`` has fingerprints.

    Raises:
        InputError: no published file names a finished run.
    """
    named = published_fingerprints(folder)
    candidates = [
        *_logged(settings, named),
        *(one for one in read_records(path) if _is_named(one["tags"], named)),
    ]
    if not candidates:
        raise InputError(
            f"no CSV file in {folder} names a finished run in its column run: `skin table` writes one"
        )
    newest = {_key(one): one for one in sorted(candidates, key=lambda one: one["start"])}
    write_records(list(newest.values()), path)
    return len(newest)


def published_fingerprints(folder: Path) -> set[str]:
    """Return the fingerprints in the column ``run`` of the CSV files of a folder."""
    found = set()
    for path in sorted(folder.glob("*.csv")):
        with path.open(newline="") as file:
            found |= {line["run"] for line in csv.DictReader(file) if line.get("run")}
    return found


def _is_named(tags: Mapping[str, str], named: set[str]) -> bool:
    """Return whether a run, or the training that it evaluates, is among the named ones."""
    return bool(named & {tags.get("fingerprint"), tags.get("evaluated")})


def _logged(settings: Tracking, named: set[str]) -> Iterator[Record]:
    """Yield records of the finished runs of a database."""
    first = Store.open(replace(settings, recorded=True))
    for experiment in first.client.search_experiments():
        store = replace(first, experiment=experiment.experiment_id)
        for run in store.find("FINISHED"):
            if _is_named(run.data.tags, named):
                yield _record(store, experiment.name, run)


def _record(store: Store, experiment: str, run: Run) -> Record:
    """Return a run as a record, without what identifies a machine, a user or a database."""
    tags = {
        name: value
        for name, value in run.data.tags.items()
        if name not in (PROCESS, RECORDED) and not name.startswith("mlflow.")
    }
    return {
        "experiment": experiment,
        "name": run.info.run_name,
        "start": run.info.start_time,
        "end": run.info.end_time,
        "tags": tags,
        "params": run.data.params,
        "metrics": run.data.metrics,
        "files": dict(_files(store, run)),
    }


def _files(store: Store, run: Run) -> Iterator[tuple[str, bytes]]:
    """Yield name and content of each file of a run that is recorded: no pictures, which do not compress."""
    every = store.client.list_artifacts(run.info.run_id)
    names = [one.path for one in every if not one.is_dir and Path(one.path).suffix != ".png"]
    with TemporaryDirectory() as folder:
        for name in names if "study" in run.data.tags else sorted({*names} & {*_KEPT}):
            path = Path(store.client.download_artifacts(run.info.run_id, name, folder))
            if name == _CONFIGURATION:
                stored = {str(key): value for key, value in OmegaConf.load(path).items()}
                stored.pop("tracking", None)  # places on this machine
                path.write_text(OmegaConf.to_yaml(OmegaConf.create(stored)))
            yield name, path.read_bytes()


def _log(store: Store, record: Record, source: str, parent: str | None) -> RunInfo:
    """Log a record as a finished run."""
    tags = record["tags"] | {RECORDED: source} | ({MLFLOW_PARENT_RUN_ID: parent} if parent else {})
    run = store.create(record["name"], tags, record["start"])
    identity = run.info.run_id
    store.log_metrics(run, record["metrics"])
    store.client.log_batch(identity, params=[Param(name, value) for name, value in record["params"].items()])
    if record["files"]:
        with TemporaryDirectory() as folder:
            for name, content in record["files"].items():
                (Path(folder) / Path(name).name).write_bytes(content)
            store.client.log_artifacts(identity, folder)
    store.client.set_terminated(identity, "FINISHED", record["end"])
    return run.info


def _identity(tags: Mapping[str, str]) -> Key:
    return tuple(tags.get(name, "") for name in _IDENTITY)


def _key(record: Record) -> Key:
    return record["experiment"], *_identity(record["tags"])

"""Write a folder of ``models/``, and its card: how a model was trained and measured, what it is not for."""

import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow.parquet as pq
from jinja2 import Environment
from omegaconf import OmegaConf

from skin import __version__
from skin.core.files import unwritable
from skin.errors import InputError
from skin.evaluation.operating_point import LABEL, parse_operating_point
from skin.evaluation.report import PERCENTAGES, format_number
from skin.runs.configuration import iterate_leaves, settings_of
from skin.runs.run import CARD, CONFIG, FORMAT, MODELS, RECORD, SUMS, FinishedRun, checksums, is_name
from skin.runs.store import PROCESS

_TEMPLATE = Path(__file__).with_name("card.md")
_LARGEST = 4_000_000  # bytes of weights
_FRACTIONS = (*PERCENTAGES, "/balanced_accuracy", "/ece")  # in per cent


def check_folder(name: str | None, licence: str | None) -> Path:
    """Return the folder of a new model.

    Args:
        name: of the model.
        licence: of its weights.

    Raises:
        InputError: one is missing, or there is such a model.
    """
    if name is None or not is_name(name):
        raise InputError(
            f"name={name} is no name of a model: use lower-case letters, digits and _, as in name=my_skin"
        )
    if licence is None:
        raise InputError("the weights have no licence: add licence=MIT, or another one")
    folder = Path(MODELS) / name
    if folder.exists():
        raise InputError(f"{folder} exists: delete it, or give the model another name")
    return folder


def write_folder(run: FinishedRun, folder: Path, licence: str) -> None:
    """Write the files of a model, all or none.

    Args:
        run: whose weights and figures they hold.
        folder: new.
        licence: of the weights.

    Raises:
        InputError: the run has too many weights or no predictions, or the folder cannot be written.
    """
    try:
        folder.parent.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=folder.parent, prefix=f".{folder.name}.") as partial:
            made = Path(partial) / folder.name
            made.mkdir()
            _write(run, licence, made)
            made.rename(folder)
    except OSError as error:
        raise unwritable(folder, error, "another current folder") from error


def _write(run: FinishedRun, licence: str, folder: Path) -> None:
    """Write the files of a model to a folder that has its name."""
    # Without the machine and the folders of the training.
    omitted = ("tracking", "trust")
    settings = {key: value for key, value in settings_of(run.stored).items() if key not in omitted}
    tags, metrics = run.run.data.tags, run.run.data.metrics
    weights = run.fetch(tags["learned"], str(folder))
    size = weights.stat().st_size
    amount = f"{size / 1e6:.1f} MB" if weights.is_file() else "a folder"
    if not weights.is_file() or size > _LARGEST:
        raise InputError(
            f"{run.title} has {amount} of weights, and a model is one file of at most {_LARGEST / 1e6:g} MB: "
            "choose the run of a smaller network"
        )
    record = {
        "format": FORMAT,
        "version": __version__,
        "licence": licence,
        "run": run.identity,
        "start_time": run.run.info.start_time,
        "tags": {key: tag for key, tag in tags.items() if key != PROCESS and not key.startswith("mlflow.")},
        "metrics": {key: value for key, value in metrics.items() if "/" in key or key == "parameters"},
        "check": _reference(run),
    }
    (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (folder / CONFIG).write_text(OmegaConf.to_yaml(OmegaConf.create(settings)), encoding="utf-8")
    (folder / CARD).write_text(model_card(folder.name, record, settings), encoding="utf-8")
    (folder / SUMS).write_text(checksums(folder, weights.name), encoding="utf-8")


def _reference(run: FinishedRun) -> dict[str, Any]:
    """Return predictions on the first 400 test gestures, of the evaluation after the training."""
    with TemporaryDirectory() as folder:
        table = pq.read_table(run.fetch("predictions.parquet", folder)).slice(0, 400)
    columns = {
        name: (name, 0.5) for name in table.column_names if f"same/{name}/accuracy" in run.run.data.metrics
    }
    if (point := run.point) is not None:
        columns["alarm"] = LABEL, point.threshold
    predicted = {name: table[f"p_{label}"].to_numpy() > level for name, (label, level) in columns.items()}
    predictions = {name: "".join("01"[int(yes)] for yes in values) for name, values in predicted.items()}
    correct = {
        name: int((values == (table[columns[name][0]].to_numpy() > 0.5)).sum())
        for name, values in predicted.items()
    }
    # Two may be closer to a threshold than processors round.
    return {"touches": len(table), "tolerance": 2, "correct": correct, "predictions": predictions}


def model_card(name: str, record: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card of a model in Markdown, by the template ``card.md``.

    Args:
        name: of the model.
        record: content of ``run.json`` (:mod:`skin.runs.run`).
        config: configuration of the run, in plain containers.
    """
    tags, metrics, network = record["tags"], record["metrics"], "model" in config["learner"]
    measured = [metric for metric in metrics if metric.count("/") == 2]
    columns = list(dict.fromkeys(metric.split("/")[0] for metric in measured))
    template = Environment(trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True).from_string(
        _TEMPLATE.read_text(encoding="utf-8")
    )
    return template.render(
        record,
        name=name,
        config=config,
        settings=_settings,
        network=["representation", "model", "fusion"] if network else [],
        trained=["optimizer", "trainer"] if network else [],
        point=parse_operating_point(tags["operating_point"]),
        day=datetime.fromtimestamp(record["start_time"] / 1000, UTC),
        columns=columns,
        rows=dict.fromkeys(metric.split("/", 1)[1] for metric in measured),
        cell=lambda value, row: format_number(value, 100 if row.endswith(_FRACTIONS) else 1),
    )


def _settings(group: Mapping[str, Any], *without: str) -> str:
    """Return the class of a group, if it has one, and its settings; nested ones as ``outer.inner``."""
    settings = {key: value for key, value in group.items() if key not in without}
    name = [f"`{settings['_target_']}`"] if "_target_" in settings else []
    texts = [
        f"{'.'.join(path)}={str(value).replace('|', '/')}"
        for path, value in iterate_leaves(settings)
        if not path[-1].startswith("_") and value not in (None, {})
    ]
    return " ".join([*name, ", ".join(texts)]).strip()

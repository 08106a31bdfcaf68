"""Write a folder of ``models/``, and its card: how a model was trained and measured, what it is not for."""

import json
from collections.abc import Iterator, Mapping
from datetime import UTC, datetime
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import pyarrow.parquet as pq
from omegaconf import OmegaConf

from skin import __version__
from skin.core.files import unwritable
from skin.errors import InputError
from skin.evaluation.operating_point import LABEL, parse_operating_point
from skin.evaluation.report import PERCENTAGES, format_number
from skin.runs.configuration import iterate_leaves, settings_of
from skin.runs.finished_run import CARD, CONFIG, FORMAT, MODELS, RECORD, SUMS, FinishedRun, checksums, is_name
from skin.runs.store import PROCESS

_LARGEST = 4_000_000  # bytes of weights
_CHECKED = 400  # test gestures whose predictions are kept
_TOLERANCE = 2  # of them may be closer to a threshold than processors round
# Machine and folders of the training.
_PRIVATE = ("tracking", "trust")

_SHARES = (*PERCENTAGES, "/balanced_accuracy", "/ece")  # in per cent
_COLUMNS = (
    "Per cent; degrees for a direction. `same`: test gestures on the device of the training. `holdout`: a "
    "tenth of the training gestures, used for nothing else. `device_shift`: test gestures on unseen devices. "
    "`unseen_layout`: test gestures on unseen layouts of the sensors. `accuracy` and `balanced_accuracy` are "
    "at a probability of 0.5, `alarm_recall` and `false_alarm_rate` at the threshold of the alarm. `ece` is "
    "the expected calibration error."
)
_DRAWN = (
    "Each gesture is measured by another device, drawn from the ranges above. `alarm_recall` and "
    "`false_alarm_rate` are means over these devices, quiet and bad ones, with one threshold for all. They "
    "do not compare with those of a model that is trained and tested on one quiet device. On a quiet device "
    "this model raises fewer false alarms, and with the threshold for it (`evaluation.profile=mild`) it "
    "finds more dangerous touches; on a bad device it finds fewer."
)
_NETWORK = ("representation", "model", "fusion")
_LIMITS = (
    "Do not use it to protect people, animals or property. Nothing here is a safety function.",
    "Do not use it on a real skin before you have calibrated that skin and evaluated the model on touches "
    "recorded with it.",
    "Do not use it where the conditions differ from those above: its accuracy and its false-alarm rate are "
    "unknown there.",
    "Do not take “not dangerous” for “safe”: the alarm misses touches at the rate that the table shows.",
)
_EQUATION10 = (
    "Do not use it with other mechanics than equation 10 of the report, such as those of a real skin."
)
_OVER_SENSORS = "Do not use it for touches between the sensors: each touch of its test presses a sensor."


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
    settings = {key: value for key, value in settings_of(run.stored).items() if key not in _PRIVATE}
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
    """Return predictions on the first test gestures, of the evaluation after the training."""
    with TemporaryDirectory() as folder:
        table = pq.read_table(run.fetch("predictions.parquet", folder)).slice(0, _CHECKED)
    labels = [name for name in table.column_names if f"same/{name}/accuracy" in run.run.data.metrics]
    columns = [(name, name, 0.5) for name in labels]
    if (point := run.point) is not None:
        columns.append(("alarm", LABEL, point.threshold))
    predictions, correct = {}, {}
    for name, label, threshold in columns:
        predicted = table[f"p_{label}"].to_numpy() > threshold
        predictions[name] = "".join("01"[int(yes)] for yes in predicted)
        correct[name] = int((predicted == (table[label].to_numpy() > 0.5)).sum())
    return {"touches": len(table), "tolerance": _TOLERANCE, "correct": correct, "predictions": predictions}


def model_card(name: str, record: Mapping[str, Any], config: Mapping[str, Any]) -> str:
    """Return the card of a model in Markdown.

    Args:
        name: of the model.
        record: content of ``run.json`` (:mod:`skin.runs.finished_run`).
        config: configuration of the run, in plain containers.
    """
    parts = [
        f"# {name}\n\nWritten by `skin export format=folder`; do not edit. Use it as `run={name}`.",
        _table("Model", _model(record, config)),
        _table("Training", _training(record, config)),
        _table("Conditions", _conditions(config), "Lengths in m, forces in N, pressures in Pa, times in s."),
        *([f"## Devices\n\n{_DRAWN}"] if _drawn(config["device"]) else []),
        _metrics(record["metrics"]),
        *(f"{key.removeprefix('cannot_')}: {why}" for key, why in _cannot(record["tags"])),
        _check(record["check"]),
        "## Not for\n\n" + "\n".join(f"- {line}" for line in _limits(config)),
    ]
    return "\n\n".join(parts) + "\n"


def _model(record: Mapping[str, Any], config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "licence of weights, configuration and card", record["licence"]
    yield "parameters", f"{record['metrics']['parameters']:.0f}"
    for group in (*(_NETWORK if "model" in config["learner"] else ()), "learner"):
        yield group, _settings(config[group], "model", "fusion", "optimizer", "trainer", "members")
    point = parse_operating_point(record["tags"]["operating_point"])
    if point is not None:
        yield "alarm", point.sentence()


def _training(record: Mapping[str, Any], config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    tags, day = record["tags"], datetime.fromtimestamp(record["start_time"] / 1000, UTC)
    dirty = {"true": ", with uncommitted changes", "false": ""}.get(tags["source_dirty"], ", changes unknown")
    yield "row, seed", f"`{tags['row']}`, {tags['seed']}"
    again = f"; figures below measured at {tags['measured_commit']}" if "measured_commit" in tags else ""
    yield "commit", f"{tags['source_commit']}{dirty}{again}"
    yield "run, fingerprint", f"{record['run']}, {tags['fingerprint']}"
    yield "date, processor", f"{day:%Y-%m-%d}, {tags['processor']}"
    yield "data", _settings(config["data"])
    yield "hash of the first training touches", tags["data_hash"]
    for group in ("optimizer", "trainer") if "model" in config["learner"] else ():
        yield group, _settings(config[group])


def _conditions(config: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for group in ("body", "layout"):
        if group in config:
            yield group, _settings(config[group])
    device = config["device"]
    for part in ("simulator", "contact"):
        if part in device:
            yield part, _settings(device[part])
    yield "device", _settings(device, "simulator", "contact", "touch", *config["data"])
    if "touch" in config:
        yield "touch", _settings(config["touch"])


def _drawn(device: Mapping[str, Any]) -> bool:
    """Return whether each gesture of the training is measured by a device of its own."""
    return bool(device.get("randomise", False) or "skins" in device)


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


def _table(title: str, rows: Iterator[tuple[str, str]], about: str = "") -> str:
    lines = "\n".join(f"| {key} | {value} |" for key, value in rows)
    return "\n\n".join(part for part in (f"## {title}", about, f"| | |\n|---|---|\n{lines}") if part)


def _metrics(values: Mapping[str, float]) -> str:
    """Return every metric of the evaluation, one column per set of touches."""
    measured = [name for name in values if name.count("/") == 2]
    columns = list(dict.fromkeys(name.split("/")[0] for name in measured))
    lines = [f"## Metrics\n\n{_COLUMNS}\n\n| | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    for row in dict.fromkeys(name.split("/", 1)[1] for name in measured):
        unit = 100 if row.endswith(_SHARES) else 1
        cells = (format_number(values.get(f"{column}/{row}"), unit) for column in columns)
        lines.append(f"| {row} | {' | '.join(cells)} |")
    return "\n".join(lines)


def _cannot(tags: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    yield from ((key, why) for key, why in sorted(tags.items()) if key.startswith("cannot_"))


def _check(check: Mapping[str, Any]) -> str:
    counts = ", ".join(f"{label} {count}" for label, count in check["correct"].items())
    return (
        f"## Check\n\nOf the first {check['touches']} test gestures (`same`) the number that the model "
        f"classified correctly: {counts}. `run.json` has each prediction. On another processor at most "
        f"{check['tolerance']} gestures may be classified differently."
    )


def _limits(config: Mapping[str, Any]) -> Iterator[str]:
    yield from _LIMITS
    if config["device"].get("simulator", {}).get("reading") == "equation10":
        yield _EQUATION10
    if config.get("touch", {}).get("over_sensors"):
        yield _OVER_SENSORS

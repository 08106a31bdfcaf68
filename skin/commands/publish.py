"""Write a finished run to models/NAME: weights, configuration, hashes and a card.

    skin publish run=latest name=my_skin licence=MIT

run=NAME then selects it wherever a run is accepted.
"""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from skin.command import command
from skin.config import plain
from skin.errors import InputError

if TYPE_CHECKING:
    from mlflow.entities import Run

    from skin.tracking import Store

_LARGEST = 4_000_000  # bytes of weights
_CHECKED = 400  # test gestures whose predictions are kept
_TOLERANCE = 2  # of them may be closer to a threshold than processors round
# Machine and folders of the training.
_PRIVATE = ("tracking", "trust")


@command("publish")
def main(config: DictConfig) -> None:
    """Write the files of a pretrained model, all or none."""
    from skin.pretrained import MODELS, is_name

    if config.name is None or not is_name(config.name):
        raise InputError(
            f"name={config.name} is no name of a model: use lower-case letters, digits and _, as in "
            "name=my_skin"
        )
    if config.licence is None:
        raise InputError("the weights have no licence: add licence=MIT, or another one")

    from skin.files import unwritable
    from skin.stored_run import find_run
    from skin.tracking import Store

    folder = Path(MODELS) / config.name
    if folder.exists():
        raise InputError(f"{folder} exists: delete it, or give the model another name")
    store = Store.existing(config.tracking)
    run = find_run(store, config.run)
    try:
        folder.parent.mkdir(exist_ok=True)
        with TemporaryDirectory(dir=folder.parent, prefix=f".{config.name}.") as partial:
            made = Path(partial) / config.name
            made.mkdir()
            _write(store, run, config.name, config.licence, made)
            made.rename(folder)
    except OSError as error:
        raise unwritable(folder, error, "another current folder") from error
    print(folder)


def _write(store: "Store", run: "Run", name: str, licence: str, folder: Path) -> None:
    """Write the files of a model to a folder."""
    import json

    from omegaconf import OmegaConf

    from skin import __version__
    from skin.model_card import model_card
    from skin.pretrained import CARD, CONFIG, FORMAT, RECORD, SUMS, checksums
    from skin.stored_run import fetch, load_configuration
    from skin.tracking import PROCESS

    stored = plain(load_configuration(store, run))
    settings = {key: value for key, value in stored.items() if key not in _PRIVATE}
    weights = fetch(store, run, run.data.tags["learned"], str(folder))
    size = weights.stat().st_size
    amount = f"{size / 1e6:.1f} MB" if weights.is_file() else "a folder"
    if not weights.is_file() or size > _LARGEST:
        raise InputError(
            f"{run.info.run_name} has {amount} of weights, and a model is one file "
            f"of at most {_LARGEST / 1e6:g} MB: choose the run of a smaller network"
        )
    tags, metrics = run.data.tags.items(), run.data.metrics.items()
    record = {
        "format": FORMAT,
        "version": __version__,
        "licence": licence,
        "run": run.info.run_id,
        "start_time": run.info.start_time,
        "tags": {key: tag for key, tag in tags if key != PROCESS and not key.startswith("mlflow.")},
        "metrics": {key: value for key, value in metrics if "/" in key or key == "parameters"},
        "check": _check(store, run),
    }
    (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    (folder / CONFIG).write_text(OmegaConf.to_yaml(OmegaConf.create(settings)), encoding="utf-8")
    (folder / CARD).write_text(model_card(name, record, settings), encoding="utf-8")
    (folder / SUMS).write_text(checksums(folder, weights.name), encoding="utf-8")


def _check(store: "Store", run: "Run") -> dict[str, Any]:
    """Return predictions on the first test gestures, of the evaluation after the training."""
    import pyarrow.parquet as pq

    from skin.evaluation.operating_point import LABEL, parse_operating_point
    from skin.stored_run import TAG, fetch

    with TemporaryDirectory() as folder:
        table = pq.read_table(fetch(store, run, "predictions.parquet", folder)).slice(0, _CHECKED)
    labels = [name for name in table.column_names if f"same/{name}/accuracy" in run.data.metrics]
    asked = [(name, name, 0.5) for name in labels]
    point = parse_operating_point(run.data.tags[TAG])
    if point is not None:
        asked.append(("alarm", LABEL, point.threshold))
    predictions, correct = {}, {}
    for name, label, threshold in asked:
        found = table[f"p_{label}"].to_numpy() > threshold
        predictions[name] = "".join("01"[int(one)] for one in found)
        correct[name] = int((found == (table[label].to_numpy() > 0.5)).sum())
    return {"touches": len(table), "tolerance": _TOLERANCE, "correct": correct, "predictions": predictions}

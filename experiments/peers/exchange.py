"""Exchange touches and predictions with a learner in another environment, as files."""

import json
import shutil
from itertools import count
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet
import torch
from torch import Tensor

from skin.config import Evaluation
from skin.device.base import AbstractSimulated
from skin.errors import InputError
from skin.evaluation.operating_point import threshold_gestures
from skin.evaluation.report import columns
from skin.files import whole
from skin.files import write as write_text
from skin.labels import Task
from skin.recording import Recording, Touches, touches_hash
from skin.recording_file import write_recording
from skin.signal.features import engineered_features

SETS = "sets.json"
ABOUT = "about.json"


def export_touches(device: AbstractSimulated, settings: Evaluation, folder: Path) -> None:
    """Write all sets of touches for training and evaluation, unless they are already there.

    ``touches/<set>.parquet`` are recordings (:mod:`skin.recording_file`), ``features/<set>.parquet`` hold the
    engineered features, one row per touch. Sets: ``train``, ``validation``, ``alarm`` (on which the
    alarm's threshold is chosen), then ``<column>_<number>`` for the sets of
    :func:`skin.evaluation.report.columns`. ``sets.json``, written last, names the content of each set: set ->
    digest. A folder with other touches is removed first, including predictions.

    Args:
        device: gives the touches.
        settings: of the evaluation.
        folder: created if it does not exist.
    """
    if (folder / SETS).is_file():
        known = json.loads((folder / SETS).read_text())
        complete = "alarm" in known and (folder / "features").is_dir()
        if complete and known["train"] == touches_hash(device.touches("train")):
            return
        shutil.rmtree(folder)
    learnt = {name: device.touches(name) for name in ("train", "validation")}
    first = learnt | {"alarm": threshold_gestures(device, settings)}
    known = {name: _export(touches, device, folder, name) for name, touches in first.items()}
    for column, sets in columns(device, settings).items():
        numbers = count()
        try:
            for touches in sets:
                name = f"{column}_{next(numbers)}"
                known[name] = _export(touches, device, folder, name)
        except InputError:  # sensors that cannot form a grid: the evaluation reports it
            continue
    write_text(json.dumps(known, indent=1) + "\n", folder / SETS)


class PeerPredictions:
    """Predictions of a peer for exported touches, read from files.

    Touches are identified by the digest of their content, so that predictions cannot be assigned to other
    touches.

    Args:
        folder: written by :func:`export_touches`.
        peer: name of the subfolder with ``about.json`` (information on the peer) and, per set, a
            ``<set>.parquet`` with one column per label.
        task: meaning of the labels.

    Attributes:
        about: seconds (of training), parameters, versions.
    """

    def __init__(self, folder: Path, peer: str, task: Task) -> None:
        self._names, self._folder = list(task.names), folder / peer
        known = json.loads((folder / SETS).read_text())
        self._sets = {content: name for name, content in known.items()}
        self.about = json.loads((self._folder / ABOUT).read_text())

    def probabilities(self, touches: Touches) -> Tensor:
        """Return the probability of each label, (B, L).

        Raises:
            LookupError: the touches were not exported.
        """
        content = touches_hash(touches)
        if content not in self._sets:
            raise LookupError(f"{self._folder.parent} has predictions for other touches: remove it")
        path = self._folder / f"{self._sets[content]}.parquet"
        table = pa.parquet.read_table(path, columns=self._names, memory_map=False)
        columns = [torch.from_numpy(table[name].to_numpy().copy()) for name in self._names]
        return torch.stack(columns, dim=1).to(torch.float32)


def _export(touches: Touches, device: AbstractSimulated, folder: Path, name: str) -> str:
    """Write one set and return its digest."""
    recording = Recording(touches, device.task, device.size, device.sensors.footprint)
    write_recording(recording, folder / "touches" / f"{name}.parquet")
    table = {key: values.to(torch.float32).numpy() for key, values in engineered_features(touches).items()}
    path = folder / "features" / f"{name}.parquet"
    with whole(path) as partial:
        pa.parquet.write_table(pa.table(table), partial, compression="zstd")
    return touches_hash(touches)

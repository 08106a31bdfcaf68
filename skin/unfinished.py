"""Trainings that were interrupted, and the checkpoints that continue them."""

import logging
from pathlib import Path

from mlflow.entities import Run

from skin.config import Tracking
from skin.files import unwritable
from skin.learner.network import LAST
from skin.source import source_tags
from skin.tracking import Store

_log = logging.getLogger(__name__)


def find_unfinished(store: Store, settings: Tracking, identity: str) -> Run | None:
    """Return the last killed run that the same code on the same processor can continue.

    Args:
        store: where.
        settings: with ``resume=False``, no run is continued.
        identity: fingerprint of the run.
    """
    if not settings.resume:
        return None
    source = source_tags()
    for run in store.find("KILLED", fingerprint=identity):
        same = all(run.data.tags.get(key) == value for key, value in source.items())
        if same and (_place(settings, run) / LAST).is_file():
            _log.info(
                "run %s was interrupted and continues: tracking.resume=false repeats it", run.info.run_id
            )
            return run
    return None


def unfinished_folder(settings: Tracking, run: Run) -> Path:
    """Return the folder for the checkpoints of a run; it is made where it is missing.

    Raises:
        InputError: it cannot be made.
    """
    place = _place(settings, run)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(place, error, "tracking.artifacts=FOLDER") from error
    return place


def _place(settings: Tracking, run: Run) -> Path:
    return Path(settings.artifacts or "mlartifacts").expanduser() / "unfinished" / run.info.run_id

"""Load a finished run: its configuration, its weights and the threshold of its alarm."""

import logging
import pickle
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import InstantiationException
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from mlflow.utils.file_utils import local_file_uri_to_path
from mlflow.utils.uri import is_local_uri
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from skin.build import build_device
from skin.config import validate_config
from skin.datamodule import TouchData
from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point, parse_operating_point
from skin.evaluation.settings import Evaluation
from skin.learner.base import AbstractLearner
from skin.pretrained import find_pretrained
from skin.safe_loading import load_yaml, regular
from skin.tracking import Store
from skin.trust import check_targets

_log = logging.getLogger(__name__)
TAG = "operating_point"
"""Tag of a run that holds :meth:`OperatingPoint.text`; ``null`` where the task has no ``dangerous``."""

# Errors of loading a file that is damaged or belongs to another learner.
_UNFIT = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    OSError,
    RuntimeError,
    TypeError,
    ValueError,
    pickle.PickleError,
)


def find_run(store: Store, name: str) -> Run:
    """Return a pretrained model, or the finished training run whose id or fingerprint begins with ``name``.

    ``latest`` is the last finished one that has weights. Of runs with equal fingerprints the last one counts.

    Raises:
        InputError: no run or more than one matches, or the files of the model were altered.
    """
    if (pretrained := find_pretrained(name)) is not None:
        return pretrained
    runs = [run for run in store.find("FINISHED") if "learned" in run.data.tags]
    if name == "latest":
        found = runs[:1]
    else:
        prints = {run.data.tags.get("fingerprint", ""): run for run in reversed(runs)}
        found = [run for run in runs if run.info.run_id.startswith(name)]
        found = found or [run for value, run in prints.items() if value.startswith(name)]
    if not found:
        raise InputError(f"no finished training run {name} in {store.uri}: skin train makes one")
    if len(found) > 1:
        raise InputError(f"{len(found)} runs have an id that begins with {name}: give more of it")
    return found[0]


def load_configuration(store: Store, run: Run, trust: bool = False) -> DictConfig:
    """Return the resolved configuration of a run.

    Args:
        store: where the run is.
        run: the run.
        trust: skip :func:`skin.trust.check_targets`; the configuration may then run any code.

    Raises:
        InputError: the configuration cannot be read, is that of another version, or names a class that is
            not allowed.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = fetch(store, run, "config.yaml", folder)
        try:
            stored = load_yaml(path)
        except (ValueError, OSError) as error:
            raise InputError(f"run {run.info.run_id} has no readable config.yaml: {error}") from error
    if not isinstance(stored, dict) or not all(isinstance(key, str) for key in stored):
        raise InputError(f"run {run.info.run_id} has no readable config.yaml: it holds no settings")
    if not trust:
        check_targets(stored, f"config.yaml of run {run.info.run_id}")
    config = OmegaConf.create(stored)
    try:
        validate_config(config)
    except InputError as error:
        raise InputError(
            f"config.yaml of run {run.info.run_id} does not fit this version: {error}: train it again"
        ) from error
    return config


@contextmanager
def described(run: Run) -> Iterator[None]:
    """Turn what goes wrong with settings of a stored run into an InputError: they may be damaged.

    Args:
        run: that the settings are of.
    """
    try:
        yield
    except (InputError, OmegaConfBaseException):
        raise
    except (*_UNFIT, AssertionError, InstantiationException) as error:
        cause = error.__cause__ if isinstance(error, InstantiationException) else None
        raise InputError(
            f"config.yaml of run {run.info.run_id} describes nothing that can be built: "
            f"{_reason(cause or error)}"
        ) from error


def load_learner(store: Store, run: Run, learner: AbstractLearner, data: TouchData) -> None:
    """Load the weights of a run into a learner.

    Raises:
        InputError: the weights do not fit the touches, such as another window with early fusion.
    """
    name = run.data.tags["learned"]
    if Path(name).name != name:
        raise InputError(
            f"run {run.info.run_id} names {name!r} as what it learned, which is no file of its own"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = fetch(store, run, name, folder)
        try:
            learner.load(data, path)
        except InputError:
            raise
        except _UNFIT as error:
            raise InputError(
                f"{name} of run {run.info.run_id} is damaged or does not fit these touches: {_reason(error)}"
            ) from error


def load_operating_point(
    run: Run, learner: AbstractLearner, stored: DictConfig, settings: Evaluation
) -> OperatingPoint | None:
    """Return the operating point of a run; None if its task has no label ``dangerous``.

    It is stored with the run. If the run has none for the target rate, it is chosen now if the device draws
    fresh gestures; else the threshold is 0.5. Both cases are reported on standard error.

    Args:
        run: a finished training.
        learner: its trained learner.
        stored: its configuration as :func:`load_configuration` gives it: the device it was trained on.
        settings: the target rate and the number of safe gestures.

    Raises:
        InputError: the stored operating point cannot be read.
    """
    text, target = run.data.tags.get(TAG), settings.false_alarm_rate
    known = None if text is None else parse_operating_point(text)
    if text is not None and (known is None or known.target == target):
        return known
    lacks = f"run {run.info.run_id} stores no alarm threshold for {100 * target:g} % false alarms"
    if "simulator" in stored.device:
        point = choose_operating_point(learner, build_device(stored), settings)
        message = None if point is None else f"{lacks}, it is chosen now: {point.sentence()}"
    else:
        point = known or OperatingPoint.default(target)
        message = (
            f"{lacks} and its device draws no fresh gestures: {point.sentence()}; train it again to store one"
        )
    if message:
        _log.warning(message)
    return point


def fetch(store: Store, run: Run, name: str, folder: str) -> Path:
    """Copy a file or folder of a run into ``folder`` and return its path.

    Raises:
        InputError: the run does not have it, or it cannot be read.
    """
    place = run.info.artifact_uri
    try:
        _check_regular(place, name)
        # Not by its id: a pretrained model is not in the database.
        return Path(download_artifacts(f"{place}/{name}", dst_path=folder, tracking_uri=store.uri))
    except (MlflowException, OSError, ValueError) as error:
        reason = " ".join(str(error).split())
        raise InputError(f"run {run.info.run_id} has no {name} in {place}: {reason}") from error


def _check_regular(place: str, name: str) -> None:
    """Raise a ValueError where a file of a local run is a device or a named pipe, which would never end."""
    if is_local_uri(place):
        path = Path(local_file_uri_to_path(place)) / name
        for part in path.rglob("*") if path.is_dir() else [path]:
            if part.exists() and not part.is_dir():
                regular(part)


def _reason(error: BaseException) -> str:
    """Return a short message; that of torch on a pickle would advise to run its code."""
    if isinstance(error, pickle.PickleError):
        return "it holds something else than numbers"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__

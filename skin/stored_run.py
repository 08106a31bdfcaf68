"""Restore a finished run: its configuration with changes, and its weights."""

import pickle
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from mlflow.artifacts import download_artifacts
from mlflow.entities import Run
from mlflow.exceptions import MlflowException
from omegaconf import DictConfig, OmegaConf

from skin.build import build_device
from skin.config import Evaluation, validate_config
from skin.datamodule import TouchData
from skin.errors import InputError
from skin.evaluation.operating_point import OperatingPoint, choose_operating_point, parse_operating_point
from skin.fingerprint import renamed
from skin.learner.base import AbstractLearner
from skin.safe_loading import load_yaml
from skin.tracking import Store
from skin.trust import check_targets

TAG = "operating_point"
"""Tag of a run that holds :meth:`OperatingPoint.text`; ``null`` where the task has no ``dangerous``."""

# What a learner raises on a file that is damaged, or that another learner wrote.
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
# What a run learned fits these as they were; the rest may be tried with others.
_FIXED = (
    "representation",
    "model",
    "fusion",
    "learner",
    "optimizer",
    "trainer",
    "experiment",
    "sweep",
    "seed",
)


def find_run(store: Store, name: str) -> Run:
    """Return the finished training run with an id that begins so; ``latest`` is the last one that finished.

    Raises:
        InputError: there is none, or more than one.
    """
    runs = [run for run in store.find("FINISHED") if "learned" in run.data.tags]
    named = [run for run in runs if run.info.run_id.startswith(name)]
    found = runs[:1] if name == "latest" else named
    if not found:
        raise InputError(f"no finished training run {name} in {store.uri}: skin train makes one")
    if len(found) > 1:
        raise InputError(f"{len(found)} runs have an id that begins with {name}: give more of it")
    return found[0]


def load_configuration(store: Store, run: Run, trust: bool = False) -> DictConfig:
    """Return the configuration that a run was made from, every value in it final.

    Args:
        store: where the run is.
        run: whoever made it.
        trust: skip :func:`skin.trust.check_targets`; the configuration may then run any code.

    Raises:
        InputError: it cannot be read, or names what a stored run may not build.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = _fetched(store, run, "config.yaml", folder)
        try:
            stored = renamed(load_yaml(path))
        except (ValueError, OSError) as error:
            raise InputError(f"run {run.info.run_id} has no readable config.yaml: {error}") from error
    if not isinstance(stored, dict):
        raise InputError(f"run {run.info.run_id} has no readable config.yaml: it holds no settings")
    if not trust:
        check_targets(stored, f"config.yaml of run {run.info.run_id}")
    return OmegaConf.create(stored)


def apply_overrides(stored: DictConfig, composed: DictConfig, overrides: Sequence[str]) -> DictConfig:
    """Return a run's configuration with the changes that a command line asks for, checked.

    Args:
        stored: as :func:`load_configuration` gives it.
        composed: a fresh configuration that the overrides have changed.
        overrides: of the command line: only what they name is taken from ``composed``.

    Raises:
        InputError: an override would not fit what the run learned.
    """
    whole = OmegaConf.create(_raw(stored))
    assert isinstance(whole, DictConfig)
    _follow(whole, composed)
    for override in OverridesParser.create().parse_overrides(list(overrides)):
        key = override.key_or_group
        if key in ("run", "trust") or key.startswith("hydra"):
            continue
        group = key.split(".")[0]
        if group in _FIXED:
            raise InputError(f"{key} was fixed when the run was trained: leave it out, or train another run")
        parent, _, name = key.rpartition(".")
        source = OmegaConf.select(composed, parent) if parent else composed
        # As it stands there, unresolved: a device follows the simulator of this run, not of a default one.
        OmegaConf.update(whole, key, _raw(source)[name], merge=False)
    if "rate" in whole.device and whole.device.rate is None:
        # A live device is reduced to the frames that the run has learnt from.
        whole.device.rate = stored.device.get("rate")
    whole.tracking = composed.tracking
    return validate_config(whole)


def load_learner(store: Store, run: Run, learner: AbstractLearner, data: TouchData) -> None:
    """Give a learner what a run learned.

    Raises:
        InputError: what it learned does not fit the touches, as another window does not fit early fusion.
    """
    name = run.data.tags["learned"]
    if Path(name).name != name:
        raise InputError(
            f"run {run.info.run_id} names {name!r} as what it learned, which is no file of its own"
        )
    with tempfile.TemporaryDirectory() as folder:
        path = _fetched(store, run, name, folder)
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
    """Return where a run raises the alarm; None where its task has no label ``dangerous``.

    It is stored with the run. If the run stores none for the target rate that is asked for, it is chosen now,
    where the device draws fresh gestures; else it is 0.5. Both are told on standard error.

    Args:
        run: a finished training.
        learner: what it learned.
        stored: its configuration as :func:`load_configuration` gives it: the device it was trained on.
        settings: the target rate and the number of safe gestures.

    Raises:
        InputError: the stored one cannot be read.
    """
    text, target = run.data.tags.get(TAG), settings.false_alarm_rate
    known = None if text is None else parse_operating_point(text)
    if text is not None and (known is None or known.target == target):
        return known
    lacks = f"run {run.info.run_id} stores no alarm threshold for {100 * target:g} % false alarms"
    if "simulator" in stored.device:
        point = choose_operating_point(learner, build_device(stored), settings)
        said = None if point is None else f"{lacks}, it is chosen now: {point.sentence()}"
    else:
        point = known or OperatingPoint.default(target)
        said = (
            f"{lacks} and its device draws no fresh gestures: {point.sentence()}; train it again to store one"
        )
    if said:
        print(said, file=sys.stderr, flush=True)
    return point


def _reason(error: Exception) -> str:
    """Return what an error says, in short; torch's words on a pickle advise to run the code in it."""
    if isinstance(error, pickle.PickleError):
        return "it holds something else than numbers"
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[-1] if lines else type(error).__name__


def _fetched(store: Store, run: Run, name: str, folder: str) -> Path:
    """Copy a file or folder of a run into ``folder``."""
    identity = run.info.run_id
    try:
        return Path(
            download_artifacts(run_id=identity, artifact_path=name, dst_path=folder, tracking_uri=store.uri)
        )
    except (MlflowException, OSError) as error:
        raise InputError(f"run {identity} has no {name} in {run.info.artifact_uri}: {error}") from error


def _follow(whole: DictConfig, composed: DictConfig) -> None:
    """Let the device follow other groups again, as a fresh configuration does, where it did in the run.

    Stored configurations are resolved; without this ``simulator=naive`` would not reach ``device.simulator``.
    """
    device = _raw(whole.device)
    for name, value in _raw(composed.device).items():
        if not isinstance(value, str) or not value.startswith("${") or name not in device:
            continue
        if OmegaConf.select(whole, value[2:-1]) == device[name]:
            device[name] = value
    whole.device = device


def _raw(config: DictConfig) -> dict[str, Any]:
    """Return plain containers with interpolations as they stand."""
    return OmegaConf.to_container(config, resolve=False)  # type: ignore[return-value]

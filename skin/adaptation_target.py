"""The skin that a run is adapted to: its device, its gestures, and the configuration of the adapted run."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import torch
from hydra import compose
from omegaconf import DictConfig, OmegaConf

from skin.alarm_threshold import threshold_device
from skin.build import build_device
from skin.config import plain, validate_config
from skin.device._blank import Blank
from skin.device.base import AbstractDevice
from skin.errors import InputError
from skin.fine_tuning import LEAST, FineTuning
from skin.finished_run import FinishedRun
from skin.recording import Touches
from skin.rng import Stream, generator
from skin.run_overrides import apply_overrides

_DEFAULT = 48  # gestures of a simulated device
_OWN = ("adapt", "data", "evaluation")  # groups that are taken from the command, not from the run


@dataclass(frozen=True)
class Target:
    """A skin to adapt a run to.

    Attributes:
        device: the skin, or its recording.
        twin: a simulated device with the body and layout of the skin. Its imperfections are those of the run,
            or of ``evaluation.profile``.
        config: of the adapted run.
    """

    device: AbstractDevice
    twin: AbstractDevice
    config: DictConfig


def find_target(
    parent: FinishedRun, config: DictConfig, settings: FineTuning, overrides: Sequence[str]
) -> Target:
    """Return the skin that a command describes.

    Args:
        parent: the run to adapt.
        config: of the command.
        settings: of the fine-tuning.
        overrides: of the command line.

    Raises:
        InputError: no skin is given, or its gestures have other labels than the run.
    """
    stored = parent.stored
    given = [one for one in overrides if _group(one) not in _OWN]
    there = apply_overrides(stored, config, given)
    # The device of the run, on this skin: its fresh gestures determine the threshold of the alarm.
    own = [one for one in given if _group(one) not in ("device", "profile")]
    own += [] if "simulator" in stored.device else ["device=simulated"]
    nominal = apply_overrides(stored, compose("adapt", own), own)
    if "test" in there.device:  # a recording, which is used as a whole
        whole = plain(there)
        there = validate_config(OmegaConf.create(whole | {"device": whole["device"] | {"test": "all"}}))
    device, twin = build_device(there), _twin(nominal, config)
    _check(parent, device, twin)
    content = plain(nominal if device.simulation is None else there)
    content["adapt"] = asdict(settings) | {
        "run": parent.run.data.tags["fingerprint"],
        "device": plain(there)["device"],
    }
    if device.simulation is not None:
        drawn = {"gestures": simulated_budget(settings.gestures or _DEFAULT), "fresh": False}
        content["data"] |= drawn
        content["device"] |= drawn | {"data_seed": settings.seed}
    content["data"]["augment"] = plain(config)["data"]["augment"]
    content["evaluation"] = plain(config)["evaluation"]
    content["row"] = f"{stored.row.removesuffix('_adapted')}_adapted"
    return Target(device, twin, validate_config(OmegaConf.create(content)))


def _twin(nominal: DictConfig, config: DictConfig) -> AbstractDevice:
    """Return the simulated device of a skin, or one of ``evaluation.profile``."""
    if config.evaluation.profile is None:
        known = build_device(nominal)
        return known.reference or known
    asked = OmegaConf.create(plain(nominal) | {"evaluation": plain(config)["evaluation"]})
    return threshold_device(nominal, asked)


def _check(parent: FinishedRun, device: AbstractDevice, twin: AbstractDevice) -> None:
    """Raise InputError if a device is not one skin, or has other labels than the run."""
    if device.simulation is None and device.reference is not None:
        raise InputError(
            f"run {parent.identity} was trained on many skins: name the one to adapt to, as in "
            "device=recording device.path=session.parquet or device=simulated layout.path=sensors.csv"
        )
    if device.task != twin.task:
        raise InputError(
            f"run {parent.identity} predicts {', '.join(twin.task.names)}, the gestures have the labels "
            f"{', '.join(device.task.names)}: give gestures with the labels of the run"
        )


def _group(override: str) -> str:
    """Return the group of an override."""
    return override.lstrip("+~").split("=")[0].split(".")[0]


def choose_gestures(device: AbstractDevice, settings: FineTuning) -> tuple[Touches, AbstractDevice | None]:
    """Return the gestures to fine-tune on, and a device with others for the report.

    A simulated device draws as many as are wanted: the training split that ``skin train`` has with
    ``data.gestures`` = n / 0.8 and the same seed. The others are its test gestures. For all other devices, a
    part of the touches of :meth:`AbstractDevice.all_touches` is drawn, and the others are the rest.

    Raises:
        InputError: there are fewer gestures than wanted, or than can be used.
    """
    if device.simulation is not None:
        count = settings.gestures or _DEFAULT
        drawn = device.simulation.replace(
            gestures=simulated_budget(count), fresh=False, data_seed=settings.seed
        )
        return drawn.touches("train")[:count], drawn
    known = device.all_touches()
    known.known_labels  # noqa: B018 - raises InputError without labels
    count = settings.gestures or len(known)
    if len(known) < LEAST:
        raise InputError(f"{len(known)} gestures are too few to adapt to a skin: record {LEAST} or more")
    if count > len(known):
        raise InputError(
            f"adapt.gestures={count} is more than the {len(known)} gestures of the device: "
            f"use adapt.gestures={len(known)}"
        )
    order = torch.from_numpy(generator(Stream.SPLIT, settings.seed).permutation(len(known)))
    rest = known[order[count:]]
    return known[order[:count]], Blank(device.task, device.size, rest) if len(rest) else None


def simulated_budget(count: int) -> int:
    """Return the budget of gestures whose training split, 80 %, has ``count`` of them or one more."""
    return -(-count * 10 // 8)

"""Score any predictor on frozen sets of test touches.

    python -m experiments.studies.frozen predictor=any_skin
    python -m experiments.studies.frozen predictor=mine.onnx
    python -m experiments.studies.frozen predictor=package.module:function

A predictor is a finished run or pretrained model, a file of ``skin export`` (for the sets of its layout), or
a function of readings (B, T, S), N, NaN where invalid, and positions (S, 3), m, that returns the probability
of each label, (B, 4), in the order big, dynamic, press, dangerous. Writes frozen.csv to the folder out=,
results by default. ``conf/benchmark.yaml`` describes the sets.
"""

import hashlib
import importlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from experiments import run_script
from experiments.studies.known_loads import write_rows
from skin.core.files import CONF, results
from skin.core.settings import checked, configured
from skin.device.simulated import Simulated
from skin.device.touches import Recording
from skin.errors import InputError
from skin.evaluation.metrics import compute_metrics
from skin.runs.build import build_device
from skin.runs.configuration import validate_config
from skin.runs.exported_model import ExportedModel
from skin.runs.model_of_run import load_run

Predict = Callable[[np.ndarray, np.ndarray], Any]
"""Maps readings (B, T, S) and positions (S, 3) to probabilities (B, 4)."""
_HASHED = ("shape", "duration", "onset", "draws")


@checked("frozen")
@dataclass(frozen=True)
class FrozenSettings:
    """Settings of the command line.

    Attributes:
        predictor: see above.
        sets: names of the sets, separated by semicolons; empty: all.
        file: that describes the sets.
        out: folder of the results.
    """

    predictor: str
    sets: str = ""
    file: str = str(CONF / "benchmark.yaml")
    out: str = "results"


def frozen_hash(recording: Recording, about: Mapping[str, Any]) -> str:
    """Return a hash of what rounding does not change: overrides, labels, gestures and invalid readings.

    Args:
        recording: the touches of a set.
        about: the set.
    """
    touches = recording.touches
    parts = [touches.known_labels.bool(), touches.valid, *(recording.parameters[name] for name in _HASHED)]
    content = hashlib.sha256("\n".join(about["overrides"]).encode())
    for part in parts:
        content.update(part.contiguous().numpy().tobytes())
    return content.hexdigest()[:16]


def build_set(name: str, about: Mapping[str, Any], common: list[str], gestures: int) -> Simulated:
    """Return the device of a set.

    Args:
        name: of the set.
        about: its overrides.
        common: overrides of all sets.
        gestures: number of touches.
    """
    words = [*common, *about["overrides"], f"device.test_gestures={gestures}"]
    with initialize_config_dir(str(CONF), version_base="1.3"):
        device = build_device(validate_config(compose("train", words)))
    if not isinstance(device, Simulated):
        raise InputError(f"the set {name} has no simulated device")
    return device


def predictor_on(name: str, device: Simulated) -> Predict | None:
    """Return a predictor for the skin of a device; None: it was exported for another layout.

    Raises:
        InputError: there is no such predictor.
    """
    module, _, function = name.partition(":")
    if function:
        try:
            return getattr(importlib.import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise InputError(f"predictor={name} cannot be imported: {error}") from error
    if name.endswith(".onnx"):
        exported = ExportedModel(name)
        same = exported.positions.shape == device.sensors.positions.shape
        if not same or not np.allclose(exported.positions, device.sensors.positions, atol=1e-6):
            return None
        return lambda readings, positions: exported.predict(readings)
    run = load_run(name, body=device.body, layout=device.layout)
    return lambda readings, positions: run.predict(readings)


def score(settings: FrozenSettings) -> Iterator[dict[str, Any]]:
    """Yield a row for every set that the predictor can be used on.

    Raises:
        InputError: an unknown set or predictor, touches that are not the frozen ones, or no probabilities.
    """
    about: Any = OmegaConf.to_container(OmegaConf.load(settings.file))
    names = [name.strip() for name in settings.sets.split(";") if name.strip()] or list(about["sets"])
    if unknown := [name for name in names if name not in about["sets"]]:
        raise InputError(f"sets={'; '.join(unknown)} is none of {'; '.join(about['sets'])}")
    for name in names:
        device = build_set(name, about["sets"][name], about["common"], about["gestures"])
        if (predict := predictor_on(settings.predictor, device)) is None:
            continue
        recording = device.recording("test", complete=False)
        if (present := frozen_hash(recording, about["sets"][name])) != about["sets"][name]["hash"]:
            raise InputError(
                f"the touches of the set {name} have the hash {present}, and the frozen ones "
                f"{about['sets'][name]['hash']}: use the version of the package that they were frozen with"
            )
        touches = recording.touches
        readings = touches.readings.masked_fill(~touches.valid, torch.nan).numpy()
        chances = torch.as_tensor(np.asarray(predict(readings, device.sensors.positions), np.float32))
        if chances.shape != touches.known_labels.shape or not chances.isfinite().all():
            raise InputError(
                f"a predictor returns finite probabilities {tuple(touches.known_labels.shape)}, got "
                f"{tuple(chances.shape)}"
            )
        metrics = compute_metrics(chances, touches.known_labels, device.task)
        shares = {key: 100 * value for key, value in metrics.items() if key.endswith("/accuracy")}
        yield {"set": name, "hash": present, "gestures": len(touches), **shares}


def main(words: Sequence[str]) -> None:
    """Score what the words ``name=value`` select."""
    entries = OmegaConf.to_container(OmegaConf.from_dotlist(list(words)))
    settings = configured(FrozenSettings, entries, "frozen")  # type: ignore[arg-type]
    write_rows(score(settings), results(settings.out) / "frozen.csv")


if __name__ == "__main__":
    run_script(main)

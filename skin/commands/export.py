"""Write the network of a finished run, from readings to probabilities, as one ONNX file.

    skin export run=latest out=skin.onnx
    skin export run=any_skin body=arm layout.path=sensors.csv
    skin live run=skin.onnx device=serial device.port=/dev/ttyACM0

The file is compared with the run on simulated or recorded touches first.
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from annotated_types import Ge, Gt, MinLen
from omegaconf import DictConfig

from skin.command import command
from skin.config import overrides, plain
from skin.errors import InputError
from skin.files import results

if TYPE_CHECKING:
    from mlflow.entities import Run

    from skin.exported.metadata import ModelMetadata
    from skin.progress import Steps
    from skin.recording import Touches
    from skin.trained import Trained


@dataclass(frozen=True)
class ExportSettings:
    """Settings under ``export:`` (``conf/export.yaml``).

    Attributes:
        touch: contact threshold, N above the baseline; None: that of the run.
        touches: number of touches on which the file is compared with the run.
        rates: of devices, Hz, for each of which the threshold of the alarm is chosen.
    """

    touch: Annotated[float, Gt(0)] | None
    touches: Annotated[int, Ge(1)]
    rates: Annotated[list[Annotated[float, Gt(0)]], MinLen(1)]


_THRESHOLDS = "choosing the thresholds of the alarm for touches"
# Expected seconds of each step, for the share in the progress.
_STEPS = {
    "loading the run": 10.0,
    "choosing the threshold of the alarm": 15.0,
    "tuning the contact threshold": 10.0,
    _THRESHOLDS: 80.0,
    "simulating touches to compare": 10.0,
    "writing the file and comparing it": 15.0,
}


@command("export")
def main(config: DictConfig) -> None:
    """Restore a finished run, write its network, and print the path."""
    from skin.progress import Steps

    with Steps(_STEPS) as steps:
        _export(config, steps)


def _export(config: DictConfig, steps: "Steps") -> None:
    from skin.settings import configured

    settings = configured(ExportSettings, plain(config)["export"], "export")
    path = None if config.out is None else Path(config.out).expanduser()
    if path is not None and path.suffix != ".onnx":
        raise InputError(f"out={config.out} must end in .onnx: as in out=skin.onnx")

    from skin.console import quiet
    from skin.exported.identity import describe_skin
    from skin.exported.writer import write_model
    from skin.hardware.live.engine_builder import describe, simulator_warning
    from skin.run_overrides import apply_overrides
    from skin.stored_run import find_run, load_configuration
    from skin.tracking import Store
    from skin.trained import choose_for_skin, load_trained

    quiet()
    store = Store.existing(config.tracking)
    run = find_run(store, config.run)
    stored = load_configuration(store, run, config.trust)
    whole = apply_overrides(stored, config, overrides())
    of = load_trained(store, run, whole, stored)
    steps.begin("choosing the threshold of the alarm")
    if "skins" in stored.device:
        of = replace(of, point=choose_for_skin(of.learner, stored, whole))
    module = of.learner.pipeline(of.positions)  # refused before anything is simulated
    if advice := simulator_warning(stored):
        print(advice, file=sys.stderr)
    steps.begin("tuning the contact threshold")
    described = describe(of, run.info.run_id, str(run.info.run_name), settings.touch)
    if "simulator" in stored.device and described.threshold is not None:
        steps.begin(_THRESHOLDS)
        described = replace(
            described, thresholds=_thresholds(of, run, stored, whole, described, settings.rates)
        )
    described = replace(described, skin=describe_skin(whole, of.positions.numpy()))
    path = path or results(None) / f"{str(run.info.run_name).split()[0]}_{run.info.run_id[:8]}.onnx"
    steps.begin("simulating touches to compare")
    touches = _touches(of, settings.touches)
    steps.begin("writing the file and comparing it")
    difference = write_model(module, described, touches, path)
    print(f"{path}: differs from the run by {difference:.1g} at most on {len(touches)} touches")


def _thresholds(
    of: "Trained",
    run: "Run",
    stored: DictConfig,
    whole: DictConfig,
    described: "ModelMetadata",
    rates: Sequence[float],
) -> dict[str, float]:
    """Return the thresholds of the alarm for safe touches, by the rate of the device, Hz."""
    from skin.hardware.live.engine import DebounceSettings
    from skin.hardware.live.trained_run import choose_threshold, watching_of

    thresholds = {}
    for rate in rates:
        watching = watching_of(of, described.contact, rate, DebounceSettings().alarm, False)
        thresholds[f"{rate:g}"] = choose_threshold(of, run, stored, whole, watching, print).threshold
    return thresholds


def _touches(of: "Trained", count: int) -> "Touches":
    """Return at most ``count`` touches; a run on a recording has those of its own only."""
    if (simulation := of.device.reference) is None:
        return of.device.touches("test")[:count]
    # A tenth of the gestures is the validation split.
    return simulation.replace(gestures=10 * max(10, count)).touches("validation")[:count]

"""Write a finished run as one ONNX file, or as a folder of models/ with weights, configuration and card.

    skin export run=latest out=skin.onnx
    skin export run=any_skin body=arm layout.path=sensors.csv
    skin live run=skin.onnx device=serial device.port=/dev/ttyACM0
    skin export run=features format=c out=model.h
    skin export run=latest format=folder name=my_skin licence=MIT
    skin export run=any_skin format=thresholds export.rates=[100]

The ONNX file holds a network, from readings to probabilities, and is compared with the run on simulated or
recorded touches first. The C file holds trees or rules, for a board. The folder holds any run: run=my_skin
then selects it wherever a run is accepted. format=thresholds adds those of a skin to the folder of a
pretrained model, where skin live finds them.
"""

import sys
from collections.abc import Sequence
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Ge, MinLen
from pydantic import PositiveFloat

from skin.commands._command import command, output
from skin.core.files import results
from skin.core.messages import quiet
from skin.core.settings import check_settings
from skin.errors import InputError
from skin.runs.configuration import Config, overrides, settings_of

if TYPE_CHECKING:
    from skin.evaluation.alarm import AlarmSource
    from skin.evaluation.decisions import LiveConditions
    from skin.runs.build import TorchModel
    from skin.runs.run import FinishedRun


@command("export")
def main(
    config: Config,
    run: str,
    format: Literal["onnx", "c", "folder", "thresholds"],
    out: str | None,
    name: str | None,
    licence: str | None,
    export: dict[str, Any],
) -> None:
    """Restore a finished run, write it, and print the path."""
    if format == "folder":
        if out is not None:
            raise InputError(f"a folder is written to models/NAME, not to out={out}: add name=my_skin")

        from skin.runs.run import check_folder, find_run, write_folder

        folder = check_folder(name, licence)
        write_folder(find_run(config.tracking, run, config.trust), folder, str(licence))
        print(folder)
    elif name is not None or licence is not None:
        raise InputError("only a folder takes name and licence: add format=folder, or leave them out")
    else:
        check_settings(_export_file, export, "export")
        if format == "onnx":
            _export_file(run, config, output(out, "skin.onnx", ".onnx") if out else None, **export)
        elif format == "c":
            _export_header(
                run, config, output(out, "skin.h", ".h") if out else None, export["touch"], export["rates"]
            )
        else:
            from skin.evaluation.alarm import ship_thresholds

            _, _, model, conditions = _load(run, config, export["touch"], export["rates"], alarm=False)
            ship_thresholds(model.alarm, conditions, print)


def _export_file(
    name: str,
    config: Config,
    path: Path | None,
    touch: PositiveFloat | None,
    touches: Annotated[int, Ge(1)],
    rates: Annotated[Sequence[PositiveFloat], MinLen(1)] | None,
) -> None:
    """Write the network of a run for one skin, with the thresholds of its alarm.

    Args:
        name: of the run.
        config: of the command.
        path: of the file; None: in ``results``.
        touch: contact threshold, N above the baseline; None: as in the run.
        touches: number of touches on which the file is compared with the run.
        rates: of devices, Hz, for each of which the threshold of the alarm is chosen; None: that of the run's
            device, 100 Hz if it has many.
    """
    from skin.runs.build import equation10_warning
    from skin.runs.model import describe_skin

    try:
        from skin.runs.onnx_writer import write_model
    except ModuleNotFoundError as error:
        raise InputError(
            "skin export needs onnx, onnxscript and onnxruntime: pip install 'tactile-skin[export]'"
        ) from error
    run, whole, model, conditions = _load(name, config, touch, rates)
    module = model.learner.pipeline(model.sites)  # refused before anything else is simulated
    if advice := equation10_warning(run.stored):
        print(advice, file=sys.stderr)
    described = replace(model.describe(), skin=describe_skin(settings_of(whole), model.positions))
    if "simulator" in run.stored.device and model.threshold is not None:
        described = replace(described, **_choose_thresholds(model.alarm, conditions))
    path = path or results(None) / f"{run.title.split()[0]}_{run.identity[:8]}.onnx"
    compared = (
        device.fresh_touches(touches)
        if (device := model.device.reference)
        else model.device.touches("test")[:touches]
    )
    difference = write_model(module, described, compared, path)
    print(f"{path}: differs from the run by {difference:.1g} at most on {len(compared)} touches")


def _export_header(
    name: str,
    config: Config,
    path: Path | None,
    touch: float | None,
    rates: Sequence[float] | None,
) -> None:
    """Write trees or rules for a board, of 100 Hz unless a rate is given; see :func:`_export_file`."""
    from skin.live.engine import DebounceSettings
    from skin.robot.board import write_header

    path, usual = path or results(None) / f"{name}.h", DebounceSettings()
    model, conditions = _load(name, config, touch, rates or [100.0])[2:]
    print(write_header(model, conditions, usual.label, usual.calm, path, print))


def _load(
    name: str, config: Config, touch: float | None, rates: Sequence[float] | None, alarm: bool = True
) -> "tuple[FinishedRun, Config, TorchModel, list[LiveConditions]]":
    """Return a run, its configuration for one skin, its model there, and how live views watch it at ports."""
    from skin.live.engine import DebounceSettings
    from skin.runs.build import load_model
    from skin.runs.run import find_run

    quiet()
    run = find_run(config.tracking, name, config.trust)
    used = run.configured(overrides())
    model = load_model(run, used, touch=touch, one_skin=True, alarm=alarm)
    rate = used.device.get("rate") or model.rate
    rates = rates or [rate if isinstance(rate, int | float) else 100.0]  # Hz
    patience = DebounceSettings().alarm
    return (
        run,
        model.config or used,
        model,
        [model.live_conditions(rate, patience, False) for rate in rates if model.alarms],
    )


def _choose_thresholds(source: "AlarmSource", conditions: "Sequence[LiveConditions]") -> dict[str, Any]:
    """Return thresholds and scores of the alarm by the rate of a device, Hz; 1 is refused: it raises none."""
    from skin.evaluation.alarm import choose_alarm_threshold

    points = {f"{live.rate:g}": choose_alarm_threshold(source, live, say=print) for live in conditions}
    sys.stderr.writelines(
        f"{at.warning()}: skin live refuses the file at this rate\n"
        for at in points.values()
        if at and at.useless
    )
    return {
        "thresholds": {rate: 1.0 if at.useless else at.threshold for rate, at in points.items() if at},
        "scores": {rate: astuple(at.score) for rate, at in points.items() if at and at.score} or None,
        "guarantees": {
            rate: {
                name: value
                for name, value in vars(at.guarantee).items()
                if name not in ("lapsed", "verified")
            }
            for rate, at in points.items()
            if at and at.guarantee
        }
        or None,
    }

"""Compare a recorded session with its simulation.

    skin compare session=session
    skin compare session=bench.csv presses=gauge.csv run=latest

The session holds gestures (of `skin record`) or presses of a bench. Writes compare.md and compare.png into
out=; run= compares the predictions of a run, too.
"""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from skin.commands._command import command
from skin.core.files import results
from skin.errors import InputError
from skin.runs.configuration import Config

if TYPE_CHECKING:
    from skin.device.base import AbstractSimulated
    from skin.record.comparison import Agreement, SessionComparison


@command("compare")
def main(
    config: Config,
    session: str | None,
    presses: str | None,
    run: str | None,
    out: str | None,
    compare: dict[str, Any],
) -> None:
    """Simulate a session, compare readings and, with ``run=``, predictions; write a page."""
    if session is None:
        raise InputError("which session? add session=FOLDER of skin record, or bench.csv")

    from skin.core.messages import quiet
    from skin.record.comparison import compare_session, publish_comparison
    from skin.runs.build import build_device

    quiet()
    device = build_device(config).simulated("a session is compared with a simulation")
    folder = results(out)
    about = f"Session {session}, simulated by {type(device.model).__name__}" + (
        f" with {device.calibration}." if device.calibration else ", not calibrated."
    )
    comparison = compare_session(device, session, presses, compare)
    agreement = None if run is None else _compare_predictions(run, config, device, comparison)
    page, picture = publish_comparison(comparison, agreement, about, compare["shown"], folder)
    print(page.read_text(encoding="utf-8"), page, picture, sep="\n")


def _compare_predictions(
    name: str, config: Config, device: "AbstractSimulated", comparison: "SessionComparison"
) -> "Agreement":
    """Return the predictions of a run for both sides; warn if it learned another mechanics."""
    import numpy as np

    from skin.device.base import Blank
    from skin.record.comparison import Agreement
    from skin.runs.run import FinishedRun
    from skin.runs.torch_model import load_model

    run, blank = FinishedRun.named(name, config), Blank.of(device.task, device.size, comparison.touches[0])
    if (learned := run.stored.simulator["_target_"]) != config.simulator["_target_"]:
        print(
            f"run {run.identity} was trained with {learned}: add simulator= to simulate the session with it\n"
        )
    model = load_model(run, replace(run.stored, layout=config.layout), device=blank, alarm=False)
    simulated, measured = ((model.predict(side) > 0.5).numpy() for side in comparison.touches)
    labels = [pair.labels for pair in comparison.pairs if pair.labels is not None]
    truth = np.array([[bool(row[name]) for name in device.task.names] for row in labels])
    return Agreement(device.task.names, simulated, measured, truth if labels else None)

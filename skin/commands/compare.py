"""Compare a recorded session with its simulation.

    skin compare session=session.csv
    skin compare session=bench.csv presses=gauge.csv run=latest

The session holds gestures (of `skin record`) or presses of a bench. Writes compare.md and compare.png into
out=; run= compares the predictions of a run, too.
"""

from typing import TYPE_CHECKING

from omegaconf import DictConfig

from skin.command import command
from skin.config import plain
from skin.errors import InputError
from skin.files import results

if TYPE_CHECKING:
    from collections.abc import Sequence

    from skin.device.base import AbstractSimulated
    from skin.plot.press_comparison import Verdicts
    from skin.recording import Touches


@command("compare")
def main(config: DictConfig) -> None:
    """Simulate a session, compare readings and, with ``run=``, predictions; write a page."""
    if config.session is None:
        raise InputError("which session? add session=session.csv, of skin record or a bench")

    from skin.build import build_device
    from skin.console import quiet
    from skin.files import write
    from skin.plot import gesture_comparison, gesture_page, press_comparison

    quiet()
    settings = plain(config)["compare"]
    device = build_device(config).simulated("a session is compared with a simulation")
    folder = results(config.out)
    about = f"Session {config.session}, simulated by {type(device.model).__name__}" + (
        f" with {device.calibration}." if device.calibration else ", not calibrated."
    )
    if config.presses is None and gesture_comparison.marked(config.session):
        pairs = gesture_comparison.read_gestures(device, config.session, settings["seed"])
        truth = [[bool(pair.labels[name]) for name in device.task.names] for pair in pairs.pairs]
        text = gesture_page.gestures_markdown(
            pairs, _verdicts(config, device, gesture_comparison.gesture_touches(pairs), truth), about
        )
        picture = gesture_page.plot_gestures(pairs, settings["shown"], folder / "compare.png")
    else:
        presses = press_comparison.read_presses(device, config.session, config.presses, settings)
        both = press_comparison.press_touches(
            presses, device.sensors.positions, device.model_rate, device.window
        )
        text = press_comparison.presses_markdown(presses, _verdicts(config, device, both), about)
        picture = press_comparison.plot_presses(presses, settings["shown"], folder / "compare.png")
    print(text, write(text, folder / "compare.md"), picture, sep="\n")


def _verdicts(
    config: DictConfig,
    device: "AbstractSimulated",
    both: "Sequence[Touches]",
    truth: list[list[bool]] | None = None,
) -> "Verdicts | None":
    """Return the predictions of a run for both sides; None without a run."""
    if config.run is None:
        return None

    import numpy as np

    from skin.device._blank import Blank
    from skin.finished_run import FinishedRun
    from skin.model_of_run import load_model
    from skin.plot.press_comparison import Verdicts

    measured = Blank.of(device.task, device.size, both[0])
    model = load_model(FinishedRun.named(config), device=measured, alarm=False)
    simulated, recorded = ((model.predict(side) > 0.5).numpy() for side in both)
    return Verdicts(device.task.names, simulated, recorded, None if truth is None else np.array(truth))

"""Compare a recorded session with its simulation.

    skin compare session=session
    skin compare session=bench.csv presses=gauge.csv run=latest

The session holds gestures (of `skin record`) or presses of a bench. Writes compare.md and compare.png into
out=; run= compares the predictions of a run, too.
"""

from typing import Any

from skin.commands._command import command
from skin.core.files import results
from skin.core.messages import quiet
from skin.errors import InputError
from skin.runs.configuration import Config


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

    from skin.record.comparison import compare_predictions, compare_session, publish_comparison
    from skin.runs.build import build_device

    quiet()
    device = build_device(config).simulated("a session is compared with a simulation")
    calibrated = f" with {device.calibration}." if device.calibration else ", not calibrated."
    description = f"Session {session}, simulated by {type(device.model).__name__}{calibrated}"
    comparison = compare_session(device, session, presses, compare)
    agreement = [] if run is None else compare_predictions(run, config, comparison, device)
    page, picture = publish_comparison(comparison, agreement, description, compare["shown"], results(out))
    print(page.read_text(encoding="utf-8"), page, picture, sep="\n")

"""Compare a recorded session with its simulation.

    skin compare session=session
    skin compare session=bench.csv presses=gauge.csv run=latest

The session holds gestures (of `skin record`) or presses of a bench. Writes compare.md and compare.png into
out=; run= compares the predictions of a run, too, and tests its alarm on presses.
"""

from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Any

from skin.commands._command import command, notify
from skin.core.files import results
from skin.core.messages import quiet
from skin.errors import InputError
from skin.runs.configuration import Config, overrides

if TYPE_CHECKING:
    from skin.calibration.bench import BenchData
    from skin.device.simulated import Simulated


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
    comparison = compare_session(device, session, presses, compare)
    agreement = [] if run is None else compare_predictions(run, config, comparison, device)
    alarm = _test_alarm(run, config, comparison.bench, device, compare) if run and comparison.bench else []
    if compare["miss_rate"] is not None and not alarm:
        raise InputError("compare.miss_rate needs presses of known force, and run= with an alarm to test")
    calibrated = f" with {device.calibration}." if device.calibration else ", not calibrated."
    page, picture = publish_comparison(
        comparison,
        [*agreement, *alarm],
        f"Session {session}, simulated by {type(device.model).__name__}{calibrated}",
        compare["shown"],
        results(out),
    )
    print(page.read_text(encoding="utf-8"), page, picture, sep="\n")


def _test_alarm(
    name: str, config: Config, bench: "BenchData", device: "Simulated", compare: dict[str, Any]
) -> list[str]:
    """Return what presses show of the alarm of a run, as the live view of a device at a port raises it."""
    import numpy as np

    from skin.evaluation.alarm import choose_alarm_threshold
    from skin.evaluation.guarantee import describe_presses
    from skin.live.engine import DebounceSettings
    from skin.live.engine_builder import engine_settings, raises_alarm
    from skin.record.comparison import judge_presses
    from skin.runs.build import load_model
    from skin.runs.run import find_run

    run = find_run(config.tracking, name, config.trust)
    trained = run.configured([word for word in overrides() if not word.startswith(("device=", "device."))])
    used = replace(trained, device={**config.device, "port": "that of the session"})
    model = load_model(run, trained, used, alarm=False)
    if not model.alarms:
        return []
    rate, patience = 1 / float(np.median(np.diff(bench.session.time))), DebounceSettings()
    conditions = model.live_conditions(rate, patience.alarm, False)
    point = choose_alarm_threshold(model.alarm, conditions, say=notify)
    assert point is not None
    patience = replace(patience, above=point.announced(notify))
    alarms = partial(raises_alarm, engine_settings(model, patience, danger=point.score))
    return [
        f"- {point.sentence()}",
        *describe_presses(
            *judge_presses(device, bench, compare["scale"], model.rate, alarms), compare["miss_rate"]
        ),
    ]

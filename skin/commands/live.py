"""Show the predictions of a trained run for a skin in real time.

    skin live device=serial device.port=/dev/ttyACM0
    skin live web=true

run=latest names the run; web=true also serves a page. Without device= the simulator of the run is used: no
hardware is needed. Ctrl-C stops.
"""

import sys
from collections.abc import Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from skin.command import command
from skin.config import overrides, plain

if TYPE_CHECKING:
    from skin.hardware.live.live_settings import LiveSettings


@command("live")
def main(config: DictConfig) -> None:
    """Restore a finished run, open the skin, and show verdicts until the command is ended."""
    show(config, overrides())


def show(config: DictConfig, given: Sequence[str]) -> None:
    """Show the predictions of a run for a skin until the command is ended.

    Args:
        config: of the command.
        given: settings that replace those of the run, as overrides; ``config`` has their values.
    """
    from skin.hardware.live.live_settings import LiveSettings

    live = LiveSettings.of(plain(config)["live"])

    import torch

    from skin.console import quiet

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    try:
        _watch(config, live, given)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: "LiveSettings", given: Sequence[str]) -> None:
    from rich.console import Console

    from skin.build import build_device
    from skin.hardware.live import engine_builder, terminal, web
    from skin.hardware.live.display import Display, DisplayInfo
    from skin.hardware.live.loop import LiveLoop
    from skin.stored_run import apply_overrides, find_run, load_configuration
    from skin.tracking import Store, ends_on_signal
    from skin.trained import load_trained

    store, messages = Store.open(config.tracking), Console(stderr=True)
    run = find_run(store, config.run)
    stored = load_configuration(store, run, config.trust)
    device = build_device(apply_overrides(stored, config, given))
    # The training data stay those of the run, for any watched device.
    trained = apply_overrides(
        stored, config, [one for one in given if not one.startswith(("device=", "device."))]
    )
    messages.print(f"loading {run.info.run_name} ({run.info.run_id[:8]})", highlight=False)
    if advice := engine_builder.simulator_warning(stored, device):
        messages.print(advice, highlight=False)
    of = load_trained(store, run, trained, stored)
    engine = engine_builder.make_engine(of, live.patience, live.touch, live.drift)
    if of.point is not None:
        above = live.patience.above
        messages.print(of.point.sentence() if above is None else f"alarm above {above:g}", highlight=False)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        # Opened last, because frames arrive from now on.
        source = device.source()
        skin = open_.enter_context(source.skin)
        places, span = of.positions.numpy(), of.window / of.rate
        display = Display(DisplayInfo(run.info.run_name, source.name, places, of.device.size, live.top, span))
        if config.web:
            messages.print(
                f"page: {open_.enter_context(web.serve_page(display, live.web_port))}", highlight=False
            )
        session = LiveLoop(skin, source.tare, engine, display)
        open_.callback(
            lambda: messages.print(f"{session.verdicts} verdicts, {session.line}", highlight=False)
        )
        open_.enter_context(terminal.show_in_terminal(display, Console()))
        session.run(config.seconds)

"""Watch a skin and show what a trained run says of each touch.

    skin live device=serial device.port=/dev/ttyACM0
    skin live web=true

run=latest names the run; web=true serves a page, too. Without device= the simulator of the run is watched: no
hardware is needed. Ctrl-C stops.
"""

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

from omegaconf import DictConfig

from skin.command import command
from skin.config import overrides, plain

if TYPE_CHECKING:
    from skin.hardware.live.live_settings import LiveSettings


@command("live")
def main(config: DictConfig) -> None:
    """Bring a finished run back, open what is watched, and show verdicts until somebody ends it."""
    from skin.hardware.live.live_settings import LiveSettings

    live = LiveSettings.of(plain(config)["live"])

    import torch

    from skin.console import quiet

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    try:
        _watch(config, live)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: "LiveSettings") -> None:
    from rich.console import Console

    from skin.build import build_device
    from skin.hardware.live import engine_builder, terminal, web
    from skin.hardware.live.display import Display, DisplayInfo
    from skin.hardware.live.loop import LiveLoop
    from skin.stored_run import apply_overrides, find_run, load_configuration
    from skin.tracking import Store, ends_on_signal
    from skin.trained import load_trained

    store, said = Store.open(config.tracking), Console(stderr=True)
    run = find_run(store, config.run)
    stored, given = load_configuration(store, run, config.trust), overrides()
    device = build_device(apply_overrides(stored, config, given))
    # What it learned from stays, whatever is watched.
    learnt = apply_overrides(
        stored, config, [one for one in given if not one.startswith(("device=", "device."))]
    )
    said.print(f"loading {run.info.run_name} ({run.info.run_id[:8]})", highlight=False)
    if advice := engine_builder.simulator_warning(stored, device):
        said.print(advice, highlight=False)
    of = load_trained(store, run, learnt, stored)
    engine = engine_builder.make_engine(of, live.patience, live.touch, live.drift)
    if of.point is not None:
        above = live.patience.above
        said.print(of.point.sentence() if above is None else f"alarm above {above:g}", highlight=False)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        # As late as this, because from now on frames come.
        source = device.source()
        skin = open_.enter_context(source.skin)
        places, span = of.positions.numpy(), of.window / of.rate
        display = Display(DisplayInfo(run.info.run_name, source.name, places, of.device.size, live.top, span))
        if config.web:
            said.print(
                f"page: {open_.enter_context(web.serve_page(display, live.web_port))}", highlight=False
            )
        session = LiveLoop(skin, source.tare, engine, display)
        open_.callback(lambda: said.print(f"{session.verdicts} verdicts, {session.line}", highlight=False))
        open_.enter_context(terminal.show_in_terminal(display, Console()))
        session.run(config.seconds)

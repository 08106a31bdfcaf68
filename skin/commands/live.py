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
    from skin.hardware.live.settings import Settings


@command("live")
def main(config: DictConfig) -> None:
    """Bring a finished run back, open what is watched, and show verdicts until somebody ends it."""
    from skin.hardware.live.settings import Settings

    live = Settings.of(plain(config)["live"])

    import torch

    from skin.console import quiet

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    try:
        _watch(config, live)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: "Settings") -> None:
    from rich.console import Console

    from skin.build import build_device
    from skin.hardware.live import start, terminal, web
    from skin.hardware.live.board import Board, Facts
    from skin.hardware.live.loop import Session
    from skin.reload import changed, configuration, find
    from skin.tracking import Store, ends_on_signal
    from skin.trained import trained

    store, said = Store.open(config.tracking), Console(stderr=True)
    run = find(store, config.run)
    stored, given = configuration(store, run, config.trust), overrides()
    device = build_device(changed(stored, config, given))
    # What it learned from stays, whatever is watched.
    learnt = changed(stored, config, [one for one in given if not one.startswith(("device=", "device."))])
    said.print(f"loading {run.info.run_name} ({run.info.run_id[:8]})", highlight=False)
    if advice := start.advice(stored, device):
        said.print(advice, highlight=False)
    of = trained(store, run, learnt, stored)
    engine = start.engine(of, live.patience, live.touch, live.drift)
    if of.point is not None:
        above = live.patience.above
        said.print(of.point.sentence() if above is None else f"alarm above {above:g}", highlight=False)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        # As late as this, because from now on frames come.
        source = device.source()
        skin = open_.enter_context(source.skin)
        places, span = of.positions.numpy(), of.window / of.rate
        board = Board(Facts(run.info.run_name, source.name, places, of.device.size, live.top, span))
        if config.web:
            said.print(f"page: {open_.enter_context(web.served(board, live.web_port))}", highlight=False)
        session = Session(skin, source.tare, engine, board)
        open_.callback(lambda: said.print(f"{session.verdicts} verdicts, {session.line}", highlight=False))
        open_.enter_context(terminal.shown(board, Console()))
        session.run(config.seconds)

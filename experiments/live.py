"""Watch a skin and say what touches it: python experiments/live.py device=serial device.port=/dev/ttyACM0

run=latest is what says it, web=true adds a page. Without device= the run's own simulator is watched: no
hardware needed. Ctrl-C ends it.
"""

import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from skin.config import DictConfig, command, overrides, plain

if TYPE_CHECKING:
    from skin.hardware.live.verdict import Patience


@command("live")
def main(config: DictConfig) -> None:
    """Bring a finished run back, open what is watched, and show verdicts until somebody ends it."""
    from skin.hardware.live.verdict import Patience

    live = plain(config)["live"]
    patience = Patience(**live["patience"])
    try:
        _watch(config, live, patience)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: dict[str, Any], patience: "Patience") -> None:
    import torch
    from rich.console import Console

    from skin.build import build_device
    from skin.console import quiet
    from skin.hardware.live import start, terminal, web
    from skin.hardware.live.board import Board, Facts
    from skin.hardware.live.loop import Session
    from skin.reload import changed, configuration, find
    from skin.tracking import Store, ends_on_signal

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    store, said = Store.open(config.tracking), Console(stderr=True)
    run = find(store, config.run)
    stored, given = configuration(store, run, config.trust), overrides()
    device = build_device(changed(stored, config, given))
    # What it learned from stays, whatever is watched.
    learnt = changed(stored, config, [one for one in given if not one.startswith(("device=", "device."))])
    said.print(f"loading {run.info.run_name} ({run.info.run_id[:8]})", highlight=False)
    if advice := start.advice(stored, device):
        said.print(advice, highlight=False)
    of = start.trained(store, run, learnt, stored)
    engine = start.engine(of, patience, live["touch"], live["drift"])
    if of.point is not None:
        given = patience.above is not None
        said.print(f"alarm above {patience.above:g}" if given else of.point.sentence(), highlight=False)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        # As late as this, because from now on frames come.
        source = start.source(device)
        skin = open_.enter_context(source.skin)
        places, span = of.positions.numpy(), of.window / of.rate
        board = Board(Facts(run.info.run_name, source.name, places, of.device.size, live["top"], span))
        if config.web:
            said.print(f"page: {open_.enter_context(web.served(board, live['web_port']))}", highlight=False)
        session = Session(skin, source.tare, engine, board)
        open_.callback(lambda: said.print(f"{session.verdicts} verdicts, {session.line}", highlight=False))
        open_.enter_context(terminal.shown(board, Console()))
        session.run(config.seconds)


if __name__ == "__main__":
    main()

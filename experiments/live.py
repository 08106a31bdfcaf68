"""Watch a skin and say what touches it: python experiments/live.py run=latest port=/dev/ttyACM0 web=true

port=simulated needs no hardware. Ctrl-C ends it.
"""

import sys
from contextlib import ExitStack
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from skin.config import command, plain
from skin.errors import InputError
from skin.live.newtons import Newtons, Unit
from skin.live.verdict import Patience


@command("live")
def main(config: DictConfig) -> None:
    """Bring a finished run back, open the port, and show verdicts until somebody ends it."""
    live = plain(config)["live"]
    unit = Unit(live["scale"], live["tare"])
    patience = Patience(**live["patience"])
    if config.port is None:
        raise InputError("no port: give port=/dev/ttyACM0, socket://HOST:NUMBER, FILE.parquet or simulated")
    try:
        _watch(config, live, unit, patience)
    except KeyboardInterrupt:
        print("ended", file=sys.stderr)


def _watch(config: DictConfig, live: dict[str, Any], unit: Unit, patience: Patience) -> None:
    import torch
    from rich.console import Console

    from skin.calibration.values import read
    from skin.console import quiet
    from skin.live import start, terminal, web
    from skin.live.board import Board, Facts
    from skin.live.session import Session
    from skin.port.opening import open_skin
    from skin.reload import changed, configuration, find
    from skin.tracking import Store, ends_on_signal

    quiet()
    torch.set_num_threads(config.tracking.threads or 1)
    calibration = None if live["calibration"] is None else read(live["calibration"])
    store, said = Store.open(config.tracking), Console(stderr=True)
    run = find(store, config.run)
    own = changed(configuration(store, run), config, list(HydraConfig.get().overrides.task))
    said.print(f"loading {run.info.run_name} ({run.info.run_id[:8]})", highlight=False)
    of = start.trained(store, run, own)
    engine = start.engine(of, patience, live["touch"])
    if calibration is not None:
        calibration.fits(len(of.positions))
    facts = Facts(run.info.run_name, config.port, of.positions.numpy(), of.device.size, live["top"])
    board = Board(facts)
    with ExitStack() as open_:
        open_.enter_context(ends_on_signal())
        if config.web:
            said.print(f"page: {open_.enter_context(web.served(board, live['web_port']))}", highlight=False)
        reader = live["reader"] | {"reconnect": True}
        skin = open_.enter_context(open_skin(config.port, of.positions, device=of.device, **reader))
        plain_numbers = config.port == "simulated" or config.port.endswith((".parquet", ".csv"))
        newtons = Newtons(unit, lambda: skin.header, calibration, plain_numbers)
        session = Session(skin, newtons, engine, board)
        open_.callback(lambda: said.print(f"{session.verdicts} verdicts, {session.line}", highlight=False))
        open_.enter_context(terminal.shown(board, Console()))
        session.run(config.seconds)


if __name__ == "__main__":
    main()

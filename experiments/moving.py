"""What moving and misplaced sensors cost: python experiments/moving.py n=1000 moving.rows=all

moving.train=true also trains sequence_graph on the layout, on true and on estimated positions of the sensors.
"""

from collections.abc import Iterator
from copy import deepcopy
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from skin.command import command
from skin.config import plain
from skin.files import results
from studies.settings import MovingSettings

if TYPE_CHECKING:
    from studies.moving_runs import Trial


@command("moving")
def main(config: DictConfig) -> None:
    """Measure motion, try finished runs, train if asked to; print and write moving.md and moving.csv."""
    settings = MovingSettings(**plain(config)["moving"])

    from skin.build import build_device
    from skin.console import quiet
    from studies.moving import change
    from studies.moving_runs import train_lines
    from studies.moving_table import comparison, publish

    quiet()
    device = build_device(_free(config)).simulated("how sensors move is known in simulation only")
    moves = change(device, config.n)
    print(moves.sentence, flush=True)
    overrides = HydraConfig.get().overrides.task
    trained = train_lines(overrides, settings.seeds) if settings.train else []
    lines = comparison([*_tried(config, settings), *trained])
    folder = results(config.out)
    publish(folder, moves, config.n, lines)


def _free(config: DictConfig) -> DictConfig:
    """Return a configuration of the same skin, in which sensors may move along it."""
    free = deepcopy(config)
    OmegaConf.set_readonly(free, False)
    if "constraint" in free.simulator:
        free.simulator.constraint = "free"
    return free


def _tried(config: DictConfig, settings: MovingSettings) -> Iterator["Trial"]:
    """Yield finished runs on misplaced sensors and on skins whose modulus varies."""
    from rich.console import Console
    from rich.progress import track

    from skin.tracking import Store
    from studies.moving_runs import latest, try_run

    store = Store.open(config.tracking)
    runs = latest(store, config.data.name, settings.rows)
    for run in track(runs, "trying finished runs", console=Console(stderr=True), disable=not runs):
        yield from try_run(store, run, config, settings)


if __name__ == "__main__":
    main()

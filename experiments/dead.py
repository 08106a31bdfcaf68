"""What dead sensors cost finished runs: python experiments/dead.py rows=all

Each run keeps the mask it was trained with. To compare masks, train pairs on devices that have dead sensors,
more and fewer of them, or a mask that never varies is learnt as if it were always so:
skin train -m experiment=temporal_graph row=dead representation.mask=true,false
    device.dead=[0,5] device.randomise=true seed=0,1,2
"""

from skin.command import command
from skin.config import DictConfig, plain
from skin.files import results
from studies.settings import DeadSettings


@command("dead")
def main(config: DictConfig) -> None:
    """Try finished runs on devices with dead sensors; print and write dead.md and dead.csv."""
    settings = DeadSettings(**plain(config)["dead"])

    from rich.console import Console
    from rich.progress import track

    from skin.console import quiet
    from skin.tracking import Store
    from studies.dead import newest, publish, try_run

    quiet()
    store = Store.open(config.tracking)
    found = newest(store, config, plain(config)["rows"])
    runs = [(line, run) for line, seeds in found.items() for run in seeds.values()]
    shown = track(runs, "trying finished runs", console=Console(stderr=True), disable=not runs)
    trials = [trial for line, run in shown for trial in try_run(store, line, run, config, settings)]
    folder = results(config.out)
    publish(folder, trials)


if __name__ == "__main__":
    main()

"""What friction and sensors that lean tell of the direction of sliding: python experiments/direction.py

Trains each row on three skins of simulator=solid: upright sensors without friction and with it, tilted ones
with it. Overrides of the training follow: trainer.max_epochs=30 direction.rows=[gru] layout.path=mine.csv
"""

from skin.command import command
from skin.config import DictConfig, overrides, plain
from skin.files import results
from studies.settings import DirectionSettings


@command("direction")
def main(config: DictConfig) -> None:
    """Train what is missing, compare, print and write direction.md and direction.csv."""
    settings = DirectionSettings(**plain(config)["direction"])

    from skin.console import quiet
    from studies.direction import comparison, publish, train_lines

    quiet()
    lines = train_lines(overrides(), settings)
    publish(results(config.out), comparison(lines))


if __name__ == "__main__":
    main()

"""The runs in the results table: the rows of the sweep, and those that other commands make."""

from contextlib import suppress

from omegaconf import DictConfig, OmegaConf

import ensemble
from peers import PEERS
from skin.config import CONF
from skin.errors import InputError
from skin.sweep import jobs
from skin.tracking import Store
from studies.cli import configuration

__all__ = ["Entries"]

# They stand in the table as soon as a run of theirs has finished.
OTHERS = ("experiment=best_fresh", *(f"row={row}" for row in (*ensemble.WAYS, *PEERS)))


class Entries:
    """The configurations of a table.

    Args:
        overrides: of the sweep.

    Attributes:
        rows: one per row, simulator and seed of the sweep.
        others: the same of the rows that other commands make.
    """

    def __init__(self, overrides: list[str]) -> None:
        parameters = OmegaConf.load(CONF / "sweep" / "table.yaml").hydra.sweeper.params
        trained = [[f"{key}={value}" for key, value in job.items()] for job in jobs(overrides, parameters)]
        self.rows = [configuration(*job) for job in trained]
        # Every simulator and seed once, in order: the same touches whatever learns from them.
        touches = (tuple(word for word in job if not word.startswith("experiment=")) for job in trained)
        self._touches = list(dict.fromkeys(touches))
        self.others = [configuration(*job, other) for job in self._touches for other in OTHERS]

    def vote(self, store: Store) -> None:
        """Let the report's networks decide together, wherever two of them have finished."""
        from studies.ensemble import combine

        for job in self._touches:
            members, ways = ensemble.configurations(list(job))
            with suppress(InputError):
                combine(store, members, ways)

    def named(self, configs: list[DictConfig]) -> list[tuple[str, str, DictConfig]]:
        """Return configurations with their row and simulator."""
        return [(config.row, config.data.name, config) for config in configs]

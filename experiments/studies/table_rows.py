"""The runs in the results table: the rows of the sweep, and those that other commands make."""

from collections.abc import Sequence

from hydra import compose
from omegaconf import DictConfig, OmegaConf

from experiments import peers
from experiments.studies.row_ensembles import WAYS, combine
from experiments.studies.runs import newest_finished
from skin.config import validate_config
from skin.paths import CONF
from skin.run import simulator
from skin.sweep import sweep_jobs
from skin.tracking import Store

# They stand in the table as soon as a run of theirs has finished.
OTHERS = ("experiment=best_fresh", "experiment=features_tuned", *(f"row={row}" for row in WAYS))
_PEERS = (f"hydra.searchpath=['file://{peers.CONF}']",)
MEMBERS = ("linked_graph", "temporal_graph", "temporal_image", "sequence_graph", "sequence_image")


class Entries:
    """The configurations of a table.

    Args:
        overrides: of the sweep.

    Attributes:
        rows: one per row, simulator and seed of the sweep.
        others: the same of the rows that other commands make.
    """

    def __init__(self, overrides: Sequence[str]) -> None:
        parameters = OmegaConf.load(CONF / "sweep" / "table.yaml").hydra.sweeper.params
        trained = [
            [f"{key}={value}" for key, value in job.items()] for job in sweep_jobs([*overrides], parameters)
        ]
        self.rows = [_composed(*job) for job in trained]
        # Every simulator and seed once, in order: the same touches whatever learns from them.
        touches = (tuple(word for word in job if not word.startswith("experiment=")) for job in trained)
        self._touches = list(dict.fromkeys(touches))
        others = [[other] for other in OTHERS] + [[*_PEERS, f"experiment={row}"] for row in peers.ROWS]
        self.others = [_composed(*job, *other) for job in self._touches for other in others]

    def vote(self, store: Store) -> None:
        """Let the report's networks decide together, wherever two of them have finished."""
        for job in self._touches:
            configs = [_composed(*job, f"experiment={row}") for row in MEMBERS]
            runs = {config.row: (config, newest_finished(store, config)) for config in configs}
            present = {row: (config, run) for row, (config, run) in runs.items() if run is not None}
            if len(present) > 1:
                combine(store, present, {way: _composed(*job, f"row={way}") for way in WAYS})

    def named(self, configs: list[DictConfig]) -> list[tuple[str, str, DictConfig]]:
        """Return configurations with their row and simulator."""
        return [(config.row, simulator(config), config) for config in configs]


def _composed(*words: str) -> DictConfig:
    return validate_config(compose("train", list(words)))

"""Which runs stand in the results table."""

from hydra import initialize_config_dir

from experiments.studies.table_rows import Entries
from skin.paths import CONF


def test_the_table_has_the_rows_of_its_sweep_and_those_of_other_commands():
    with initialize_config_dir(str(CONF), version_base="1.3"):
        entries = Entries(["sweep=table", "seed=0", "simulator=naive"])
    ours = [row for row, _, _ in entries.named(entries.rows)]
    others = [row for row, _, _ in entries.named(entries.others)]
    assert set(ours) >= {"rules", "features", "temporal_graph", "sequence_image", "best"}
    assert set(others) >= {"best_fresh", "ensemble_vote", "minirocket", "multirocket_hydra"}
    assert len({*ours, *others}) == len(ours) + len(others)

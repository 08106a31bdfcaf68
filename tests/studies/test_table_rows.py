"""Which runs stand in the results table."""

from studies.table_rows import Entries


def test_the_table_has_the_rows_of_its_sweep_and_those_of_other_commands():
    entries = Entries(["sweep=table", "seed=0", "simulator=naive"])
    ours = [row for row, _, _ in entries.named(entries.rows)]
    others = [row for row, _, _ in entries.named(entries.others)]
    assert set(ours) >= {"rules", "features", "temporal_graph", "sequence_image", "best"}
    assert set(others) >= {"best_fresh", "ensemble_vote", "lightgbm", "multirocket_hydra"}
    assert len({*ours, *others}) == len(ours) + len(others)

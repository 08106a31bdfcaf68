"""Which runs stand in the results table."""

from studies.table_rows import Entries


def test_the_table_has_the_rows_of_its_sweep_and_those_of_other_commands():
    entries = Entries(["sweep=table", "seed=0,1", "simulator=naive,fem"])
    ours = {(row, simulator) for row, simulator, _ in entries.named(entries.rows)}
    others = {(row, simulator) for row, simulator, _ in entries.named(entries.others)}
    assert {row for row, _ in ours} >= {"rules", "features", "temporal_graph", "sequence_image", "best"}
    assert {row for row, _ in others} >= {"best_fresh", "ensemble_vote", "lightgbm", "multirocket_hydra"}
    assert {simulator for _, simulator in ours} == {simulator for _, simulator in others} == {"naive", "fem"}
    assert len(entries.rows) == 2 * len(ours)
    assert len(entries.others) == 2 * len(others)

"""`skin adapt` makes a run of another skin from few gestures, which all commands take."""

from dataclasses import replace

import pytest

from skin.device.files import read_recording, write_recording
from tests.commands.conftest import query

SKIN = ["layout=grid", "layout.rows=3", "layout.columns=3", "simulator=naive"]
NETWORK = ["representation=features", "model=mlp", "model.widths=[]", "fusion.head=residual"]
SMALL = ["evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=64"]
TEST = "device.test_gestures=160"
RECORDED = ["device=recording", "device.path=session.parquet"]
QUICK = ["adapt.layers=[all]", "adapt.lr=[0.001]", "adapt.epochs=12", "adapt.scratch=[]", *SMALL]
OTHER = ["device.gain_spread=0.3", "device.time_constant=0.4", "device.seed=3"]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    quick = ["data.gestures=480", "trainer.max_epochs=15", "optimizer.lr=0.003", "fusion.hidden=16"]
    run(folder, "train", *NETWORK, *SKIN, *SMALL, TEST, *quick)
    return folder


@pytest.fixture(scope="module")
def session(run, folder):
    run(folder, "generate", *SKIN, *OTHER, "n=208", "seed=5", "out=session.parquet", store=False)
    return folder / "session.parquet"


def runs(folder):
    found = query(folder, "select run_uuid from runs where status='FINISHED' order by start_time")
    return [identity for (identity,) in found]


def metrics(folder, run):
    return dict(query(folder, "select key, value from latest_metrics where run_uuid=?", [run]))


def tags(folder, run):
    return dict(query(folder, "select key, value from tags where run_uuid=?", [run]))


@pytest.fixture(scope="module")
def adapted(run, folder, session):
    """The run to adapt, the run that was made of it with recorded gestures, and what the command printed."""
    parent = runs(folder)[-1]
    done = run(folder, "adapt", f"run={parent}", *RECORDED, "adapt.gestures=48", *QUICK)
    return parent, runs(folder)[-1], done.stdout


@pytest.mark.slow("trains and adapts a run")
def test_a_recorded_skin_is_adapted_to_and_the_rest_of_it_is_reported(run, folder, adapted):
    parent, made, said = adapted
    found, about = metrics(folder, made), tags(folder, made)
    assert (about["adapted"], about["row"]) == (parent, "custom_adapted")
    assert "device.path=session.parquet" in about["target"]
    assert about["chosen"].startswith("layers=all lr=0.001 epochs=")
    assert found["validation/overall/accuracy"] >= found["validation_before/overall/accuracy"]
    assert found["same/overall/accuracy"] > found["before/overall/accuracy"]
    assert f"{100 * found['same/overall/accuracy']:.1f}" in said
    assert "chosen: layers=all lr=0.001" in said
    run(folder, "evaluate", f"run={made}", TEST)  # its skin is simulated: it does not need the file
    run(folder, "adapt", f"run={parent}", *RECORDED, *QUICK)
    assert "same/overall/accuracy" not in metrics(folder, runs(folder)[-1])
    assert "validation/overall/accuracy" in metrics(folder, runs(folder)[-1])


@pytest.mark.slow("trains and adapts a run")
def test_the_same_adaptation_is_not_repeated(run, folder, adapted):
    parent, made, _ = adapted
    before = runs(folder)
    done = run(folder, "adapt", f"run={parent}", *RECORDED, "adapt.gestures=48", *QUICK)
    assert f"run {made} did this before" in done.stderr
    assert runs(folder) == before


@pytest.mark.slow("trains and adapts a run")
def test_what_is_not_better_keeps_the_weights(run, folder, adapted):
    parent = adapted[0]
    line = ["adapt.gestures=16", *QUICK, "adapt.lr=[1000]", "adapt.epochs=2"]
    done = run(folder, "adapt", f"run={parent}", *RECORDED, *line)
    assert f"the new run keeps the weights of run {parent}" in " ".join(done.stdout.split())
    found = metrics(folder, runs(folder)[-1])
    assert found["same/overall/accuracy"] == found["before/overall/accuracy"]
    assert found["validation/overall/accuracy"] == found["validation_before/overall/accuracy"]


@pytest.mark.slow("trains and adapts a run")
def test_a_learner_from_scratch_is_kept_where_it_is_better(run, folder, adapted, session):
    """The readings of the other skin are reversed: what the network knows does not help there."""
    known = read_recording(session)[:60]
    turned = replace(known, touches=replace(known.touches, readings=-known.touches.readings))
    write_recording(turned, folder / "turned.parquet")
    there = ["device=recording", "device.path=turned.parquet"]
    words = [*there, *QUICK, "adapt.epochs=1", "adapt.scratch=[extra_trees]"]
    done = run(folder, "adapt", f"run={adapted[0]}", *words)
    made = runs(folder)[-1]
    assert tags(folder, made)["chosen"] == "extra_trees, from scratch"
    assert "chosen: extra_trees, from scratch" in done.stdout
    found = metrics(folder, made)
    assert found["validation/overall/accuracy"] > found["validation_before/overall/accuracy"]
    run(folder, "evaluate", f"run={made}", *there, "device.test=all")
    assert metrics(folder, runs(folder)[-1])["same/overall/accuracy"] > 0.95


@pytest.fixture(scope="module")
def rules(run, folder, session):
    run(folder, "train", "experiment=rules", *SKIN, *SMALL, TEST, "data.gestures=80")
    return runs(folder)[-1]


@pytest.mark.parametrize(
    ("row", "given", "reason"),
    [
        ("rules", RECORDED, "Rules has no network to fine-tune"),
        (None, [], "is adapted to gestures of one skin: add device=recording"),
        (None, ["adapt.scratch=[rules]"], "must be 'kernel_ridge' or 'extra_trees'"),
        (None, ["learner.dropout=0.5"], "learner.dropout was fixed when the run was trained"),
    ],
)
@pytest.mark.slow("trains and adapts a run")
def test_bad_input_ends_with_2_and_one_sentence(run, folder, adapted, rules, row, given, reason):
    before = query(folder, "select count(*) from runs")
    done = run(folder, "adapt", f"run={rules if row else adapted[0]}", *given, *SMALL, code=2)
    assert reason in done.stderr
    assert query(folder, "select count(*) from runs") == before

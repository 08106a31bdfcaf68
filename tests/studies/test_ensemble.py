"""Together: the mean of probabilities, the share of votes, and how often members are not of one mind."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from rich.console import Console

from skin.config import checked, fingerprint
from skin.console import quiet
from skin.errors import InputError
from skin.labels import TOUCH, Task
from skin.run import train
from skin.tracking import Store
from studies import ensemble
from studies.ensemble import average, combine, disagreement, show, vote

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = (
    "simulator=naive",
    "data.gestures=160",
    "device.test_gestures=96",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
    "evaluation.gestures=48",
)
ROWS = ("rules", "linked_graph", "temporal_graph")
TWO = Task(("one", "two"))
# two members that differ on the first label of the second touch
CHANCES = torch.tensor([[[0.9, 0.2], [0.6, 0.8]], [[0.7, 0.4], [0.1, 0.6]]])


def test_average_is_the_mean_of_probabilities():
    assert average(CHANCES, TWO).tolist() == [pytest.approx([0.8, 0.3]), pytest.approx([0.35, 0.7])]


def test_vote_is_the_share_of_members_and_a_tie_is_a_no():
    voted = vote(CHANCES, TWO)
    assert voted.tolist() == [[1, 0], [0.5, 1]]
    assert (voted > 0.5).tolist() == [[True, False], [False, True]]


def test_members_of_an_exclusive_task_have_one_vote_each():
    chances = torch.tensor([[[0.4, 0.35, 0.25]], [[0.1, 0.2, 0.7]], [[0.45, 0.5, 0.05]], [[0.1, 0.6, 0.3]]])
    assert vote(chances, Task(("a", "b", "c"), "exclusive")).tolist() == [[0.25, 0.5, 0.25]]


def test_disagreement_counts_touches_without_unanimity():
    assert disagreement(CHANCES, TWO) == {"one": 0.5, "two": 0.0, "any": 0.5}


@pytest.fixture(scope="module")
def trained(configured, tmp_path_factory):
    """A function that composes, a store with two finished rows, and its three configurations of members."""
    folder = tmp_path_factory.mktemp("ensemble")
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]

    def compose(*overrides):
        return checked(configured(*SMALL, *own, *overrides))

    quiet()
    members = [compose(f"experiment={row}", "trainer.max_epochs=1") for row in ROWS]
    for config in members[:2]:
        train(config)
    return compose, Store.open(members[0].tracking), members


@pytest.fixture(scope="module")
def combined(trained):
    compose, store, members = trained
    ways = {way: compose(f"row={way}") for way in ensemble.WAYS}
    return ways, combine(store, members, ways), store.find("FINISHED")


def predictions(store, folder, config):
    """Return probabilities (B, L) and truth (B, L) as a run logged them."""
    (run,) = store.find("FINISHED", fingerprint=fingerprint(config))
    target = folder / config.row
    target.mkdir()
    path = store.client.download_artifacts(run.info.run_id, "predictions.parquet", str(target))
    table = pq.read_table(path, memory_map=False)
    return tuple(
        np.stack([table[f"{prefix}{name}"].to_numpy() for name in TOUCH.names], axis=1)
        for prefix in ("p_", "")
    )


@pytest.mark.slow
def test_ensembles_say_what_their_members_logged_together(trained, combined, tmp_path):
    _, store, members = trained
    ways, outcome, _ = combined
    one, two = (predictions(store, tmp_path, config)[0] for config in members[:2])
    averaged, truth = predictions(store, tmp_path, ways["ensemble_average"])
    voted, _ = predictions(store, tmp_path, ways["ensemble_vote"])
    assert averaged == pytest.approx((one + two) / 2, abs=1e-5)
    assert voted == pytest.approx(((one > 0.5) * 0.5 + (two > 0.5) * 0.5), abs=1e-6)
    right = ((averaged > 0.5) == (truth > 0)).mean()
    assert outcome.ensembles["ensemble_average"]["same/overall/accuracy"] == pytest.approx(right)
    differ = ((one > 0.5) != (two > 0.5)).any(axis=1).mean()
    assert outcome.ensembles["ensemble_vote"]["same/any/disagreement"] == pytest.approx(differ)
    assert 0 < differ < 1
    assert set(outcome.members) == {"rules", "linked_graph"}
    assert outcome.missing == ("temporal_graph",)


@pytest.mark.slow
def test_every_column_is_tried_and_nothing_twice(trained, combined):
    _, store, members = trained
    ways, outcome, before = combined
    for metrics in outcome.ensembles.values():
        for column in ("same", "holdout", "device_shift", "unseen_layout"):
            assert f"{column}/overall/accuracy" in metrics
    again = combine(store, members, ways)
    assert again == outcome
    assert len(store.find()) == len(before)


@pytest.mark.slow
def test_a_person_reads_who_was_best_and_who_was_not_there(combined, capsys):
    outcome = combined[1]
    show(outcome, "naive, seed 0", Console(width=120))
    said = capsys.readouterr().out
    best = outcome.ensembles["ensemble_average"]["same/overall/accuracy"]
    assert f"{100 * best:.1f}" in said
    assert "best member: rules" in said
    assert "without temporal_graph: no finished run" in said


@pytest.mark.slow
def test_who_takes_no_other_layout_is_left_out_of_that_column_only(trained, monkeypatch):
    compose, store, members = trained
    build = ensemble.build_learner

    def homebound(config):
        """Refuse other layouts, which no learner of today does."""
        learner = build(config)
        answer, home = learner.probabilities, []

        def probabilities(touches):
            home.append(touches.positions)
            if not torch.equal(touches.positions, home[0]):
                raise InputError("only the layout it was trained on")
            return answer(touches)

        if config.row == "rules":
            learner.probabilities = probabilities
        return learner

    monkeypatch.setattr(ensemble, "build_learner", homebound)
    ways = {"ensemble_average": compose("row=homebound")}
    outcome = combine(store, members, ways)
    assert outcome.left_out == {"unseen_layout": "rules: only the layout it was trained on"}
    alone = outcome.members["linked_graph"]["unseen_layout/overall/accuracy"]
    found = outcome.ensembles["homebound"]
    assert found["unseen_layout/overall/accuracy"] == pytest.approx(alone)
    assert found["device_shift/overall/accuracy"] != pytest.approx(
        outcome.members["linked_graph"]["device_shift/overall/accuracy"]
    )


@pytest.mark.slow
def test_one_member_is_no_ensemble(trained):
    compose, store, members = trained
    with pytest.raises(InputError, match=r"got rules without temporal_graph: .*experiment=temporal_graph"):
        combine(store, [members[0], members[2]], {"ensemble_vote": compose("row=alone")})


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [(["--rows", "ruless"], "no row ruless"), ([], "two finished rows, got none")],
)
def test_the_command_refuses_with_one_sentence(run, tmp_path, arguments, reason):
    done = run(tmp_path, "ensemble.py", *arguments)
    assert done.returncode == 2
    assert reason in done.stderr
    assert "Traceback" not in done.stderr

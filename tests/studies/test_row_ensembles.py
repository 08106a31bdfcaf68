"""Together: the mean of probabilities, the share of votes, and how often members are not of one mind."""

import numpy as np
import pyarrow.parquet as pq
import pytest
import torch

from experiments.studies import row_ensembles
from experiments.studies.row_ensembles import average, combine, disagreement, vote
from experiments.studies.runs import newest_finished
from skin.config import fingerprint, validate_config
from skin.console import quiet
from skin.errors import InputError
from skin.labels import TOUCH, Task
from skin.run import train
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")

SMALL = (
    "simulator=naive",
    "data.gestures=160",
    "device.test_gestures=96",
    "evaluation.devices=1",
    "evaluation.layouts=1",
    "evaluation.safe_gestures=64",
)
ROWS = ("rules", "linked_graph")
COLUMNS = ("unseen_layout/overall/accuracy", "device_shift/overall/accuracy")
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
    """A function that composes, a store with two finished rows, and these with their configurations."""
    folder = tmp_path_factory.mktemp("ensemble")
    own = [f"tracking.uri=sqlite:///{folder}/m.db", f"tracking.artifacts={folder}/a"]

    def compose(*overrides):
        return validate_config(configured(*SMALL, *own, *overrides))

    quiet()
    members = [compose(f"experiment={row}", "trainer.max_epochs=1") for row in ROWS]
    for config in members:
        train(config)
    store = Store.open(members[0].tracking)
    return compose, store, {config.row: (config, newest_finished(store, config)) for config in members}


@pytest.fixture(scope="module")
def combined(trained):
    compose, store, members = trained
    ways = {way: compose(f"row={way}") for way in row_ensembles.WAYS}
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
    ways, found, _ = combined
    one, two = (predictions(store, tmp_path, config)[0] for config, _ in members.values())
    averaged, truth = predictions(store, tmp_path, ways["ensemble_average"])
    voted, _ = predictions(store, tmp_path, ways["ensemble_vote"])
    assert averaged == pytest.approx((one + two) / 2, abs=1e-5)
    assert voted == pytest.approx(((one > 0.5) * 0.5 + (two > 0.5) * 0.5), abs=1e-6)
    right = ((averaged > 0.5) == (truth > 0)).mean()
    assert found["ensemble_average"].data.metrics["same/overall/accuracy"] == pytest.approx(right)
    differ = ((one > 0.5) != (two > 0.5)).any(axis=1).mean()
    assert found["ensemble_vote"].data.metrics["same/any/disagreement"] == pytest.approx(differ)
    assert 0 < differ < 1


@pytest.mark.slow
def test_every_column_is_tried_and_nothing_twice(trained, combined):
    _, store, members = trained
    ways, found, before = combined
    for run in found.values():
        for column in ("same", "holdout", "device_shift", "unseen_layout"):
            assert f"{column}/overall/accuracy" in run.data.metrics
    again = combine(store, members, ways)
    assert {way: run.info.run_id for way, run in again.items()} == {
        way: run.info.run_id for way, run in found.items()
    }
    assert len(store.find()) == len(before)


@pytest.mark.slow
def test_who_takes_no_other_layout_is_left_out_of_that_column_only(trained, monkeypatch):
    compose, store, members = trained
    build = row_ensembles.build_learner

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

    monkeypatch.setattr(row_ensembles, "build_learner", homebound)
    ways = {"ensemble_average": compose("row=homebound")}
    run = combine(store, members, ways)["ensemble_average"]
    assert run.data.tags["left_out_unseen_layout"] == "rules: only the layout it was trained on"
    alone, found = members["linked_graph"][1].data.metrics, run.data.metrics
    same = [found[name] == pytest.approx(alone[name]) for name in COLUMNS]
    assert same == [True, False]


@pytest.mark.slow
def test_one_member_is_no_ensemble(trained):
    compose, store, members = trained
    with pytest.raises(InputError, match="two finished runs, got rules"):
        combine(store, {"rules": members["rules"]}, {"ensemble_vote": compose("row=alone")})

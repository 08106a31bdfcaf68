"""A run counts as finished only with all its results."""

import re

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

import skin.runs.train
from skin.core.files import CONF, ROOT
from skin.errors import InputError
from skin.runs.configuration import name_run, relevant_overrides, settings_of, tags, validate_config
from skin.runs.store import Store

SMALL = (
    "experiment=linked_graph", "simulator=naive", "data.gestures=64", "trainer.max_epochs=1",
    "device.test_gestures=32", "evaluation.devices=1", "evaluation.layouts=1", "evaluation.safe_gestures=64",
)  # fmt: skip


@pytest.fixture
def config(configured, tmp_path):
    return configured(*SMALL, f"tracking.uri=sqlite:///{tmp_path}/m.db", f"tracking.artifacts={tmp_path}/a")


def name_of(*changes):
    with initialize_config_dir(str(CONF), version_base="1.3"):
        composed = compose("train", list(changes), return_hydra_config=True)
        HydraConfig.instance().set_config(composed)
        own = validate_config(OmegaConf.masked_copy(composed, [key for key in composed if key != "hydra"]))
        try:
            return name_run(tags(own), relevant_overrides(own.learner))
        finally:
            HydraConfig.instance().cfg = None


def test_runs_of_other_settings_have_other_names():
    assert name_of("experiment=rules", "seed=2") == "rules fem seed 2"
    assert name_of("data.gestures=64", "simulator=naive").endswith("naive gestures=64 seed 0")
    many = [f"+touch.setting_{number}={number}.123456" for number in range(10)]
    names = {name_of(*many, f"data.gestures={count}") for count in (64, 65)}
    assert len(names) == 2
    assert max(map(len, names)) == 80
    # Of one variant, the names differ in the seed alone.
    same = {name_of(*many, f"seed={seed}").removesuffix(f" seed {seed}") for seed in (3, 4)}
    assert len(same) == 1


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ("model=cnn", {"optimizer.lr": "0.001", "model.channels": "[8, 16]", "learner.dropout": "0.0"}),
        ("experiment=features", {"learner.rounds": "500", "learner.learning_rate": "0.1"}),
    ],
)
def test_settings_are_parameters_at_their_defaults(chosen, expected, configured, tmp_path, opened):
    store = opened(tmp_path)
    config = configured(chosen, "tracking.uri=http://me:geheim@h")
    with store.run("x", {}) as run:
        skin.runs.train.log_configuration(store, run.info.run_id, settings_of(config), "")
    params = store.client.get_run(run.info.run_id).data.params
    expected |= {"data.batch_size": "64", "data.gestures": "4038", "seed": "0", "simulator": "fem"}
    assert expected.items() <= params.items()
    assert ("optimizer.lr" in params) == (chosen == "model=cnn")
    assert not [name for name in params if name.split(".")[1:2] == ["model"] or "_target_" in name]
    (text,) = (path.read_text() for path in tmp_path.rglob("config.yaml"))
    assert "http://me:***@h" in text
    assert "geheim" not in text


@pytest.mark.parametrize("objective", ["same/overall/accuracy", "best_val_acuracy"])
def test_an_objective_that_is_no_metric_of_the_validation_is_refused(objective, configured, tmp_path):
    """Before anything is trained; the gestures of the test must not choose settings."""
    given = ["experiment=rules", *SMALL[1:3], f"tracking.uri=sqlite:///{tmp_path}/m.db"]
    config = configured(*given, f"tracking.objective={objective}")
    match = rf"^tracking.objective={objective} is not a metric .* best_val_ece_big, "
    with pytest.raises(InputError, match=match):
        skin.runs.train.train(config)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow("trains a network")
def test_a_run_stays_open_until_its_results_are_logged(config, monkeypatch):
    seen = []
    evaluate = skin.runs.train.evaluate

    def looking(*arguments):
        # What a kill would leave behind between training and evaluation.
        seen.extend(run.info.status for run in Store.open(config.tracking).find())
        return evaluate(*arguments)

    monkeypatch.setattr(skin.runs.train, "evaluate", looking)
    objective = skin.runs.train.train(config)
    assert seen == ["RUNNING"]
    (run,) = Store.open(config.tracking).find("FINISHED")
    assert run.data.metrics["parameters"] == 196
    choices = {group: run.data.params[group] for group in ("representation", "model", "fusion", "learner")}
    assert choices == {"representation": "graph", "model": "gcn", "fusion": "linked", "learner": "network"}
    assert {"same/overall/accuracy", "train_loss", "val_loss", "seconds_per_epoch"} <= set(run.data.metrics)
    assert type(objective) is float
    # Of the weights that are kept, not of the last epoch; here there is one.
    assert objective == run.data.metrics["best_val_accuracy"]
    assert objective == pytest.approx(run.data.metrics["val_accuracy"], abs=1e-6)
    config.tracking.objective = "best_val_ece_big"
    reused = skin.runs.train.train(config)
    assert reused == run.data.metrics["best_val_ece_big"]
    page = (ROOT / "docs" / "runs.md").read_text()
    for name in run.data.metrics:
        # train_accuracy_press is told of as train_accuracy
        parts = name.split("/") if f"`{name}`" not in page else [name]
        parts = [re.sub("(_accuracy|_ece)_[a-z]+$", r"\1", part) for part in parts]
        assert all(f"`{part}`" in page for part in parts), name


def logged(store):
    """Return (name, status, losses of validation by epoch) of every run that is no sweep, oldest first."""
    runs = [run.info for run in store.find()[::-1] if "sweep" not in run.data.tags]
    histories = (store.client.get_metric_history(run.run_id, "val_loss") for run in runs)
    losses = [[each.value for each in history] for history in histories]
    return [(run.run_name, run.status, values) for run, values in zip(runs, losses, strict=True)]


@pytest.mark.slow("trains in two processes that import anew")
def test_two_processes_make_one_run(run, tmp_path, opened):
    """The second one, which Lightning starts as the command again, neither logs nor prints."""
    given = [*SMALL, "data.gestures=80", "trainer.max_epochs=2"]  # 64 to train on: two equal parts
    two = ["trainer.devices=2", "trainer.strategy=ddp", "trainer.accelerator=cpu"]
    done = run(tmp_path, "train", *given, *two, apart=True)
    ((name, status, losses),) = logged(opened(tmp_path))
    assert status == "FINISHED"
    assert "strategy" not in name  # names tell what results depend on
    assert done.stdout.count("overall/accuracy") == 1
    assert "GLOBAL_RANK" not in done.stderr
    alone = run(tmp_path, "train", *given)
    assert "did this before" in alone.stderr
    alone = run(tmp_path, "train", *given, "tracking.resume=false")
    assert losses == pytest.approx(logged(opened(tmp_path))[1][2], rel=1e-5)
    assert len(losses) == 2


@pytest.mark.slow("starts processes that import anew")
@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["trainer.strategy=ddp_fork"], "give trainer.strategy=ddp or ddp_spawn"),
        (["-m", "trainer.strategy=ddp"], "add trainer.strategy=ddp_spawn"),
    ],
)
def test_processes_that_cannot_train_together_are_refused(run, tmp_path, opened, given, said):
    words = [*given, *SMALL, "trainer.devices=2", f"hydra.sweep.dir={tmp_path}/out"]
    done = run(tmp_path, "train", *words, apart=True, code=None)
    assert done.returncode in (1, 2)
    assert said in done.stderr
    assert "Traceback" not in done.stderr
    assert not logged(opened(tmp_path))

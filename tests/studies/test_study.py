"""A study's verdicts follow from intervals, and every statement is about variants that some sweep trains."""

import math

import pytest
from omegaconf import OmegaConf
from scipy.stats import ttest_rel

from skin.config import CONF, checked, fingerprint
from skin.errors import InputError
from skin.sweep import jobs
from studies.study import Paired, choose, conclude, paired, read, verdict

STUDIES = read()
STATEMENTS = [(study, said) for study in STUDIES.values() for said in study.statements]
SWEEPS = sorted({sweep for study in STUDIES.values() for sweep in study.sweeps})
LABELS = ("overall", "big", "dynamic", "press", "dangerous")


def chosen(sweep):
    """Return what each job of a sweep chooses."""
    return jobs([], OmegaConf.load(CONF / "sweep" / f"{sweep}.yaml").hydra.sweeper.params)


def test_a_paired_difference_is_that_of_the_paired_t_test():
    one, other = {"0": 71.0, "1": 74.5, "2": 70.2, "3": 79.0}, {"0": 70.0, "1": 71.0, "2": 70.4, "3": 75.0}
    found = paired(one, other)
    assert found.mean / found.error == pytest.approx(ttest_rel([*one.values()], [*other.values()]).statistic)
    assert (found.mean, found.seeds) == (pytest.approx(2.075), 4)


def test_only_common_seeds_count():
    found = paired({"0": 3.0, "1": 5.0, "7": 99.0}, {"1": 4.0, "0": 1.0, "8": 0.0})
    # differences 2 and 1: mean 1.5, deviation 1 / sqrt 2, by sqrt 2
    assert found == Paired(1.5, pytest.approx(0.5), 2)


def test_a_ratio_is_taken_seed_by_seed():
    found = paired({"0": 8.0, "1": 30.0}, {"0": 2.0, "1": 5.0}, ratio=True)
    assert found == Paired(5.0, pytest.approx(1.0), 2)


def test_one_seed_has_no_known_error_and_none_no_difference():
    assert paired({"0": 2.0}, {"0": 1.0}) == Paired(1.0, math.inf, 1)
    assert paired({"0": 2.0}, {"1": 1.0}) is None


@pytest.mark.parametrize(
    ("claim", "by", "mean", "error", "said"),
    [
        ("greater", 0, 2.1, 1.0, "agree"),
        ("greater", 0, 1.9, 1.0, "undecided"),
        ("greater", 0, -1.9, 1.0, "undecided"),
        ("greater", 0, -2.1, 1.0, "disagree"),
        ("less", 0, -2.1, 1.0, "agree"),
        ("less", 0, 2.1, 1.0, "disagree"),
        ("alike", 2, 0.9, 0.5, "agree"),
        ("alike", 2, 1.1, 0.5, "undecided"),
        ("alike", 2, -3.1, 0.5, "disagree"),
        ("no better", 1, -9.0, 1.0, "agree"),
        ("no better", 1, 0.5, 0.2, "agree"),
        ("no better", 1, 0.5, 0.3, "undecided"),
        ("no better", 1, 1.5, 0.2, "disagree"),
        ("about", 3, 2.0, 0.2, "agree"),
        ("about", 3, 7.0, 0.2, "disagree"),
        ("ratio", 10, 12.0, 1.0, "agree"),
        ("ratio", 10, 5.5, 0.5, "undecided"),
        ("ratio", 10, 4.0, 0.2, "disagree"),
        ("ratio", 10, 21.0, 0.2, "disagree"),
    ],
)
def test_a_verdict_needs_two_standard_errors_of_room(claim, by, mean, error, said):
    assert verdict(claim, Paired(mean, error, 3), by) == said


def test_two_seeds_decide_nothing():
    assert verdict("greater", Paired(50.0, 0.1, 2)) == "undecided"
    assert verdict("greater", None) == "undecided"


@pytest.mark.parametrize(
    ("each", "whole"),
    [
        (["agree", "agree"], "agree"),
        (["agree", "undecided"], "undecided"),
        (["agree", "disagree"], "disagree"),
        ([], "undecided"),
    ],
)
def test_a_statement_about_several_holds_against_each(each, whole):
    assert conclude(each) == whole


def test_all_leaves_out_the_costly():
    assert {study.name for study in choose(STUDIES, ["all"])} == {
        name for name, study in STUDIES.items() if not study.costly
    }
    assert [study.name for study in choose(STUDIES, ["norm", "efficientnet"])] == ["norm", "efficientnet"]


@pytest.mark.parametrize("names", [[], ["pooling"]])
def test_a_study_that_is_not_there_is_refused(names):
    with pytest.raises(InputError, match="graph_pooling"):
        choose(STUDIES, names)


def test_statements_have_their_own_names():
    names = [said.id for _, said in STATEMENTS]
    assert len(names) == len(set(names))


@pytest.mark.parametrize(("study", "said"), STATEMENTS, ids=[said.id for _, said in STATEMENTS])
def test_a_statement_is_about_one_variant_and_others(study, said):
    known = [job for sweep in study.sweeps for job in chosen(sweep)]
    picked = [[job for job in known if one.items() <= job.items()] for one in (said.one, *said.others)]
    assert [len(jobs) for jobs in picked] == [1] * len(picked)
    assert len({str(jobs) for jobs in picked}) == len(picked)
    assert bool(said.others) != (said.level is not None)
    assert verdict(said.claim, Paired(0.0, 1e9, 3), said.by) == "undecided"
    assert (said.by > 0) == (said.claim not in ("greater", "less"))


@pytest.mark.parametrize(("study", "said"), STATEMENTS, ids=[said.id for _, said in STATEMENTS])
def test_a_statement_is_about_a_metric_that_runs_log(study, said):
    logged = {f"same/{label}/{kind}" for label in LABELS for kind in ("accuracy", "balanced_accuracy")}
    assert set(said.metric.split(" - ")) <= logged | {"train_accuracy", "seconds_per_epoch", "parameters"}


@pytest.mark.parametrize("sweep", SWEEPS)
def test_every_sweep_composes_and_states_its_budget(configured, sweep):
    job = chosen(sweep)[-1]
    config = checked(configured(f"sweep={sweep}", *(f"{key}={value}" for key, value in job.items())))
    whole = sweep == "late_early"
    # Hydra lays settings of the command line over this one too, so it must be of the same row.
    assert whole or configured(f"sweep={sweep}").row == config.row
    assert config.tracking.experiment == ("skin" if whole else "studies")
    assert (config.evaluation.devices, config.evaluation.layouts) == ((5, 5) if whole else (0, 0))
    assert config.trainer.max_epochs < config.epochs["fem"] or whole or config.row == "sensor_transformer"


def test_studies_share_the_runs_that_they_have_in_common(configured):
    graph = "experiment=temporal_graph"
    same = [
        configured("sweep=temporal_pooling", graph, "model.pooling=max"),
        configured("sweep=temporal_width", graph, "model.widths=[30,500]"),
        configured("sweep=activation", graph, "model.activation=silu"),
        configured("sweep=edge_weight", graph, "representation.weight=exp"),
    ]
    assert len({fingerprint(config) for config in same}) == 1


def test_late_against_early_takes_the_runs_of_the_table(configured):
    row = ("experiment=sequence_image", "simulator=naive", "seed=2")
    assert fingerprint(configured("sweep=late_early", *row)) == fingerprint(configured("sweep=table", *row))


def test_the_activation_is_that_of_all_hidden_layers(configured):
    config = configured("sweep=activation", "experiment=temporal_graph", "model.activation=elu")
    assert config.learner.activation == "elu"


def test_variants_are_called_what_tells_them_apart():
    variants = STUDIES["image_representation"].variants(["seed=0,1"])
    assert [variant.name for variant in variants][:3] == [
        "representation=image",
        "representation=fourier",
        "representation=interp method=nearest",
    ]
    assert {tuple(variant.configs) for variant in variants} == {("0", "1")}


def test_another_setting_has_one_value():
    with pytest.raises(InputError, match="one value"):
        STUDIES["activation"].variants(["seed=0", "device.noise=0,0.1"])

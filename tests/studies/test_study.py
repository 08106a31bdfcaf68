"""Studies compose, and every statement is about variants, or conditions, that its study has."""

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from experiments import peers
from experiments.studies.comparison import Paired, verdict
from experiments.studies.study import Study, variants
from skin.config import fingerprint, validate_config
from skin.errors import InputError
from skin.paths import CONF

NAMES = sorted(path.stem for path in (CONF / "study").glob("*.yaml"))
LABELS = ("overall", "big", "dynamic", "press", "dangerous")
KINDS = ("accuracy", "balanced_accuracy", "ece", "alarm_recall", "false_alarm_rate", "degrees")
SENSORS = "study=sensors_other", "study.seeds=[0]"
SHARES = ("0-0.2", "0.2-0.4", "0.4-0.6", "0.6-0.8", "0.8-1", "whole")
STREAMS = {f"share/{share}/overall/accuracy" for share in SHARES} | {
    f"gate/{gate}/accuracy" for gate in ("threshold", "learned")
}
OTHER = {"train_accuracy", "seconds_per_epoch", "parameters", "self_share", "same/any/disagreement"} | STREAMS


@pytest.fixture(scope="module")
def composed():
    """Return a function from overrides to a study and its variants, as the command has them."""
    made = {}

    def make(*words):
        if words not in made:
            with initialize_config_dir(str(CONF), version_base="1.3"):
                config = compose("study", list(words), return_hydra_config=True)
                HydraConfig.instance().set_config(config)
                own = OmegaConf.masked_copy(config, [key for key in config if key != "hydra"])
                study = Study.of(validate_config(own))
                made[words] = study, variants(study)
        return made[words]

    return make


@pytest.mark.parametrize("name", NAMES)
def test_a_study_composes_and_says_what_it_is_about(composed, name):
    study, every = composed(f"study={name}", "study.seeds=[0]")
    assert study.about
    assert bool(study.trainings) or study.rows is not None or study.measure is not None
    assert len({one.name for one in every}) == len(every)
    prints = [fingerprint(one.configs["0"]) for one in every]
    assert len(set(prints)) == len(every)
    if study.differences is None and study.trainings:
        assert study.statements or study.conditions
    known = {f"{column}/{label}/{kind}" for column in ("same", "holdout", "device_shift", "unseen_layout")
             for label in (*LABELS, "direction") for kind in (*KINDS, "error")}  # fmt: skip
    known |= OTHER | {"same/direction/degrees"} | {f"train_accuracy_{label}" for label in LABELS}
    assert set(study.metrics) <= known or study.measure is not None  # which may have metrics of its own
    for said in study.statements:
        assert set(said.metric.split(" - ")) <= known
        assert verdict(said.claim, Paired(0.0, 1e9, 4e9, 3), said.by) == "undecided"
        assert said.by > 0 or said.claim in ("greater", "less")
        assert bool(said.others) != (said.level is not None)
        lines = [
            one.chosen | {"condition": condition} for one in every for condition in study.conditions or ("",)
        ]
        lines += [{"row": way} for way in study.ensembles]
        if not study.trainings:  # finished runs of any row
            rows = [path.stem for path in (CONF / "experiment").glob("*.yaml")] + peers.ROWS
            lines = [{"row": row, "condition": condition} for row in rows for condition in study.conditions]
        picked = [[line for line in lines if one.items() <= line.items()] for one in (said.one, *said.others)]
        assert [len(each) for each in picked] == [1] * len(picked), said.id
        assert len({str(each) for each in picked}) == len(picked)


def test_statements_have_their_own_names(composed):
    names = [said.id for name in NAMES for said in composed(f"study={name}", "study.seeds=[0]")[0].statements]
    assert len(names) == len(set(names))


def test_studies_share_the_runs_that_they_have_in_common(composed):
    picked = {
        "graph_pooling": "temporal_graph pooling=max",
        "embedding_width": "temporal_graph widths=[30,500]",
        "activation": "activation=silu",
        "edge_weight": "weight=exp",
    }
    prints = set()
    for study, name in picked.items():
        _, every = composed(f"study={study}", "study.seeds=[0]")
        prints |= {fingerprint(one.configs["0"]) for one in every if one.name == name}
    assert len(prints) == 1


def test_variants_are_named_by_what_tells_them_apart(composed):
    _, every = composed("study=image_representation", "study.seeds=[0,1]")
    assert [one.name for one in every][1:3] == [
        "sequence_image representation=fourier",
        "interp method=nearest",
    ]
    assert {tuple(one.configs) for one in every} == {("0", "1")}
    _, every = composed("study=crosscheck", "study.seeds=[0]", "study.rows=[features,gru]")
    assert [one.name for one in every][:3] == ["naive features", "naive gru", "fem, equation 10 features"]


def test_settings_of_the_command_line_hold_for_every_variant(composed):
    _, every = composed("study=norm", "study.seeds=[0]", "device.noise=0.2", "trainer.max_epochs=3")
    for one in every:
        config = one.configs["0"]
        assert (config.device.noise, config.trainer.max_epochs) == (0.2, 3)
        assert (config.evaluation.devices, config.tracking.experiment) == (0, "studies")


def test_settings_of_a_variant_hold_instead_of_the_common_ones(composed):
    simulators = {one.name: one.configs["0"].simulator for one in composed(*SENSORS)[1]}
    assert simulators["fem grid 9"]._target_ != simulators["arm grid 9"]._target_
    given = composed(*SENSORS, "simulator=naive")[1]
    assert len({one.configs["0"].simulator._target_ for one in given}) == 1


def test_one_row_is_a_list_of_one(composed):
    """As text, best_fresh would contain best."""
    assert composed("study=dead", "study.rows=best_fresh")[0].rows == ["best_fresh"]
    assert composed("study=dead")[0].rows == "all"


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "which study.*norm"),
        (("study=norm", "study.seeds=[]"), "study.seeds"),
        (("study=norm", "study.seeds=[-1]"), "study.seeds"),
        (("study=dead", "study.devices=-1"), "study.devices=-1"),
        (("study=margins", "study.measure.gestures=0"), "study.measure.gestures=0"),
        (("study=holds", "study.measure.rate=0"), "study.measure.rate=0"),
        (("study=streams", "study.measure.hours=0"), "hours=0"),
        (("study=embeddings", "study.measure.train=1"), "study.measure.train=1"),
        (("study=embeddings", "study.measure.attributes=[colour]"), "study.measure.attributes"),
        (("study=embeddings", "study.measure.seeds=[]"), "study.measure.seeds"),
        (("study=holds", "+study.measure.rates=0"), "did you mean rate"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(composed, words, said):
    with pytest.raises(InputError, match=said):
        composed(*words)

"""Studies compose, and every statement is about variants, or conditions, that its study has."""

from contextlib import contextmanager

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from experiments import peers
from experiments.studies.comparison import Estimate, judge
from experiments.studies.pages import read_reference
from experiments.studies.study import chosen_studies, variants
from skin.core.files import CONF
from skin.errors import InputError
from skin.runs.configuration import fingerprint
from tests.budget import free

FILES = {path.stem: OmegaConf.load(path) for path in sorted((CONF / "study").glob("*.yaml"))}
NAMES = [(name, part) for name, file in FILES.items() for part in file.get("parts", {"": {}})]
LABELS = ("overall", "big", "dynamic", "press", "dangerous")
KINDS = ("accuracy", "balanced_accuracy", "ece", "alarm_recall", "false_alarm_rate", "degrees")
SENSORS = "study=sensors", "study.part=sensors_other", "study.seeds=[0]"
SHARES = ("0-0.2", "0.2-0.4", "0.4-0.6", "0.6-0.8", "0.8-1", "whole")
KNOWN = {
    *(f"{column}/{label}/{kind}" for column in ("same", "holdout", "device_shift", "unseen_layout")
      for label in (*LABELS, "direction") for kind in KINDS),
    *(f"share/{fraction}/overall/accuracy" for fraction in SHARES),
    *(f"train_accuracy_{label}" for label in LABELS), "gate/threshold/accuracy", "gate/learned/accuracy",
    "train_accuracy", "seconds_per_epoch", "parameters", "same/any/disagreement", "same/place/rms_mm",
    "same/force/rms_N", "same/overall/r2",
}  # fmt: skip


@pytest.fixture(scope="module")
def composed():
    """Return a function from overrides to the last chosen study and its variants, as the command has them."""
    made = {}

    def make(*words):
        if words not in made:
            with free(), composing(*words) as study:
                made[words] = study, variants(study)
        return made[words]

    return make


@contextmanager
def composing(*words):
    """Give the last chosen study; meanwhile its variants can be composed, which takes a second."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("study", list(words), return_hydra_config=True)
        HydraConfig.instance().set_config(config)
        *_, study = chosen_studies(OmegaConf.to_container(config.study, resolve=True))
        yield study


def chosen(*words):
    with composing(*words) as study:
        return study


def words(name, part):
    return [f"study={name}", *([f"study.part={part}"] if part else []), "study.seeds=[0]"]


@pytest.mark.parametrize(("name", "part"), NAMES)
def test_a_study_composes_and_says_what_it_is_about(composed, name, part):
    study, every = composed(*words(name, part))
    assert study.name == part or name
    assert study.about
    assert study.trainings or study.rows or study.run or study.measure
    assert len({one.name for one in every}) == len(every)
    prints = [fingerprint(one.configs["0"]) for one in every]
    assert len(set(prints)) == len(every)
    if study.differences is None and study.trainings:
        assert study.statements or study.conditions or study.reference or study.name == "real"
    assert set(study.metrics) <= KNOWN or study.measure is not None  # which may have metrics of its own
    for said in study.statements:
        assert set(said.metric.split(" - ")) <= KNOWN
        assert judge(said, Estimate(0.0, 1e9, 4e9, 3)) == "undecided"
        assert said.minimum < said.maximum
        assert bool(said.others) != (said.level is not None)
        conditions = study.conditions or ("",)
        lines = [one.chosen | {"condition": condition} for one in every for condition in conditions]
        lines += [{"name": "vote"}] if study.vote else []
        if not study.trainings:  # finished runs of any row
            rows = [path.stem for path in (CONF / "experiment").glob("*.yaml")] + peers.ROWS
            lines = [{"row": row, "condition": condition} for row in rows for condition in study.conditions]
        picked = [[line for line in lines if one.items() <= line.items()] for one in (said.one, *said.others)]
        assert [len(each) for each in picked] == [1] * len(picked), said.id
        assert len({str(each) for each in picked}) == len(picked)


def test_variants_are_named_by_what_tells_them_apart(composed):
    _, every = composed("study=models", "study.part=image_representation", "study.seeds=[0,1]")
    names = [one.name for one in every][1:3]
    assert names == ["sequence_image representation=fourier", "interp method=nearest"]
    assert {tuple(one.configs) for one in every} == {("0", "1")}
    _, every = composed(*words("mechanics", "crosscheck"), "study.rows=[features,gru]")
    assert [one.name for one in every][:3] == ["naive features", "naive gru", "fem, equation 10 features"]


def test_settings_of_the_command_line_hold_for_every_variant(composed):
    _, every = composed(*words("models", "norm"), "device.noise=0.2", "trainer.max_epochs=3")
    for one in every:
        config = one.configs["0"]
        assert (config.device["noise"], config.trainer["max_epochs"]) == (0.2, 3)
        assert (config.evaluation.devices, config.tracking.experiment) == (0, "studies")


def test_settings_of_a_variant_hold_instead_of_the_common_ones(composed):
    simulators = {one.name: one.configs["0"].simulator for one in composed(*SENSORS)[1]}
    assert simulators["fem grid 9"]["_target_"] != simulators["arm grid 9"]["_target_"]
    two = "study.trainings=[{name: fem grid 9, simulator: fem}, {name: arm grid 9, body: arm}]"
    given = composed(*SENSORS, two, "simulator=naive")[1]
    assert len(given) == 2
    assert len({one.configs["0"].simulator["_target_"] for one in given}) == 1


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "which study.*models"),
        (("study=models", "study.part=norms"), "study.part=norms is none of the parts of study=models.*norm"),
        (("study=margins", "study.part=norm"), "none of the parts of study=margins: none"),
        (("study=models", "study.name=x"), "study.name=x names one part"),
        (("study=table", "study.jobs=0"), "study.jobs=0"),
        (("study=models", "study.seeds=[]"), "study.seeds"),
        (("study=robustness", "study.part=layouts", "study.seeds=[-1]"), "study.seeds"),
        (("study=robustness", "study.part=dead", "study.devices=-1"), "study.devices=-1"),
        (("study=embeddings", "study.measure.attributes=[colour]"), "study.measure.attributes"),
        (("study=holds", "+study.measure.rates=0"), "did you mean rate"),
    ],
)
def test_settings_that_cannot_be_used_are_refused_by_name(composed, words, said):
    with pytest.raises(InputError, match=said):
        composed(*words)


def test_the_command_line_counts_for_every_part():
    """Also where the part has the setting itself."""
    study = chosen("study=robustness", "study.devices=2", "+study.test.rate=3")
    assert (study.name, study.devices, study.test["rate"]) == ("touch_alarms", 2, 3)
    study = chosen(*words("robustness", "dead"), "study.devices=2", "+study.test.device=simulated")
    assert (study.devices, study.test["device"], study.test["device.test_gestures"]) == (2, "simulated", 800)
    study = chosen("study=streams", "study.part=streams_trained", "study.measure.windows=[3.0]")
    assert (study.rows, study.measure.windows) == (["features"], (3.0,))


def test_the_table_has_the_rows_of_its_sweep_and_those_of_other_commands(composed):
    """All rows, and on the simulators that are chosen."""
    _, every = composed(*words("table", ""), "study.trainings.0.simulator=[solid]")
    assert {one.chosen["simulator"] for one in every} == {"solid"}
    rows = {path.stem for path in (CONF / "experiment").glob("*.yaml")} | {*peers.ROWS}
    assert {one.chosen["experiment"] for one in every} == rows
    assert {one.chosen["experiment"] for one in every if one.trained} == {
        *OmegaConf.load(CONF / "sweep" / "table.yaml").hydra.sweeper.params.experiment.split(",")
    }
    _, few = composed(*words("table", ""), "study.rows=[rules,gru]")
    assert [one.name for one in few] == ["naive rules", "naive gru", "fem rules", "fem gru"]


def test_the_reports_numbers_belong_to_rows_of_the_table(composed):
    known = read_reference("data/report_table.csv")
    rows = {(one.chosen["experiment"], one.chosen["simulator"]) for one in composed(*words("table", ""))[1]}
    assert {(row, simulator) for row, simulator, _ in known} <= rows
    assert known["sequence_image", "fem", "overall"] == 0.771
    for row in ("temporal_graph", "sequence_graph", "sequence_image"):
        each = [known[row, "fem", label] for label in LABELS[1:]]
        assert known[row, "fem", "overall"] == pytest.approx(sum(each) / 4, abs=2e-3)

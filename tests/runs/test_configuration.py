"""The configuration mirrors the package, refuses what it does not know, and tells which runs are the same."""

import csv
import subprocess
from copy import deepcopy
from dataclasses import FrozenInstanceError, replace
from importlib import import_module
from inspect import isabstract, signature

import pytest
from hydra.utils import get_class
from omegaconf import OmegaConf

from skin import __version__
from skin.commands._command import command
from skin.core.files import CONF, ROOT
from skin.core.settings import GROUPS, check_targets, option_name, walk_settings
from skin.errors import InputError
from skin.evaluation.settings import check_evaluation
from skin.runs import configuration
from skin.runs.build import build_device, build_learner
from skin.runs.configuration import ADDED, fingerprint, settings_hash, settings_of, source_tags, tags

ROWS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))
OPTIONS = [(group, path.stem) for group in GROUPS for path in sorted((CONF / group).glob("*.yaml"))]
with (ROOT / "docs" / "results" / "tuning.csv").open(newline="") as file:
    TRIALS = list(csv.DictReader(file))
CHOSEN = [trial for trial in TRIALS if trial["chosen"] == "yes"]


def target(group, option):
    return OmegaConf.load(CONF / group / f"{option}.yaml")["_target_"]


def base_of(group):
    return get_class(f"{GROUPS[group]}.Abstract{group.capitalize()}")


@pytest.mark.parametrize("group", GROUPS)
def test_every_public_class_beside_an_option_is_an_option(group):
    targets = {target(group, option) for folder, option in OPTIONS if folder == group}
    modules = {import_module(name.rpartition(".")[0]) for name in targets}
    classes = {
        f"{kind.__module__}.{name}"
        for module in modules
        for name, kind in vars(module).items()
        if isinstance(kind, type) and issubclass(kind, base_of(group)) and kind.__module__ == module.__name__
        if not isabstract(kind) and not name.startswith("_")
    }
    assert classes - {"skin.body.layout.Listed"} == targets  # which is made of an object in Python


@pytest.mark.parametrize(("group", "option"), OPTIONS)
def test_an_option_composes_and_names_a_class_of_its_group(configured, group, option):
    name, kind = target(group, option), get_class(target(group, option))
    assert f"{kind.__module__}.{kind.__qualname__}" == name
    assert issubclass(kind, base_of(group))
    assert option_name(kind) == option
    assert OmegaConf.load(CONF / group / f"{option}.yaml")["_convert_"] == "all"
    settings = settings_of(configured(f"{group}={option}"))
    assert settings[group]["_target_"] == name
    check_targets(settings, "a run")  # a stored run may be built
    signature(kind, eval_str=True)


def test_a_simulator_has_data_and_groups_of_values_build_nothing():
    for path in (CONF / "simulator").glob("*.yaml"):
        assert OmegaConf.load(CONF / "data" / path.name).name == path.stem, "step 2 of CONTRIBUTING.md"
    for group in ("data", "experiment", "sweep", "touch"):
        for path in (CONF / group).glob("*.yaml"):
            paths = [path for path, _ in walk_settings(OmegaConf.to_container(OmegaConf.load(path)))]
            assert not [each for each in paths if "_target_" in each], path


@pytest.mark.parametrize("skin", ["naive", "fem", *(f"solid body={body}" for body in ("sheet", "arm"))])
@pytest.mark.parametrize("kind", [path.stem for path in sorted((CONF / "touch").glob("*.yaml"))])
def test_every_kind_of_touches_is_simulated(configured, kind, skin):
    small = ["body.cells=[12,12]", "simulator.divisions=1"] if "solid" in skin else []
    skin = [f"simulator={skin.split()[0]}", *skin.split()[1:]]
    device = build_device(configured(f"touch={kind}", *skin, *small, "data.gestures=32"))
    touches = device.recording(complete=False).touches
    assert touches.readings.isfinite().all()
    assert touches.readings.max() > 1.0
    assert (touches.contacts is None) == (kind == "gestures")


@pytest.mark.parametrize("simulator", ["naive", "fem"])
@pytest.mark.parametrize("row", ROWS)
def test_every_row_composes_and_is_built(configured, row, simulator):
    config = configured(f"experiment={row}", f"simulator={simulator}")
    build_learner(config)
    assert (config.row, config.data.name) == (row, simulator)
    assert config.trainer["max_epochs"] == config.epochs[simulator]


@pytest.mark.parametrize("trial", CHOSEN, ids=[trial["row"] for trial in CHOSEN])
def test_a_tuned_row_has_the_settings_of_the_chosen_trial(configured, trial):
    settings = [*trial["settings"].split(), f"epochs.fem={trial['epochs']}"]
    tried = settings_of(configured(f"experiment={trial['row']}", "simulator=fem", *settings))
    tuned = settings_of(configured(f"experiment={trial['row']}_tuned", "simulator=fem"))
    differ = {key for key in tried if tried[key] != tuned[key]}
    assert differ <= {"row", "epochs"}, "epochs of other data"
    assert tuned["trainer"]["max_epochs"] == int(trial["epochs"])


def test_every_tuned_row_is_the_best_of_its_trials():
    for row in {trial["row"] for trial in TRIALS}:
        trials = [trial for trial in TRIALS if trial["row"] == row]
        best = max(trials, key=lambda trial: float(trial["validation_overall"]))
        assert [trial for trial in trials if trial["chosen"] == "yes"] == [best], row


@pytest.mark.parametrize("simulator", ["naive", "fem"])
def test_the_device_carries_the_groups_that_were_chosen(configured, simulator):
    config = configured(f"simulator={simulator}", "seed=3", "layout=grid", "layout.rows=3")
    device = build_device(config)
    assert (len(device.sensors), device.data_seed, device.seed) == (15, 3, 0)
    assert device.padded == (simulator == "fem")
    assert device.gestures == {"naive": 2350, "fem": 4038}[simulator]


@pytest.mark.parametrize(
    ("override", "reason"),
    [
        ("+data.typo=1", "typo"), ("data.gestures=many", "many"), ("seed=x", "seed"),
        *((f"{name}=nan", f"^{name} is nan: give a number$") for name in (
            "device.noise", "optimizer.lr", "touch.small_area.0", "touch.thresholds.area")),
        ("tracking.threads=0", r"tracking\.threads=0 must be at least 1, or null"),
    ],
)  # fmt: skip
def test_what_does_not_fit_is_refused_by_name(configured, override, reason):
    with pytest.raises(InputError, match=reason):
        configured(override)


@pytest.mark.parametrize("word", ["simulator=naive", "device=recording", "device=serial"])
def test_a_run_is_found_by_its_simulator_or_else_its_device(configured, word):
    config = configured(word)
    assert tags(config)["simulator"] == word.split("=")[1]
    with pytest.raises(FrozenInstanceError):
        config.seed = 1


def built(word):
    def task(config):
        build_device(config)
        build_learner(config)
        check_evaluation(config.evaluation)

    task.__module__ = "skin.commands.train"  # where Hydra looks for its help
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.exit", lambda code: None)
        patch.setattr("logging.config.dictConfig", lambda *_: None)
        command("train")(task)([word, "simulator=naive", "hydra.output_subdir=null", "hydra.run.dir=."])


@pytest.mark.parametrize(
    "word",
    [
        "evaluation=null", "trainer=null", "contact._partial_=../x", "optimizer._partial_=2",
        "device.contact=''", "representation=2147483648", "layout=[[1]]", "layout=[]",
        "device.stuck=99999999999999999999999999", "device.touch=-1", "device.simulator=null",
        "model.width=1e300",
    ],
)  # fmt: skip
def test_settings_that_nobody_means_cost_one_sentence(word, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    built(word)
    message = capsys.readouterr().err
    assert len(message.splitlines()) == 1, message
    assert "Traceback" not in message


RULES = ["experiment=rules", "simulator=naive", "data.gestures=80", "device.test_gestures=48",
         "evaluation.devices=0", "evaluation.layouts=0", "evaluation.safe_gestures=48"]  # fmt: skip


@pytest.mark.parametrize(
    ("overrides", "same"),
    [
        (["tracking.uri=sqlite:///elsewhere.db", "tracking.resume=false", "tracking.threads=1"], True),
        (["trainer.devices=2", "trainer.strategy=ddp", "+trainer.num_nodes=2"], True),
        (["+trainer.enable_progress_bar=true"], True),
        *(([one], False) for one in ("seed=1", "simulator=naive", "device.noise=1", "trainer.max_epochs=3")),
    ],
)
@pytest.mark.parametrize("learner", ["network", "ensemble"])
def test_only_what_results_depend_on_changes_the_fingerprint(configured, overrides, same, learner):
    plain = f"learner={learner}"
    assert (fingerprint(configured(plain, *overrides)) == fingerprint(configured(plain))) == same


def test_a_changed_layout_file_changes_the_fingerprint(configured, tmp_path):
    path, prints = tmp_path / "sensors.csv", []
    for y in (0.05, 0.05, 0.06):
        path.write_text(f"x_m,y_m\n0.05,{y}\n")
        prints.append(fingerprint(configured(f"layout.path={path}")))
    assert prints[0] == prints[1] != prints[2]


@pytest.mark.parametrize("device", ["simulated", "skins"])
@pytest.mark.parametrize("profile", ["mild", "rough", "harsh", "calibrated", "drawn"])
def test_settings_that_came_later_make_no_other_run(configured, device, profile):
    """A run that finished before them has their values without naming them, and is found again."""
    config = configured(f"device={device}", f"profile={profile}")
    former = deepcopy(config)
    groups = [former.device, former.device.get("skins", {}), former.device["touch"], former.touch]
    missing = [{name: group.pop(name) for name in ADDED if name in group} for group in groups]
    assert set().union(*missing) >= {"scale_spread", "independent", "aligned", "framed", "second"}
    assert all(value == ADDED[name] for group in missing for name, value in group.items())
    assert fingerprint(config) == fingerprint(former)
    others = {"scale_spread": 0.1, "independent": True, "aligned": False, "framed": 0.1}
    for name, value in others.items():
        assert fingerprint(replace(former, device=former.device | {name: value})) != fingerprint(former)


def test_a_data_set_counts_by_its_manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    hashes = []
    for manifest in (None, "one", "other"):
        if manifest:
            (tmp_path / "touches").mkdir(exist_ok=True)
            (tmp_path / "touches" / "manifest.json").write_text(manifest)
        hashes.append({settings_hash({"path": path}) for path in ("touches", "./touches")})
    assert len(set.union(*hashes)) == 6


@pytest.fixture
def repository(tmp_path, monkeypatch):
    """A clone with one commit of code; returns a function that runs git in it."""

    def git(*arguments):
        identity = ["-c", "user.name=n", "-c", "user.email=e"]
        command = ["git", "-C", str(tmp_path), *identity, *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()

    git("init")
    (tmp_path / "skin").mkdir()
    (tmp_path / "skin" / "a.py").write_text("1")
    git("add", ".")
    git("commit", "-m", "code")
    monkeypatch.setattr(configuration, "ROOT", tmp_path)
    monkeypatch.setattr(configuration, "BUNDLED", tmp_path)
    monkeypatch.setattr(configuration, "_FOLDERS", ("skin",))
    return git


def tags_anew():
    source_tags.cache_clear()
    try:
        return source_tags()
    finally:
        source_tags.cache_clear()


def test_the_commit_is_the_last_one_that_changed_code(repository, tmp_path):
    code = repository("rev-parse", "HEAD")
    assert (tags_anew()["source_commit"], tags_anew()["source_dirty"]) == (code, "false")
    (tmp_path / "results.md").write_text("numbers")
    repository("add", ".")
    repository("commit", "-m", "results")
    assert (tags_anew()["source_commit"], tags_anew()["source_dirty"]) == (code, "false")
    (tmp_path / "skin" / "new.py").write_text("2")
    assert (tags_anew()["source_commit"], tags_anew()["source_dirty"]) == (code, "true")


def test_without_git_the_version_stands_for_the_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(configuration, "ROOT", tmp_path)
    monkeypatch.setattr(configuration, "BUNDLED", tmp_path)
    assert (tags_anew()["source_commit"], tags_anew()["source_dirty"]) == (__version__, "unknown")


@pytest.mark.slow("trains and evaluates again")
def test_one_warning_tells_of_reused_results_of_other_code(run, tmp_path):
    from skin.runs.configuration import Tracking
    from skin.runs.store import Store

    words = ["-m", *RULES, "seed=0,1"]
    first = run(tmp_path, "train", *words)
    assert "reused" not in first.stderr
    store = Store.open(Tracking(f"sqlite:///{tmp_path}/m.db", f"{tmp_path}/a", "skin", True, None))
    for one in store.find("FINISHED", row="rules"):
        store.client.set_tag(one.info.run_id, "source_commit", "0" * 40)
    again = run(tmp_path, "train", *words, apart=True)  # a process warns once
    assert again.stderr.count("\n") == 3
    assert again.stderr.count("results of other code are reused") == 1

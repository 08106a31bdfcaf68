"""The options that CONTRIBUTING.md shows are added from a folder of one's own, as it says."""

import os
import re

import pytest

from skin.core.files import ROOT

BLOCKS = re.findall(r"```(\w+)\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S)
FILES = {text.split("\n")[0].removeprefix("# "): text for kind, text in BLOCKS if kind in ("python", "yaml")}
COMMANDS = [line.split() for _, text in BLOCKS for line in text.splitlines() if line.startswith("skin ")]
TRAINING = [words[2:] for words in COMMANDS if words[1] == "train"]
EVALUATION = [words[2:] for words in COMMANDS if words[1] == "evaluate"]
SMALL = ["data.gestures=48", "device.test_gestures=48", "evaluation.safe_gestures=64"]
SMALL += ["evaluation.devices=0", "evaluation.layouts=0"]


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    folder = tmp_path_factory.mktemp("own")
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
        yield folder


def test_one_option_of_each_of_five_groups_is_shown():
    groups = {name.split("/")[1] for name in FILES if name.endswith(".yaml")}
    assert groups == {"simulator", "representation", "model", "fusion", "touch"}
    assert len(FILES) == 10
    assert (len(TRAINING), len(EVALUATION)) == (5, 1)


@pytest.mark.slow("trains and evaluates an option of every kind")
@pytest.mark.parametrize("overrides", TRAINING, ids=lambda words: words[-1])
def test_an_option_of_ones_own_is_trained_and_evaluated(run, own, overrides):
    simulator = [] if any(one.startswith("simulator=") for one in overrides) else ["simulator=naive"]
    done = run(own, "train", *overrides, *simulator, *SMALL, "trainer.max_epochs=1")
    assert done.returncode == 0, done.stderr
    refused = run(own, "evaluate", "run=latest")  # without trust
    assert refused.returncode == 2
    assert "trust=true" in refused.stderr
    assert refused.stderr.count("\n") == 1
    done = run(own, "evaluate", *EVALUATION[0])
    assert done.returncode == 0, done.stderr
    assert "overall/accuracy" in done.stdout


def test_help_lists_options_of_ones_own(run, own):
    said = run(own, "train", "--config-dir", "conf", *TRAINING[0][2:], "--help", store=False).stdout
    assert "fem, [gaussian], naive, solid" in said
    assert "spread: 0.01  # m" in said


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["simulator=gaussian"], "there is no data=gaussian: there are fem, naive, solid"),
        (["simulator=gaussian", "data=fem", "simulator.spread=-1"], "spread=-1 must be greater than 0"),
        (["representation=readings", "model=gated", "+model.depth=3"], "model has no setting depth"),
        (["simulator=absent", "data=fem"], "simulator._target_=absent.Absent cannot be imported: No module"),
    ],
)
def test_a_mistake_is_one_sentence(run, own, overrides, said):
    (own / "conf" / "simulator" / "absent.yaml").write_text("_target_: absent.Absent\n_partial_: true\n")
    done = run(own, "train", "--config-dir", "conf", *overrides, "data.gestures=48")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert said in done.stderr

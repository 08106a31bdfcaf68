"""A stored run builds options, and nothing that only looks like one; an option has a name."""

from functools import partial

import pytest

from skin.body.layout import Grid
from skin.core.settings import check_targets, option_name
from skin.device.base import Blank
from skin.errors import InputError

PARTS = "torch.optim.AdamW", "torch.optim.adamw.AdamW"
PARTS += "torch_geometric.nn.aggr.Set2Set", "torch_geometric.nn.GCNConv"
OTHERS = """
pandas.read_pickle shutil.copyfile torch.load torch.nn.Linear hydra.utils.get_object
torch.optim.optimizer.torch.load torch.optim.optimizer.torch.nn.Linear torch_geometric.nn.Sequential
torch_geometric.nn.models.BasicGNN.from_pretrained torch_geometric.nn.aggr.base.Path
skin skin. skin..learner skin.x.os.system skinny.Learner
skin.device.files.read_recording skin.device.files.os.system skin.device.files.Path
skin.learning.network.torch.load skin.learning.network.torch.optim.Adam
skin.learning.learner.AbstractLearner skin.learning.learner.Rules.load skin.device.base.AbstractDevice
experiments.peers.rocket.AbstractLearner experiments.peers.rocket.subprocess.Popen
experiments.studies.study.Study
"""


def refuse(name):
    with pytest.raises(InputError, match=r"a run: learner\._target_ names .*trust=true"):
        check_targets({"learner": {"_target_": name}}, "a run")


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.filterwarnings("ignore:`torch.jit")  # of PyTorch Geometric's import
def test_parts_of_libraries_may_be_built(name):
    check_targets({"model": [{"_target_": name, "_partial_": True}]}, "a run")


@pytest.mark.parametrize("name", [*OTHERS.split(), None, ["skin.learning.learner.Rules"]])
def test_nothing_else_may_be_built(name):
    refuse(name)


def test_names_are_resolved_only_inside_the_package(tmp_path, monkeypatch):
    """To import a module is to run it."""
    (tmp_path / "bait.py").write_text("raise SystemExit('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    refuse("bait.Learner")


@pytest.mark.parametrize("value", ["${oc.env:HOME}", "x${row}", "\\${row}"])
@pytest.mark.parametrize("position", [lambda value: {"a": [{"b": value}]}, lambda value: {"a": {value: 1}}])
def test_values_are_final(position, value):
    with pytest.raises(InputError, match="interpolation"):
        check_targets(position(value), "a run")


@pytest.mark.parametrize(
    ("made", "name"), [(Grid(), "grid"), (Blank(None, (1.0, 1.0), None), "base"), (partial, "functools")]
)
def test_an_option_is_named_after_its_file_of_settings_or_its_module(made, name):
    assert option_name(made) == name

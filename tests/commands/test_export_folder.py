"""`skin export format=folder` as a person runs it, and `run=NAME` of what it wrote."""

import shutil

import pytest

SKIN = ["layout=grid", "layout.rows=2", "layout.columns=2", "simulator=naive"]
SMALL = ["data.gestures=400", "device.test_gestures=96", "evaluation.devices=1", "evaluation.layouts=0"]
SMALL += ["evaluation.safe_gestures=200"]
GOOD = ["name=small", "licence=MIT"]


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory):
    """A folder with a finished run of rules, published as ``small``, and what its training said."""
    folder = tmp_path_factory.mktemp("runs")
    done = run(folder, "train", "experiment=rules", *SKIN, *SMALL)
    (folder / "said").write_text(done.stdout)
    done = run(folder, "export", "format=folder", *GOOD)
    assert done.stdout == "models/small\n"
    return folder


@pytest.fixture
def model(folder, tmp_path):
    shutil.copytree(folder / "models" / "small", tmp_path / "models" / "small")
    return tmp_path / "models" / "small"


def test_the_folder_has_weights_configuration_hashes_and_card(folder):
    assert [path.name for path in (folder / "models").iterdir()] == ["small"]
    written = {path.name for path in (folder / "models" / "small").iterdir()}
    assert written == {"README.md", "SHA256SUMS", "config.yaml", "rules.json", "run.json"}
    card = (folder / "models" / "small" / "README.md").read_text()
    assert "`skin.learning.learner.Rules`" in card
    assert "Mlp" not in card


def test_its_name_is_a_run_where_the_run_itself_is_not(folder, model, run):
    done = run(model.parents[1], "evaluate", "run=small")
    table = lambda text: [line for line in text.splitlines() if "accuracy" in line]  # noqa: E731
    assert len(table(done.stdout)) > 3
    assert table(done.stdout) == table((folder / "said").read_text())


def test_an_altered_file_ends_a_command_with_a_sentence(model, run):
    with (model / "rules.json").open("a") as file:
        file.write(" ")
    for verb in ("evaluate", "live"):
        done = run(model.parents[1], verb, "run=small", code=2)
        assert "rules.json in " in done.stderr
        assert "differs from SHA256SUMS: restore the folder" in done.stderr
        assert done.stderr.count("\n") == 1
    assert not (model.parents[1] / "results").exists()


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["licence=MIT"], "name=None is no name of a model"),
        (["name=../small", "licence=MIT"], "name=../small is no name of a model"),
        (["name=latest", "licence=MIT"], "name=latest is no name of a model"),
        (["name=new"], "add licence=MIT"),
        (["name=small", "licence=MIT"], "models/small exists"),
        (["name=new", "licence=MIT", "run=none"], "no finished training run none"),
        (["name=new", "licence=MIT", "out=x"], "not to out=x: add name=my_skin"),
    ],
)
def test_bad_input_ends_with_a_sentence(folder, run, overrides, message):
    done = run(folder, "export", "format=folder", *overrides, code=2)
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert [path.name for path in (folder / "models").iterdir()] == ["small"]


def test_weights_that_are_too_large_are_refused(folder, run):
    code = "import skin.runs.run as m; from skin.commands.export import main; m._LARGEST = 100\n"
    code += "main(['format=folder', 'name=new', 'licence=MIT'{own}])"
    own = f", 'tracking.uri=sqlite:///{folder}/m.db'"
    (folder / "limited.py").write_text(code.format(own=own))
    done = run(folder, folder / "limited.py", store=False, code=2)
    assert "are not one file of at most 0.0001 MB" in done.stderr
    assert [path.name for path in (folder / "models").iterdir()] == ["small"]

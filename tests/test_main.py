"""The command `skin`: its verbs, their help, and what is wrong with what is typed."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from skin.__main__ import main, verbs
from skin.core.files import ROOT

VERBS = [name for name, module in verbs().items() if module.startswith("skin.")]
HEAVY = {"hydra", "numpy", "torch", "mlflow", "pytorch_lightning"}
COMPLETE = """
eval "$(skin -sc install=bash)"
COMP_LINE='{line}'; COMP_POINT=${{#COMP_LINE}}; COMP_WORDS=($COMP_LINE); COMP_CWORD=$((${{#COMP_WORDS[@]}}-1))
_skin
echo "${{COMPREPLY[@]}}"
"""


def test_the_verbs_are_listed_without_imports():
    code = f"import sys, skin.__main__; skin.__main__.main([]); print(*({HEAVY} & set(sys.modules)))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    *lines, heavy = done.stdout.splitlines()
    assert not heavy
    listed = [line.split(maxsplit=1) for line in lines if line.startswith("  ")]
    assert [name for name, _ in listed] == list(verbs())
    assert all(text.endswith(".") for _, text in listed)


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_shows_its_own_groups_and_settings(verb, capsys):
    main([verb, "--help"])
    text = capsys.readouterr().out
    assert f"skin {verb}" in text
    trained = ("adapt", "compare", "evaluate", "export", "live", "train")
    assert ("fusion" in text) == (verb in trained)
    at_port = ("check", "listen", "record", "setup")
    assert ("[serial]" in text) == (verb in at_port)
    assert ("[simulated]" in text) == (verb not in at_port)
    assert "hydra" not in text


def test_what_only_the_repository_has_is_refused_elsewhere(tmp_path):
    """As in an installed package, whose entry points are there, and whose experiments are not."""
    (tmp_path / "x-1.dist-info").mkdir()
    (tmp_path / "x-1.dist-info" / "METADATA").write_text("Name: x\nVersion: 1\n")
    points = "[skin.verbs]\nstudies = nowhere.commands.study\n"
    (tmp_path / "x-1.dist-info" / "entry_points.txt").write_text(points)
    code = f"import sys; sys.path.insert(0, {str(tmp_path)!r})\n"
    code += "from skin.__main__ import main; main(['studies'])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 2, done.stderr
    assert done.stderr == "skin studies needs files that an installed package lacks: clone the repository\n"
    code = code.replace("'studies'", "")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert "studies" not in done.stdout


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["trian"], "did you mean train?"),
        (["x"], "animate, calibrate"),
        (["train", "learner.rounds=20"], "no setting or group learner.rounds, but learner=boosted_trees has"),
        (["train", "seed=["], "seed=["),
    ],
)
def test_a_mistyped_verb_and_what_cannot_be_composed_are_one_sentence(words, said, capsys):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    text = capsys.readouterr().err
    assert said in text
    assert text.count("\n") == 1


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs bash")
@pytest.mark.parametrize(
    ("line", "choices"),
    [
        ("skin exp", {"export"}),
        ("skin train simul", {"simulator=", "simulator."}),
        ("skin train simulator=", {"simulator=fem", "simulator=naive", "simulator=solid"}),
        ("skin train simulator=so", {"simulator=solid"}),
        ("skin evaluate touch.ra", {"touch.rate=", "touch.ramp="}),
        ("skin nosuch a", set()),
    ],
)
def test_bash_completes_verbs_groups_options_and_settings(line, choices):
    script = COMPLETE.format(line=line)
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    settings = {"env": os.environ | {"PATH": path, "PYTHONPATH": str(ROOT)}, "timeout": 120, "check": True}
    done = subprocess.run(["bash", "-c", script], capture_output=True, text=True, **settings)
    assert set(done.stdout.split()) == choices


def test_help_that_is_not_read_to_its_end_is_no_error():
    line = [sys.executable, "-m", "skin", "check", "--help"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.PIPE, cwd=ROOT) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0

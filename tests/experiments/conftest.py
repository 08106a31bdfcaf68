"""What tests of whole commands share."""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator

import pytest

from skin.core.files import ROOT

HEAVY = ("torch", "mlflow", "pytorch_lightning", "numpy", "scipy")
# The modules of all verbs are imported once: what they import counts for each.
LIGHT = f"""
import json, os, sys
from importlib import import_module
from omegaconf import OmegaConf
from skin.__main__ import main, verbs
from skin.core.files import CONF
from tests.starter import remembering
OmegaConf.load = staticmethod(remembering(OmegaConf.load))
for path in CONF.rglob("*.yaml"):
    with path.open() as file:
        OmegaConf.load(file)
for module in verbs().values():
    import_module(module)
for line in sys.stdin:
    job = json.loads(line)
    if number := os.fork():
        print(json.dumps(os.waitstatus_to_exitcode(os.waitpid(number, 0)[1])), flush=True)
        continue
    os.chdir(job["folder"])
    for stream, name in ((1, "out"), (2, "err")):
        os.dup2(os.open(job[name], os.O_WRONLY | os.O_CREAT), stream)
    sys.argv = ["skin", *job["words"]]
    try:
        main(job["words"])
    finally:
        print(*sorted(set({HEAVY!r}) & set(sys.modules)))
    break
"""


@pytest.fixture(scope="session")
def light(tmp_path_factory) -> Iterator[Callable[..., subprocess.CompletedProcess]]:
    """Return a function that runs ``skin`` in a folder, in a process without the heavy libraries.

    The last line of what it says has the names of the heavy libraries that it has imported.
    """
    if not hasattr(os, "fork"):
        pytest.skip("needs forks")
    said = tmp_path_factory.mktemp("light")
    command, pipes = [sys.executable, "-c", LIGHT], {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}

    def run(folder, *words: str) -> subprocess.CompletedProcess:
        out, err = said / "out", said / "err"
        for file in (out, err):
            file.write_text("")
        job = {"folder": str(folder), "words": list(words), "out": str(out), "err": str(err)}
        print(json.dumps(job), file=process.stdin, flush=True)
        code = json.loads(process.stdout.readline())
        return subprocess.CompletedProcess(words, code, out.read_text(), err.read_text())

    with subprocess.Popen(command, cwd=ROOT, text=True, **pipes) as process:
        yield run
        process.stdin.close()

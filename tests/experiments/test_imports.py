"""Every file of experiments/ can be imported: a script that imports late would fail late."""

import ast
import runpy
import warnings
from importlib import import_module

import pytest

from skin.core.files import ROOT

HERE = ROOT / "experiments"
FILES = sorted(path.relative_to(HERE) for path in HERE.rglob("*.py"))
OURS = {"skin", *(path.name for path in HERE.iterdir() if (path / "__init__.py").is_file())}


@pytest.fixture(autouse=True)
def quiet():
    with warnings.catch_warnings():
        # PyTorch Geometric compiles with torch.jit.script while it is imported
        warnings.filterwarnings("ignore", "`torch.jit.script", DeprecationWarning)
        yield


@pytest.mark.parametrize("path", FILES, ids=str)
def test_it_is_imported_with_all_that_its_functions_import(path):
    if path.name != "__init__.py":
        runpy.run_path(str(HERE / path), run_name="imported")
    for node in ast.walk(ast.parse((HERE / path).read_text())):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] in OURS:
            module = import_module(node.module)
            for name in node.names:
                if not hasattr(module, name.name):
                    import_module(f"{node.module}.{name.name}")

"""NOTICE names the licence of everything that constraints.txt installs."""

import pytest

from docs.notice import licence, names, notice
from skin.core.files import ROOT
from skin.errors import InputError

CONSTRAINTS = ROOT / "constraints.txt"
LISTED = dict(row.split(": ", 1) for row in (ROOT / "NOTICE").read_text().rpartition("\n\n")[2].splitlines())


def test_every_dependency_is_listed():
    assert len(LISTED) > 100
    assert list(LISTED) == list(names(CONSTRAINTS)), "run make notice"


@pytest.mark.parametrize("name", ["torch", "huey", "gensim", "hydra-joblib-launcher"])
def test_the_licence_is_the_one_that_the_package_states(name):
    try:
        stated = licence(name)
    except InputError:
        pytest.skip(f"{name} is not installed")
    assert LISTED[name] == stated, "run make notice"


def test_a_package_that_is_not_installed_is_refused(tmp_path):
    (tmp_path / "constraints.txt").write_text("no-such-package==1.0\n")
    with pytest.raises(InputError, match=r"no-such-package is not installed"):
        notice(tmp_path / "constraints.txt")


def test_the_citation_has_the_version_of_the_package():
    import skin

    assert f"\nversion: {skin.__version__}\n" in (ROOT / "CITATION.cff").read_text()

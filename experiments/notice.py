"""Write NOTICE: the licences of the dependencies, of the data and of the weights.

python -m experiments.notice
"""

from collections.abc import Iterator
from importlib.metadata import PackageMetadata, PackageNotFoundError, metadata
from pathlib import Path

from skin.core.files import ROOT, write
from skin.errors import InputError

_HEAD = """\
Tactile skin
Copyright (c) 2026 The skin developers. MIT licence; see LICENSE.

Data and weights. The layouts and shapes in data/, the results in docs/results/ and the weights in models/
were made by this project and have its licence. data/report_table.csv quotes numbers of the report that the
project follows. The Corpus of Social Touch (docs/data.md) and weights of EfficientNet (model.weights) are not
part of the project: whoever uses them obtains them under their own terms.

Dependencies. None is part of the repository or of the wheel; pip installs them. The licences are those that
the packages of constraints.txt state. `make notice` writes this list.

"""
_LICENCE = "License :: "
_LONGEST = 60  # characters of a name; a longer text is the licence itself
# Of packages whose metadata do not name the licence that they contain or publish.
_READ = {"huey": "MIT", "python-dateutil": "Apache-2.0 OR BSD-3-Clause", "skops": "MIT"}


def notice(constraints: Path) -> str:
    """Return the text of NOTICE.

    Args:
        constraints: file with a line ``name==version`` for each dependency, all of them installed.

    Raises:
        InputError: a package is not installed, or states no licence.
    """
    return _HEAD + "".join(f"{name}: {licence(name)}\n" for name in names(constraints))


def names(constraints: Path) -> Iterator[str]:
    """Yield the names of the dependencies in a file of constraints."""
    for line in constraints.read_text().splitlines():
        if "==" in line and not line.startswith("#"):
            yield line.partition("==")[0].strip()


def licence(name: str) -> str:
    """Return the licence that an installed package states.

    Raises:
        InputError: it is not installed, or states none.
    """
    try:
        stated = metadata(name)
    except PackageNotFoundError:
        raise InputError(f"{name} of constraints.txt is not installed: run make install") from None
    statements = (text for text in _statements(stated) if text not in ("", "UNKNOWN"))
    licence_text = _READ.get(name) or next(statements, None)
    if licence_text is None:
        raise InputError(f"{name} states no licence: read it, and add it to experiments/notice.py")
    return licence_text


def _statements(stated: PackageMetadata) -> Iterator[str]:
    """Yield what a package states as its licence, the most exact statement first."""
    expression, text = (
        (stated.get_all(name) or [""])[0].strip() for name in ("License-Expression", "License")
    )
    yield expression
    yield text if len(text) <= _LONGEST else ""
    classified = [text for text in stated.get_all("Classifier") or [] if text.startswith(_LICENCE)]
    yield ", ".join(classifier.rpartition(" :: ")[2] for classifier in classified)
    yield text.splitlines()[0] if text else ""


if __name__ == "__main__":
    print(write(notice(ROOT / "constraints.txt"), ROOT / "NOTICE"))

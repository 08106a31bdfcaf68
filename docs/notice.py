"""Write NOTICE: the licences of the dependencies, of the data and of the weights.

python -m docs.notice
"""

import re
from importlib.metadata import PackageNotFoundError, metadata
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
the packages of constraints.txt state. `make notice` writes this list. The extra `optuna` (MIT, its plugin for
Hydra too) and aeon (BSD-3-Clause, of experiments/peers) have environments of their own.

"""


def notice(constraints: Path) -> str:
    """Return the text of NOTICE.

    Args:
        constraints: file with a line ``name==version`` for each dependency, all of them installed.

    Raises:
        InputError: a package is not installed, or states no licence.
    """
    return _HEAD + "".join(f"{name}: {licence(name)}\n" for name in names(constraints))


def names(constraints: Path) -> list[str]:
    """Return the names of the dependencies in a file of constraints."""
    return re.findall(r"^([\w.-]+)==", constraints.read_text(), re.MULTILINE)


def licence(name: str) -> str:
    """Return the licence that an installed package states.

    Raises:
        InputError: it is not installed, or states none.
    """
    try:
        stated = metadata(name).json
    except PackageNotFoundError:
        raise InputError(
            f"{name} is not installed: .venv/bin/pip install -c constraints.txt {name}"
        ) from None
    expression, text = (str(stated.get(key, "")).strip() for key in ("license_expression", "license"))
    classes = [each.rpartition(" :: ")[2] for each in stated.get("classifier", []) if "License ::" in each]
    # Some packages contain or publish a licence that their metadata do not name.
    read = {"huey": "MIT", "python-dateutil": "Apache-2.0 OR BSD-3-Clause", "skops": "MIT"}
    # The most exact statement first; a long text is the licence itself.
    short = text if len(text) <= 60 else ""
    statements = (read.get(name, ""), expression, short, ", ".join(classes), text)
    known = [each.splitlines()[0] for each in statements if each not in ("", "UNKNOWN")]
    if not known:
        raise InputError(f"{name} states no licence: read it, and add it to docs/notice.py")
    return known[0]


if __name__ == "__main__":
    print(write(notice(ROOT / "constraints.txt"), ROOT / "NOTICE"))

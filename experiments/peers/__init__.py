"""Models of other libraries, in an environment of their own, as learners."""

import os
from pathlib import Path

PYTHON = "SKIN_PEERS_PYTHON"
"""Environment variable with the Python of this environment; without it, the one that `make peers` builds."""

CONF = Path(__file__).parent / "conf"
"""Their options and rows, for ``--config-dir``."""

ROWS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))


def python() -> Path:
    """Return the Python of this environment, which may not exist."""
    return Path(os.environ.get(PYTHON, Path(__file__).parents[2] / ".venv-peers" / "bin" / "python"))

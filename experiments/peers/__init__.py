"""Models of other libraries, in an environment of their own, as learners."""

from pathlib import Path

CONF = Path(__file__).parent / "conf"
"""Their options and rows, for ``--config-dir``."""

ROWS = sorted(path.stem for path in (CONF / "experiment").glob("*.yaml"))

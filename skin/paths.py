"""Where the files that come with the package are: in the repository, or in an installed wheel."""

from pathlib import Path

_PACKAGE = Path(__file__).parent
ROOT = _PACKAGE.parent
"""The repository, where the package is imported from one."""

BUNDLED = _PACKAGE if (_PACKAGE / "conf").is_dir() else ROOT
"""The folder of ``conf``, ``data`` and ``models``; a wheel has them inside the package."""

CONF = BUNDLED / "conf"
MANIFEST = "manifest.json"
"""The file that makes a folder a data set."""


def candidates(given: str | Path) -> list[Path]:
    """Return where a file may be: relative to the current folder, or beside the package."""
    path = Path(given).expanduser()
    return [path] if path.is_absolute() else [Path.cwd() / path, BUNDLED / path]

"""Check the laws of mechanics against independent solutions.

    python -m experiments.validation
    python -m experiments.validation quick=true laws=hertz,punch out=FOLDER

Without settings: writes docs/physics.md with its pictures, and results/physics.json. ``quick=true``: coarser
meshes and fewer cases, the same tolerances; all files go to results/quick. ``laws=``: only these; files are
written only with ``out=``. Exit code 1 if a law does not hold.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

from rich.console import Console
from rich.progress import track

from experiments.validation import select_laws
from experiments.validation.finding import CheckResult, Law, publish_physics
from skin.core.files import ROOT, results
from skin.errors import InputError


def main(words: Sequence[str]) -> bool:
    """Check laws, print a line for each, write the results, and return whether all laws hold.

    Raises:
        InputError: an unknown setting or law.
    """
    settings = read_settings(words)
    quick, out = settings["quick"] == "true", settings["out"]
    laws = select_laws(settings["laws"])
    outcomes = []
    for law in track(laws, "checking laws", console=Console(stderr=True), disable=not sys.stderr.isatty()):
        outcomes.append((law, law.check(quick)))
        report(*outcomes[-1])
    if out or settings["laws"] == "all":
        published = not quick and not out
        page = ROOT / "docs" if published else Path(out or results(None) / "quick").expanduser()
        data = (results(None) if published else page) / "physics.json"
        publish_physics(page, data, outcomes)
        print(f"{page / 'physics.md'}, {data}")
    return all(finding.ok for _, outcome in outcomes for finding in outcome.findings)


def read_settings(words: Sequence[str]) -> dict[str, str]:
    """Return all settings from words ``name=value``.

    Raises:
        InputError: an unknown name or a bad value.
    """
    settings = {"quick": "false", "laws": "all", "out": ""}
    for word in words:
        name, _, value = word.partition("=")
        if name not in settings or not value:
            raise InputError(f"{word} is no setting: give quick=true, laws=hertz,punch or out=FOLDER")
        settings[name] = value
    if settings["quick"] not in ("true", "false"):
        raise InputError(f"quick={settings['quick']} must be true or false")
    return settings


def report(law: Law, outcome: CheckResult) -> None:
    """Print whether a law holds, and every number that is wrong."""
    failures = [finding for finding in outcome.findings if not finding.ok]
    print(f"{law.name}: {'FAILS' if failures else 'holds'}, {len(outcome.findings)} numbers", flush=True)
    for finding in failures:
        print(f"  {finding.case}: {finding.ours:.6g}, must be {finding.reference:.6g}")
        print(f"  error {finding.error:.2g}, tolerance {finding.tolerance:g}", flush=True)


if __name__ == "__main__":
    try:
        sys.exit(0 if main(sys.argv[1:]) else 1)
    except InputError as error:
        print(error, file=sys.stderr)
        sys.exit(2)

"""Check the laws of mechanics against independent solutions.

    skin validate
    skin validate validate.quick=true validate.laws=[hertz,punch]

Writes physics.md, its pictures and physics.json. Exit code 1 if a law does not hold.
"""

import sys
from pathlib import Path

from omegaconf import DictConfig

from skin.command import command
from skin.config import plain
from skin.files import results
from skin.paths import ROOT


@command("validate")
def main(config: DictConfig) -> None:
    """Check laws, print a line for each, and write the results."""
    from rich.console import Console
    from rich.progress import track

    from experiments.validation.laws import select_laws
    from experiments.validation.physics_page import publish_physics

    settings = plain(config)["validate"]
    laws = select_laws(settings["laws"])
    outcomes = []
    shown = sys.stderr.isatty()
    for law in track(laws, "checking laws", console=Console(stderr=True), disable=not shown):
        outcome = law.check(settings["quick"])
        outcomes.append((law, outcome))
        failed = [finding for finding in outcome.findings if not finding.ok]
        print(f"{law.name}: {'FAILS' if failed else 'holds'}, {len(outcome.findings)} numbers", flush=True)
        for one in failed:
            print(f"  {one.case}: {one.ours:.6g}, must be {one.reference:.6g}")
            print(f"  error {one.error:.2g}, tolerance {one.tolerance:g}", flush=True)
    if config.out is not None or settings["laws"] == "all":
        page, data = _places(config.out, settings["quick"])
        publish_physics(page, data, outcomes)
        print(f"{page / 'physics.md'}, {data}")
    if any(not finding.ok for _, outcome in outcomes for finding in outcome.findings):
        sys.exit(1)


def _places(out: str | None, quick: bool) -> tuple[Path, Path]:
    """Return the folder of the page and the path of the findings."""
    if out is None and not quick:
        return ROOT / "docs", results(None) / "physics.json"
    folder = Path(out).expanduser() if out else results(None) / "quick"
    return folder, folder / "physics.json"

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

from experiments import run_script, script_settings
from experiments.validation import CheckResult, Law, publish_physics, solid
from skin.core.files import ROOT, results
from skin.errors import InputError

LAWS = (
    Law("patch",
        "A uniform strain prescribed on the surface of distorted elements gives the same strain inside.",
        "linear algebra", solid.patch_test),
    Law("confined",
        "Between smooth walls a uniform pressure p compresses each layer by p h / (lambda + 2 G).",
        "closed form", solid.confined_compression),
    Law("even", "In the middle of a wide sheet a uniform pressure p gives sigma_zz = -p at every depth.",
        "equilibrium", solid.even_pressure),
    Law("convergence", "Halving the element size divides the displacement error by four.",
        "closed form of the bonded layer", solid.convergence),
    Law("layer",
        "The compliance of a thin, nearly incompressible bonded layer is correct for all wavelengths.",
        "closed form (Aleksandrov and Vorovich)", solid.thin_layer),
    Law("locking", "The error does not grow when nu rises from 0.45 to 0.4999.",
        "the same closed form", solid.no_locking),
    Law("layered",
        "The default skin, and skins of one and two layers up to 40 mm thick, read discs as small as a "
        "fingertip wherever these press and wherever the sensors are.",
        "Hankel integral of exact waves of all layers", solid.layered),
    Law("boussinesq", "Pressure on a thick soft block: displacement and stress below and beside the load.",
        "Boussinesq, integrated over the square", solid.boussinesq),
    Law("cerruti", "Tangential traction on a thick soft block: displacement and stress.",
        "Cerruti, integrated over the square", solid.cerruti),
    Law("hertz", "A rigid sphere on a thick block: contact radius, peak pressure and force.",
        "Hertz", solid.hertz),
    Law("punch", "Flat rigid punches, square and round: force for a given approach.",
        "capacitance of a square plate (Read, 1997); Johnson, section 3.4", solid.flat_punch),
    Law("arm", "A sleeve of large radius behaves like a sheet.", "the sheet", solid.wide_arm),
    Law("tube", "A sleeve on a rigid core under uniform pressure behaves like a bonded tube of two layers.",
        "Lame's equations", solid.sleeve),
)  # fmt: skip


def select_laws(names: str) -> list[Law]:
    """Return the laws with the given names, separated by commas, or every law for ``all``.

    Raises:
        InputError: an unknown name.
    """
    laws = {law.name: law for law in LAWS}
    if names == "all":
        return list(LAWS)
    if unknown := [name for name in names.split(",") if name not in laws]:
        raise InputError(
            f"laws must be all or some of {', '.join(laws)}, got {', '.join(unknown)}: as in laws=hertz,punch"
        )
    return [laws[name] for name in names.split(",")]


def main(words: Sequence[str]) -> bool:
    """Check laws, print a line for each, write the results, and return whether all laws hold.

    Raises:
        InputError: an unknown setting or law.
    """
    settings = validation_settings(words)
    quick, out = settings["quick"] == "true", settings["out"]
    laws = select_laws(settings["laws"])
    outcomes = []
    for law in track(laws, "checking laws", console=Console(stderr=True), disable=not sys.stderr.isatty()):
        outcomes.append((law, law.check(quick)))
        print_outcome(*outcomes[-1])
    if out or settings["laws"] == "all":
        published = not quick and not out
        page = ROOT / "docs" if published else Path(out or results(None) / "quick").expanduser()
        data = (results(None) if published else page) / "physics.json"
        publish_physics(page, data, outcomes)
        print(f"{page / 'physics.md'}, {data}")
    return all(finding.ok for _, outcome in outcomes for finding in outcome.findings)


def validation_settings(words: Sequence[str]) -> dict[str, str]:
    """Return all settings from words ``name=value``.

    Raises:
        InputError: an unknown name or a bad value.
    """
    settings = script_settings(words, {"quick": "false", "laws": "all", "out": ""})
    if settings["quick"] not in ("true", "false"):
        raise InputError(f"quick={settings['quick']} must be true or false")
    return settings


def print_outcome(law: Law, outcome: CheckResult) -> None:
    """Print whether a law holds, and every number that is wrong."""
    failures = [finding for finding in outcome.findings if not finding.ok]
    print(f"{law.name}: {'FAILS' if failures else 'holds'}, {len(outcome.findings)} numbers", flush=True)
    for finding in failures:
        print(f"  {finding.case}: {finding.ours:.6g}, must be {finding.reference:.6g}")
        print(f"  error {finding.error:.2g}, tolerance {finding.tolerance:g}", flush=True)


if __name__ == "__main__":
    run_script(main)

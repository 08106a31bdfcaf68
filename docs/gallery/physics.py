"""
Laws of mechanics
=================

Simulated displacements and forces against independent solutions (:doc:`/physics`). The meshes are those of
``make physics PHYSICS=quick=true``, coarser than the published ones.
"""

from pathlib import Path
from tempfile import mkdtemp

from experiments.validation import draw
from experiments.validation.__main__ import select_laws

folder, paths = Path(mkdtemp()), []
for law in select_laws("boussinesq,hertz,locking"):
    outcome = law.check(True)
    print(f"{law.name}: {law.statement} Worst error {max(one.error for one in outcome.findings):.1e}")
    for plot in outcome.plots:
        paths.append(folder / f"{plot.name}.png")
        draw(plot, paths[-1])

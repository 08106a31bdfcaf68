"""
Laws of mechanics
=================

Simulated displacements and forces against independent solutions (:doc:`/physics`). The meshes are coarser
than the published ones.
"""

from pathlib import Path
from tempfile import mkdtemp

import pytest

from skin.core.files import ROOT

folder = Path(mkdtemp())
chosen = ["-k", "boussinesq or hertz or locking", "-p", "no:cacheprovider"]
assert not pytest.main(["-q", str(ROOT / "experiments/laws"), *chosen, f"--page={folder}"])
paths = sorted(folder.glob("results/physics/*.png"))

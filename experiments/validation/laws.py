"""The laws, in the order of the page."""

from experiments.validation import bonded_layer, patch_and_equilibrium, reference_programs, thick_block
from experiments.validation.finding import Law
from skin.errors import InputError

LAWS = (
    Law("patch",
        "A uniform strain prescribed on the surface of distorted elements gives the same strain inside.",
        "linear algebra", patch_and_equilibrium.patch_test),
    Law("confined",
        "Between smooth walls a uniform pressure p compresses each layer by p h / (lambda + 2 G).",
        "closed form", patch_and_equilibrium.confined_compression),
    Law("even", "In the middle of a wide sheet a uniform pressure p gives sigma_zz = -p at every depth.",
        "equilibrium", patch_and_equilibrium.even_pressure),
    Law("balance",
        "The reactions of the support balance the applied force and moment, on a sheet and on an arm.",
        "equilibrium", patch_and_equilibrium.global_balance),
    Law("reciprocity", "Two loads do the same work on each other's displacements (Maxwell and Betti).",
        "symmetry", patch_and_equilibrium.reciprocity),
    Law("convergence", "Halving the element size divides the displacement error by four.",
        "closed form of the bonded layer", bonded_layer.convergence),
    Law("layer",
        "The compliance of a thin, nearly incompressible bonded layer is correct for all wavelengths.",
        "closed form (Aleksandrov and Vorovich)", bonded_layer.thin_layer),
    Law("locking", "The error does not grow when nu rises from 0.45 to 0.4999.",
        "the same closed form", bonded_layer.no_locking),
    Law("mesh", "The default mesh gives the readings of the default skin under a square load.",
        "sums of exact waves of both layers", bonded_layer.default_mesh),
    Law("boussinesq", "Pressure on a thick soft block: displacement and stress below and beside the load.",
        "Boussinesq, integrated over the square", thick_block.boussinesq),
    Law("cerruti", "Tangential traction on a thick soft block: displacement and stress.",
        "Cerruti, integrated over the square", thick_block.cerruti),
    Law("hertz", "A rigid sphere on a thick block: contact radius, peak pressure and force.",
        "Hertz", thick_block.hertz),
    Law("punch", "Flat rigid punches, square and round: force for a given approach.",
        "capacitance of a square plate (Read, 1997); Johnson, section 3.4", thick_block.flat_punch),
    Law("direct", "The precomputed operator gives the same result as solving each frame.",
        "scikit-fem alone, in the mixed form", reference_programs.single_frames),
    Law("arm", "A sleeve of large radius behaves like a sheet.", "the sheet", patch_and_equilibrium.wide_arm),
    Law("tube", "A sleeve on a rigid core under uniform pressure behaves like a bonded tube of two layers.",
        "Lame's equations", patch_and_equilibrium.sleeve),
    Law("pynite", "simulator=fem gives the same nodal displacements as PyNite.",
        "PyNite", reference_programs.plates_and_beams),
    Law("equation10",
        "The reading of simulator=fem is D_s / D_t times the force on the footprint, and proportional to it.",
        "PyNite and the report's equation 10", reference_programs.equation_ten),
    Law("naive", "The reading of simulator=naive is the pressure of one cell times the footprint area.",
        "the report", reference_programs.naive),
    Law("creep", "A viscoelastic skin creeps under a constant load.",
        "creep of the standard linear solid", reference_programs.creep),
    Law("threads", "Results are the same on one thread and on two.",
        "another process", reference_programs.threads),
)  # fmt: skip


def select_laws(names: str | list[str]) -> list[Law]:
    """Return the laws with the given names, or every law for ``all``.

    Raises:
        InputError: an unknown name.
    """
    wanted = [names] if isinstance(names, str) else list(names)
    known = {law.name: law for law in LAWS}
    if wanted == ["all"]:
        return list(LAWS)
    if not wanted or (unknown := [name for name in wanted if name not in known]):
        raise InputError(
            f"validate.laws must be all or some of {', '.join(known)}, got "
            f"{', '.join(unknown) if wanted else 'none'}: as in validate.laws=[hertz,punch]"
        )
    return [known[name] for name in wanted]

"""The laws, in the order of the page."""

from experiments.validation import bonded_layer, patch_and_equilibrium, reference_programs, thick_block
from experiments.validation.finding import Law
from skin.errors import InputError

LAWS = (
    Law("patch", "A uniform strain on the surface of distorted elements is the same strain inside.",
        "linear algebra", patch_and_equilibrium.patch_test),
    Law("confined", "Between smooth walls an even pressure p shortens each layer by p h / (lambda + 2 G).",
        "closed form", patch_and_equilibrium.confined_compression),
    Law("even", "In the middle of a wide sheet an even pressure p is sigma_zz = -p at every depth.",
        "equilibrium", patch_and_equilibrium.even_pressure),
    Law("balance", "The table answers with the force and the moment applied, flat or on an arm.",
        "equilibrium", patch_and_equilibrium.global_balance),
    Law("reciprocity", "Loads do the same work on each other's motion (Maxwell and Betti).",
        "symmetry", patch_and_equilibrium.reciprocity),
    Law("convergence", "Halving the elements divides the error of motion by four.",
        "closed form of the bonded layer", bonded_layer.convergence),
    Law("layer", "A thin, nearly incompressible bonded layer moves under waves of pressure, long or short.",
        "closed form (Aleksandrov and Vorovich)", bonded_layer.thin_layer),
    Law("locking", "The error stays the same while nu goes from 0.45 to 0.4999.",
        "the same closed form", bonded_layer.no_locking),
    Law("mesh", "The two layers of the default skin, pressed by a square, are felt on its default mesh.",
        "sums of exact waves of both layers", bonded_layer.default_mesh),
    Law("boussinesq", "Pressure on a thick soft block: motion and stress below and beside it.",
        "Boussinesq, integrated over the square", thick_block.boussinesq),
    Law("cerruti", "Traction along the surface of a thick soft block: motion and stress.",
        "Cerruti, integrated over the square", thick_block.cerruti),
    Law("hertz", "A rigid sphere on a thick block: radius, peak pressure and force.",
        "Hertz", thick_block.hertz),
    Law("punch", "Flat rigid punches, square and round: the force at an approach.",
        "capacitance of a square plate (Read, 1997); Johnson, section 3.4", thick_block.flat_punch),
    Law("direct", "The operator answers single frames as a solve of each does.",
        "scikit-fem alone, in the mixed form", reference_programs.single_frames),
    Law("arm", "A sleeve of large radius is a sheet.", "the sheet", patch_and_equilibrium.wide_arm),
    Law("tube", "A sleeve on a rigid core under an even pressure is a bonded tube of two layers.",
        "Lame's equations", patch_and_equilibrium.sleeve),
    Law("pynite", "simulator=fem moves every node as PyNite does.",
        "PyNite", reference_programs.plates_and_beams),
    Law("equation10", "simulator=fem reads D_s / D_t times the force on the footprint, in proportion to it.",
        "PyNite and the report's equation 10", reference_programs.equation_ten),
    Law("naive", "simulator=naive reads one cell's pressure times the footprint.",
        "the report", reference_programs.naive),
    Law("creep", "A skin that relaxes sinks in under a load that stays.",
        "creep of the standard linear solid", reference_programs.creep),
    Law("threads", "Results are the same on one thread and on two.",
        "another process", reference_programs.threads),
)  # fmt: skip


def select_laws(names: str | list[str]) -> list[Law]:
    """Return the laws of these names; ``all``: all.

    Raises:
        InputError: a name that no law has.
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

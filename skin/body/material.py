"""Silicones in SI units, each number with its source."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from annotated_types import Gt, Lt
from pydantic import PositiveFloat

from skin.core.settings import checked, configured
from skin.errors import InputError

Ratio = Annotated[float, Gt(-1), Lt(1)]


@checked("relaxation")
@dataclass(frozen=True)
class Relaxation:
    """How stress relaxes under a strain that is held: E(t) = E (1 + strength exp(-t / time)).

    One Maxwell branch beside the elastic one (the standard linear solid); Poisson's ratio stays as it is.

    Attributes:
        time: tau, s.
        strength: g, fraction by which the modulus of an instantaneous strain exceeds the relaxed one, E.

    Raises:
        InputError: a time or a strength that is not a positive number.
    """

    time: PositiveFloat
    strength: PositiveFloat


@checked("material")
@dataclass(frozen=True)
class Material:
    """A linear elastic material, which may relax.

    Attributes:
        name: of the material; it does not affect the mechanics.
        young: Young's modulus E, Pa; of a material that relaxes, the value in the end.
        poisson: Poisson's ratio nu. The plate-and-beam model takes -1 < nu < 1, where its shear modulus
            E / 2(1 + nu) and its plate stiffness E / (1 - nu^2) are positive. A solid needs nu < 0.5.
        relaxation: how stress relaxes; None: not at all.

    Raises:
        InputError: a modulus that is not a positive number, or a Poisson's ratio outside (-1, 1).
    """

    name: str
    young: PositiveFloat
    poisson: Ratio
    relaxation: Relaxation | None = None

    @property
    def shear(self) -> float:
        """Shear modulus E / 2(1 + nu), Pa (report, equation 5)."""
        return self.young / (2 * (1 + self.poisson))

    def elastic(self, speed: float) -> "Material":
        """Return the elastic material that answers loads like exp(``speed`` t), 1/s, as this one does.

        Its modulus is E (1 + g s tau / (1 + s tau)): E at 0, E (1 + g) at infinity.
        """
        if self.relaxation is None:
            return self
        relaxed_fraction = 1 / (1 + speed * self.relaxation.time)
        return Material(
            self.name, self.young * (1 + self.relaxation.strength * (1 - relaxed_fraction)), self.poisson
        )

    @classmethod
    def of(cls, value: "str | Mapping[str, Any] | Material") -> "Material":
        """Return the material that a configuration means.

        Args:
            value: the name of a known material, or a mapping of ``name`` and any of ``young`` (Pa),
                ``poisson`` and ``relaxation`` ({time (s), strength}); what is left out comes from the known
                material of that name. None of them relaxes.

        Raises:
            InputError: the name is unknown and a constant is missing, or a key is mistyped.
        """
        if isinstance(value, Material):
            return value
        return configured(_material, {"name": value} if isinstance(value, str) else value, "material")


MATERIALS = (
    # Report, table 2: E = 0.02466 ksi after Fouillet et al. [19], nu after An [20]. The maker's modulus at
    # 100 % strain is 69 kPa.
    Material("EcoFlex 00-30", young=170.0e3, poisson=0.499),
    # Report, table 2: E = 0.08122 ksi after Fouillet et al. [19], nu from the report's own experiment. No
    # isotropic solid has nu = 0.54; the plate-and-beam model uses it only in E / (1 - nu^2) and E / 2(1 +
    # nu). The maker's modulus at 100 % strain is 152 kPa.
    Material("Dragon Skin 10 Medium", young=560.0e3, poisson=0.54),
)


def _key(name: str) -> str:
    """Reduce a name to what identifies it, so that ``ecoflex_00_30`` means EcoFlex 00-30."""
    return "".join(character for character in name.lower() if character.isalnum())


_BY_KEY = {_key(material.name): material for material in MATERIALS}


def _material(
    name: str, young: PositiveFloat | None = None, poisson: Ratio | None = None, relaxation: Any = None
) -> Material:
    entry = _BY_KEY.get(_key(name))
    if entry is not None:
        name, young, poisson = entry.name, young or entry.young, entry.poisson if poisson is None else poisson
    if young is None or poisson is None:
        raise InputError(_missing(name, young, poisson))
    if relaxation is not None:
        relaxation = configured(Relaxation, relaxation, f"material {name}.relaxation")
    return Material(name, young, poisson, relaxation)


def _missing(name: str, young: float | None, poisson: float | None) -> str:
    need = " and ".join(key for key, value in (("young (Pa)", young), ("poisson", poisson)) if value is None)
    advice = (
        f"give {need}, as in {{'name': {name!r}, 'young': 100e3, 'poisson': 0.49}} in Python "
        f"or {{name: {name}, young: 100e3, poisson: 0.49}} on the command line"
    )
    if _key(name) == "ecoflexgel":
        return f"EcoFlex Gel has no constants of its own: the report's measurement was unreliable; {advice}"
    known = ", ".join(material.name for material in MATERIALS)
    return f"unknown material {name}: known materials: {known}; or {advice}"

"""Settings of commands that compare runs; free of heavy imports, so that a mistake is reported at once."""

from collections.abc import Sequence
from dataclasses import dataclass

from skin.errors import InputError

__all__ = ["DeadSettings", "DirectionSettings", "MovingSettings"]

_EXAMPLE = {"rows": "features", "seeds": "0,1,2"}


@dataclass(frozen=True)
class DeadSettings:
    """What is tried; ``conf/dead.yaml`` explains the fields.

    Raises:
        InputError: a setting that cannot be used.
    """

    counts: Sequence[int]
    gestures: int
    devices: int

    def __post_init__(self) -> None:
        if not self.counts or min(self.counts) < 0:
            raise InputError(f"dead.counts must list numbers from 0 up, got {self.counts}: as in [0,1,3,5]")
        for name in ("gestures", "devices"):
            if getattr(self, name) < 1:
                raise InputError(f"dead.{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class DirectionSettings:
    """What is compared; ``conf/direction.yaml`` explains the fields and holds their values.

    Raises:
        InputError: no row, no seed, or no friction.
    """

    rows: Sequence[str]
    seeds: Sequence[int]
    shear: float
    tilted: str

    def __post_init__(self) -> None:
        for name in ("rows", "seeds"):
            if not isinstance(getattr(self, name), list) or not getattr(self, name):
                raise InputError(
                    f"direction.{name} must list some, as in direction.{name}=[{_EXAMPLE[name]}]"
                )
        if not self.shear > 0:
            raise InputError(f"direction.shear must be above 0, got {self.shear}: as in direction.shear=0.5")

    @property
    def skins(self) -> dict[str, list[str]]:
        """Name -> overrides of each skin, the plain one first."""
        friction = [f"touch.shear={self.shear}"]
        return {
            "upright": [],
            "upright_shear": friction,
            "tilted_shear": [*friction, "layout=file", f"layout.path={self.tilted}"],
        }


@dataclass(frozen=True)
class MovingSettings:
    """What is tried; ``conf/moving.yaml`` explains the fields and holds their values.

    Raises:
        InputError: a setting that cannot be used.
    """

    rows: str | Sequence[str]
    errors: Sequence[float]
    variation: float
    gestures: int
    devices: int
    train: bool
    seeds: Sequence[int]

    def __post_init__(self) -> None:
        for name in ("errors", "seeds"):
            given = getattr(self, name)
            if not isinstance(given, list) or not given or not all(number >= 0 for number in given):
                raise InputError(f"moving.{name} must list numbers from 0 up, got {given}: as in [0]")
        for name in ("gestures", "devices"):
            if getattr(self, name) < 1:
                raise InputError(f"moving.{name} must be at least 1, got {getattr(self, name)}")

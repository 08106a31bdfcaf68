"""Settings of the embeddings study; free of heavy imports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from skin.errors import InputError

__all__ = ["Probing"]

ATTRIBUTES = ("degree", "reading")


@dataclass(frozen=True)
class Probing:
    """What is probed; ``conf/embeddings.yaml`` holds the same defaults.

    Raises:
        InputError: a name that is not known, or a number too small to be of use.
    """

    attributes: Sequence[str] = ATTRIBUTES
    train: int = 800
    test: int = 400
    seeds: Sequence[int] = (0, 1, 2)
    layouts: int = 3
    levels: int = 8
    depth: int = 2
    width: int = 128
    epochs: int = 50
    graph: Mapping[str, Any] = field(default_factory=lambda: {"edges": "knn", "count": 6, "weight": "exp"})

    def __post_init__(self) -> None:
        if not self.attributes or set(self.attributes) - set(ATTRIBUTES):
            raise InputError(
                f"nodes are labelled by degree or reading, got {list(self.attributes)}: "
                "set embeddings.attributes=[degree,reading]"
            )
        least = {"train": 20, "test": 10, "layouts": 1, "levels": 2, "depth": 0, "width": 2, "epochs": 1}
        for name, number in least.items():
            if getattr(self, name) < number:
                raise InputError(f"embeddings.{name} must be at least {number}, got {getattr(self, name)}")
        if not self.seeds:
            raise InputError("embeddings.seeds is empty: give some, as in embeddings.seeds=[0,1,2]")

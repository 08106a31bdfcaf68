"""Settings of the embeddings study; free of heavy imports."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from annotated_types import Ge, MinLen


@dataclass(frozen=True)
class ProbeSettings:
    """What is probed; ``conf/study/embeddings.yaml`` explains the fields."""

    attributes: Annotated[Sequence[Literal["degree", "reading"]], MinLen(1)] = ("degree", "reading")
    train: Annotated[int, Ge(20)] = 800
    test: Annotated[int, Ge(10)] = 400
    seeds: Annotated[Sequence[int], MinLen(1)] = (0, 1, 2)
    layouts: Annotated[int, Ge(1)] = 3
    levels: Annotated[int, Ge(2)] = 8
    depth: Annotated[int, Ge(0)] = 2
    width: Annotated[int, Ge(2)] = 128
    epochs: Annotated[int, Ge(1)] = 50
    graph: Mapping[str, Any] = field(default_factory=lambda: {"edges": "knn", "count": 6, "weight": "exp"})

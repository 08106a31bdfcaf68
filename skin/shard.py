"""Shards: parts of the jobs of a multirun or a study, for the tasks of a job array."""

import os
import re
from collections.abc import Iterable
from dataclasses import dataclass

from hydra.core.hydra_config import HydraConfig

from skin.errors import InputError

PARENT = "SKIN_PARENT_RUN"
"""Environment variable by which a sweep tells its jobs the id of their parent run."""

LEFT_OUT = "SKIN_LEFT_OUT"
"""Environment variable with the numbers of the jobs of a multirun that belong to other shards."""


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count`` disjoint parts that together are complete.

    Attributes:
        number: of this part, from 1.
        count: number of parts.
    """

    number: int
    count: int

    @classmethod
    def parse(cls, text: str) -> "Shard":
        """Return the shard that a setting names, such as ``3/8``.

        Raises:
            InputError: the text names no shard.
        """
        found = re.fullmatch(r"([0-9]+)/([0-9]+)", text)
        number, count = map(int, found.groups()) if found else (0, 0)
        if not 1 <= number <= count:
            raise InputError(
                f"shard={text} names no part: give i/n with i from 1 to n, as in shard=3/8; an array that "
                "counts from 0 needs i + 1"
            )
        return cls(number, count)

    def part(self, names: Iterable[str]) -> set[str]:
        """Return every ``count``-th of the different names, sorted, from this shard's number on.

        The order of the names does not matter. Names that are fingerprints of runs mix cheap and expensive
        ones, and runs that several jobs have in common are in one part.
        """
        return set(sorted(set(names))[self.number - 1 :: self.count])


def left_out() -> bool:
    """Return whether the running job of a multirun belongs to another shard."""
    return str(HydraConfig.get().job.num) in os.environ.get(LEFT_OUT, "").split()

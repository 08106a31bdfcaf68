"""Independent random generators, one per purpose."""

from enum import IntEnum

import numpy as np

from skin.errors import InputError

Stream = IntEnum(
    "Stream",
    {
        "BUDGET": 1,
        "FRESH": 2,
        "TEST": 3,
        "SPLIT": 4,
        "CONSTANTS": 5,
        "NOISE": 6,
        "POSITION": 7,
        "ALARM": 10,
        "PLACEMENT": 11,
        "SKIN": 12,
        "SKIN_ORDER": 13,
        "DESIGN": 14,
    },
)
"""What randomness is for; the test gestures have a stream that takes no seed of a training."""


def generator(stream: Stream, *key: int) -> np.random.Generator:
    """Return the generator of a stream at a key, such as (seed, epoch, batch).

    Raises:
        InputError: a number of the key is negative.
    """
    if min(key, default=0) < 0:
        raise InputError(f"seeds and epochs must be whole numbers from 0 up, got {min(key)}")
    # numpy pads short keys with zeros, so the length keeps (1,) and (1, 0) apart.
    return np.random.default_rng(np.random.SeedSequence([stream, len(key), *key]))

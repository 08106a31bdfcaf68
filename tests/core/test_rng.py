"""Streams of randomness that never meet."""

import itertools

import pytest

from skin.core.rng import Stream, generator
from skin.errors import InputError


def test_a_key_is_a_stream_and_keys_never_meet():
    """Short keys too: numpy pads them with zeros."""
    keys = [key for length in range(4) for key in itertools.product(range(3), repeat=length)]
    first = {generator(stream, *key).integers(2**63) for stream in Stream for key in keys}
    assert len(first) == len(keys) * len(Stream)
    one, same = generator(Stream.TEST, 3, 1), generator(Stream.TEST, 3, 1)
    assert (one.random(5) == same.random(5)).all()


def test_negative_seeds_are_refused():
    with pytest.raises(InputError, match="from 0 up, got -1"):
        generator(Stream.BUDGET, -1)

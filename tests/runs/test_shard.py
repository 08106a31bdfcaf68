"""Shards are disjoint, complete and the same everywhere."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from skin.errors import InputError
from skin.runs.sweep import Shard

NAMES = [f"{number:016x}" for number in range(60)]


@given(st.lists(st.text()), st.integers(1, 20))
def test_parts_are_disjoint_complete_and_of_equal_size(names, count):
    parts = [Shard(number, count).part(names) for number in range(1, count + 1)]
    assert sorted(name for part in parts for name in part) == sorted(set(names))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


@given(st.permutations(NAMES))
def test_the_order_of_the_jobs_does_not_matter(names):
    assert Shard(3, 8).part(names) == {NAMES[number] for number in range(2, 60, 8)}


def test_a_run_that_several_jobs_have_in_common_is_in_one_part():
    assert [Shard(number, 2).part(["b", "a", "b"]) for number in (1, 2)] == [{"a"}, {"b"}]


@pytest.mark.parametrize("text", ["0/8", "9/8", "3", "3/", "a/8", "-1/8", "1/0", "3/8/2", "", "1.0/2", "١/٢"])
def test_what_names_no_part_is_refused(text):
    with pytest.raises(InputError, match="names no part: give i/n with i from 1 to n, as in shard=3/8"):
        Shard.parse(text)


def test_a_shard_is_written_as_number_and_count():
    assert Shard.parse("3/8") == Shard(3, 8)

"""Damaged and hostile copies of files, for property tests."""

import copy
import os
import re
from collections.abc import Callable
from typing import Any, TypeVar

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st

from skin.errors import InputError

Content = TypeVar("Content")
DAMAGED_FILES = settings(
    max_examples=int(os.environ.get("DAMAGED", "100")),
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
"""The same files in every run of the tests: 100, or as many as ``make slow`` says."""

_NUMBER = re.compile(rb"-?\d+(\.\d+)?(e-?\d+)?")
_ODD = (
    b"-1", b"0", b"7", b"1e300", b"1e999", b"-1e-320", b"nan", b"Infinity", b".inf", b"1000000000", b"null",
    b"true", b'"x"', b"[]", b"{}", b"''", b"9" * 5000, b"[[[[", b"*a", b"!!python/name:os", b"\n",
)  # fmt: skip
ODD_VALUES = st.sampled_from(
    (None, True, False, 0, -1, 0.5, 10**9, 2**63, 10**400, 1e300, -1e300, 1e-320, float("nan"), float("inf"))
) | st.sampled_from(
    ("", "x", "1", "../x", "${x}", "\0", "é" * 300, [], [1], ["x"], [[]], {}, {"x": 1}, [None] * 3)
)
"""Values that hardly any setting takes."""

_KINDS = ("flip", "overwrite", "insert", "delete", "repeat", "truncate", "swap", "number")


@st.composite
def damaged(draw: Callable[..., Any], content: bytes) -> bytes:
    """Draw a copy of a file with one to three places damaged; it differs from the file."""
    result = content
    for _ in range(draw(st.integers(1, 3))):
        result = _damage(draw(st.sampled_from(_KINDS)), draw, result) or b"\0"
    return result if result != content else content[:-1]


def _damage(kind: str, draw: Callable[..., Any], content: bytes) -> bytes:
    """Damage a part of a file, often a short one."""
    start = draw(st.integers(0, max(0, len(content) - 1)))
    end = start + draw(st.integers(1, 8) | st.integers(1, max(1, len(content) // 2)))
    before, part, after = content[:start], content[start:end], content[end:]
    if kind == "flip":
        return before + bytes([content[start] ^ 1 << draw(st.integers(0, 7))]) + content[start + 1 :]
    if kind == "overwrite":
        new = draw(st.binary(min_size=1, max_size=12) | st.sampled_from((b"\0" * 64, b"\xff" * 16)))
        return before + new + content[start + len(new) :]
    if kind == "insert":
        return before + draw(st.binary(min_size=1, max_size=12)) + part + after
    if kind == "swap":  # two neighbouring parts
        middle = len(part) // 2
        return before + part[middle:] + part[:middle] + after
    if kind == "number":  # as far as there is text
        positions = [position.span() for position in _NUMBER.finditer(content[: 1 << 14])] or [(start, end)]
        start, end = draw(st.sampled_from(positions))
        return content[:start] + draw(st.sampled_from(_ODD)) + content[end:]
    return {"delete": before + after, "repeat": before + part + part + after, "truncate": before}[kind]


@st.composite
def mutated(draw: Callable[..., Any], content: Any) -> Any:
    """Draw a copy of nested containers with an entry removed, renamed or replaced by an odd value."""
    whole = [copy.deepcopy(content)]  # in a list, so that the root is an entry too
    for _ in range(draw(st.integers(1, 2))):
        container, key = draw(st.sampled_from(_entries(whole)))
        change = draw(st.sampled_from(("replace", "replace", "remove", "rename")))
        if change == "replace" or container is whole:
            container[key] = copy.deepcopy(draw(ODD_VALUES))
        else:
            value = container.pop(key)
            if change == "rename" and isinstance(container, dict):
                container[f"{key}s"] = value
    return whole[0]


def _entries(value: Any) -> list[tuple[Any, Any]]:
    """Return every container with each of its keys, however deep."""
    if not isinstance(value, dict | list):
        return []
    keys = list(value) if isinstance(value, dict) else list(range(len(value)))
    return [(value, key) for key in keys] + [entry for key in keys for entry in _entries(value[key])]


def opened(read: Callable[[], Content]) -> Content | None:
    """Return what a file holds; None if it is refused with one sentence. Every other error is a failure."""
    try:
        return read()
    except InputError as error:
        text = str(error)
        assert text.strip(), "a refusal without a reason"
        assert "\n" not in text, text
        assert len(text) < 2000, text[:2000]
        return None

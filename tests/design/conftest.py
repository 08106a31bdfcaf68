"""Commands as a person runs them."""

from tests.commands.conftest import run  # noqa: F401

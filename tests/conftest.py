"""What all tests share."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """Keep operators of tests apart from the user's; commands that tests start inherit the variable."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKIN_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield

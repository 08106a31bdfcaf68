"""Every command as a person starts it: a mistake is answered at once, in one sentence."""

import pytest

from skin.__main__ import verbs


@pytest.mark.parametrize("verb", verbs())
def test_a_mistake_waits_for_no_heavy_import(verb, light, tmp_path):
    done = light(tmp_path, verb, "typo=1")
    assert (done.returncode, done.stdout) == (2, "\n"), done.stderr
    assert "typo" in done.stderr
    assert "Traceback" not in done.stderr

"""Commands as a person runs them."""

import sqlite3
from contextlib import closing

import pytest


@pytest.fixture(scope="session")
def run(run):
    """Return ``run`` of all tests, which expects an exit code here; 2 comes without a traceback."""

    def checked(folder, script, *words, code=0, **settings):
        done = run(folder, script, *words, **settings)
        assert code in (done.returncode, None), done.stdout + done.stderr
        assert code != 2 or "Traceback" not in done.stderr, done.stderr
        return done

    return checked


def query(folder, *statement):
    """Return the rows that a statement finds in the store of a folder."""
    with closing(sqlite3.connect(folder / "m.db")) as database, database:
        return database.execute(*statement).fetchall()

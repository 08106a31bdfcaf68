"""What is logged while a tracking server is away is kept, and uploaded in order."""

import json
import logging
import socket
import time

import pytest
from mlflow import MlflowClient
from mlflow.entities import Metric
from mlflow.exceptions import MlflowException, RestException

from skin.config import Tracking
from skin.errors import InputError
from skin.outbox import OutboxClient
from skin.server import answers
from skin.tracking import Store

# MLflow's own business with SQLAlchemy.
pytestmark = pytest.mark.filterwarnings("ignore:The ``noload`` loader strategy")


class Server:
    """Accepts connections while it is there; its runs are in a SQLite database.

    Args:
        folder: of the database.
    """

    def __init__(self, folder):
        self.store = Store.open(Tracking(f"sqlite:///{folder}/m.db", f"{folder}/a", "skin", True, None))
        self.run = self.store.create("a run", {}).info.run_id
        self.socket = socket.create_server(("127.0.0.1", 0))
        self.uri = f"http://127.0.0.1:{self.socket.getsockname()[1]}"
        self.kept = folder / "kept"

    def client(self):
        """Return a client that believes to talk to a server."""
        client = OutboxClient(self.uri, self.kept)
        client._tracking_client = MlflowClient(self.store.uri)._tracking_client
        return client

    def losses(self):
        return [(one.step, one.value) for one in self.store.client.get_metric_history(self.run, "loss")]


@pytest.fixture
def server(tmp_path):
    server = Server(tmp_path)
    yield server
    server.socket.close()


def loss(step):
    return [Metric("loss", 0.5 * step, 1000 + step, step)]


def test_a_server_that_answers_gets_everything_at_once(server):
    client = server.client()
    client.log_batch(server.run, loss(0))
    client.log_text(server.run, "hello", "folder/note.txt")
    client.set_terminated(server.run)
    assert server.losses() == [(0, 0.0)]
    assert [one.path for one in client.list_artifacts(server.run, "folder")] == ["folder/note.txt"]
    assert client.get_run(server.run).info.status == "FINISHED"
    assert not server.kept.exists()


def test_what_is_logged_without_the_server_is_uploaded_later(server, caplog, tmp_path):
    client = server.client()
    client.log_batch(server.run, loss(0))
    server.socket.close()
    client._seen = -1e9  # more than 5 s ago
    began = time.monotonic()
    client.log_batch(server.run, loss(1))
    assert time.monotonic() - began < 10
    assert "does not answer: run " in caplog.text
    caplog.clear()
    client.set_tag(server.run, "learned", "weights.pt")
    client.log_text(server.run, "hello", "note.txt")
    (tmp_path / "made").mkdir()
    (tmp_path / "made" / "predictions.parquet").write_bytes(b"p")
    client.log_artifacts(server.run, str(tmp_path / "made"))
    client.set_terminated(server.run, "FINISHED")
    assert not caplog.text  # said once
    assert (server.losses(), client.get_run(server.run).info.status) == ([(0, 0.0)], "RUNNING")
    server.client().upload()
    found = client.get_run(server.run)
    assert server.losses() == [(0, 0.0), (1, 0.5)]
    assert (found.info.status, found.data.tags["learned"]) == ("FINISHED", "weights.pt")
    assert {one.path for one in client.list_artifacts(server.run)} == {"note.txt", "predictions.parquet"}
    assert not list(server.kept.glob("*/"))


def test_a_connection_that_breaks_keeps_the_entry_and_an_error_of_the_server_does_not(server, monkeypatch):
    client, send, refused = server.client(), OutboxClient._send, RestException({"message": "no such run"})
    for error in (MlflowException("API request to http://x failed with exception"), refused):
        monkeypatch.setattr(OutboxClient, "_send", lambda *_, error=error: (_ for _ in ()).throw(error))
        if error is refused:
            with pytest.raises(RestException, match="no such run"):
                client.log_batch(server.run, loss(5))
        else:
            client.log_batch(server.run, loss(3))
            monkeypatch.setattr(OutboxClient, "_send", send)
            client.log_batch(server.run, loss(4))  # after the one that is kept
            assert server.losses() == []
            client.upload()
            assert server.losses() == [(3, 1.5), (4, 2.0)]


def test_a_cut_off_line_is_left_out_and_what_the_server_refuses_stays(server, caplog):
    server.socket.close()
    client = server.client()
    client.log_batch(server.run, loss(1))
    client.set_tag("unknown", "a", "b")
    with (server.kept / server.run / "log.jsonl").open("a") as log:
        log.write(json.dumps({"tags": [["late", "x"]]})[:-3])
    with caplog.at_level(logging.WARNING):
        client.upload()
    assert "run unknown" in caplog.text
    assert server.losses() == [(1, 0.5)]
    assert [path.name for path in server.kept.glob("*/")] == ["unknown"]


def test_a_start_without_the_server_is_refused_within_ten_seconds(server):
    server.socket.close()
    began = time.monotonic()
    assert not answers(server.uri)
    with pytest.raises(InputError, match=r"the tracking server http://127.0.0.1:[0-9]+ does not answer"):
        Store.open(Tracking(server.uri, None, "skin", True, None))
    assert time.monotonic() - began < 10

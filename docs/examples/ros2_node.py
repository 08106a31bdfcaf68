"""ROS 2 node that starts ``skin live`` and publishes its verdicts.

Topics: ~/verdict (std_msgs/String, the JSON line), ~/contacts (std_msgs/String, its contacts), ~/danger,
~/unknown and ~/stale (std_msgs/Bool). Without danger, the skin is safe only where ~/unknown is false.
Parameter: command, the words of ``skin live``. Without lines all is unknown and stale, which clears no alarm.
"""

import json
import subprocess
from contextlib import suppress
from datetime import datetime
from queue import Empty, Queue
from threading import Event, Thread
from time import time

import rclpy
from rclpy.node import Node
from std_msgs.msg import Bool, String

SCHEMA, SILENCE = 1, 1.0  # s; skin live prints a line every 0.5 s or more often


class SkinNode(Node):
    """Reads the JSON lines of ``skin live`` in a thread and publishes them in another."""

    def __init__(self) -> None:
        super().__init__("skin")
        command = self.declare_parameter("command", ["skin", "live", "device=serial"]).value
        texts, states = ("verdict", "contacts"), ("danger", "unknown", "stale")
        self._verdict, self._contacts = (self.create_publisher(String, f"~/{name}", 10) for name in texts)
        flags = (self.create_publisher(Bool, f"~/{name}", 10) for name in states)
        self._danger, self._unknown, self._stale = flags
        self._over, self._lines = Event(), Queue()
        self._live = subprocess.Popen([*command, "live.verdicts=stdout"], stdout=subprocess.PIPE)
        Thread(target=self._read, daemon=True).start()
        self._thread = Thread(target=self._publish_lines, daemon=True)
        self._thread.start()

    def destroy_node(self) -> None:
        self._over.set()
        self._live.terminate()
        self._thread.join(2 * SILENCE)
        super().destroy_node()

    def _read(self) -> None:
        with self._live:  # its output is closed at the end
            for line in self._live.stdout:
                self._lines.put(line)

    def _publish_lines(self) -> None:
        while not self._over.is_set():
            try:
                line = self._lines.get(timeout=SILENCE)
                self._publish(json.loads(line), line.decode().strip())
            except Empty:
                self._lose(f"no line for {SILENCE} s; exit code of skin live: {self._live.poll()}")
            except (ValueError, LookupError, TypeError) as error:
                self._lose(f"not a line of skin live: {error!r}")

    def _lose(self, reason: str) -> None:
        for flag in (self._unknown, self._stale):
            flag.publish(Bool(data=True))
        lost = {"state": "unknown", "reason": reason, "contacts": []}
        self._contacts.publish(String(data=json.dumps(lost)))
        self.get_logger().warning(f"no verdicts: {reason}")

    def _publish(self, message: dict, line: str) -> None:
        if message["schema"] != SCHEMA:
            raise ValueError(f"schema {message['schema']}, this node reads {SCHEMA}")
        late = datetime.fromisoformat(message["time"].replace("Z", "+00:00")).timestamp() < time() - SILENCE
        self._verdict.publish(String(data=line))
        self._contacts.publish(String(data=json.dumps(message["contacts"])))
        self._danger.publish(Bool(data=message["alarm"]))
        self._unknown.publish(Bool(data=late or message["state"] == "unknown"))
        self._stale.publish(Bool(data=late or message["stale"]))


def main() -> None:
    rclpy.init()
    node = SkinNode()
    try:
        with suppress(KeyboardInterrupt):
            rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

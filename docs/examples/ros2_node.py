"""ROS 2 node that publishes the verdicts of ``skin live ... live.verdicts=7777``.

Topics: ~/verdict (std_msgs/String, the JSON line), ~/contacts (std_msgs/String, its field contacts: place,
force and 90 % region of each), ~/danger, ~/unknown and ~/stale (std_msgs/Bool). Without danger, the skin is
safe only where ~/unknown is false. Parameters: host, port. A lost connection makes all data unknown or stale.
It does not clear an alarm.
"""

import json
import socket
from threading import Event, Thread

import rclpy
from rclpy.node import Node
from std_msgs.msg import Bool, String

SCHEMA = 1
SILENCE = 1.5  # s; skin live sends a line every 0.5 s or more often


class SkinNode(Node):
    """Reads JSON lines in a thread and publishes them."""

    def __init__(self) -> None:
        super().__init__("skin")
        host = self.declare_parameter("host", "127.0.0.1").value
        port = self.declare_parameter("port", 7777).value
        self._address = host, port
        self._verdict, self._contacts = (
            self.create_publisher(String, f"~/{name}", 10) for name in ("verdict", "contacts")
        )
        self._danger, self._unknown, self._stale = (
            self.create_publisher(Bool, f"~/{name}", 10) for name in ("danger", "unknown", "stale")
        )
        self._over = Event()
        self._thread = Thread(target=self._read, daemon=True)
        self._thread.start()

    def destroy_node(self) -> None:
        """End the thread and the node."""
        self._over.set()
        self._thread.join(2 * SILENCE)
        super().destroy_node()

    def _read(self) -> None:
        while not self._over.is_set():
            try:
                with socket.create_connection(self._address, timeout=SILENCE) as connection:
                    for line in connection.makefile("rb"):
                        self._publish(json.loads(line), line.decode().strip())
                        if self._over.is_set():
                            return
                reason = "skin live has ended"
            except (OSError, ValueError) as error:
                reason = str(error)
            self._unknown.publish(Bool(data=True))
            self._stale.publish(Bool(data=True))
            lost = {"state": "unknown", "reason": reason, "contacts": []}
            self._contacts.publish(String(data=json.dumps(lost)))
            self.get_logger().warning(f"no verdicts from {self._address}: {reason}")
            self._over.wait(SILENCE)

    def _publish(self, message: dict, line: str) -> None:
        if message["schema"] != SCHEMA:
            raise ValueError(f"schema {message['schema']}, this node reads {SCHEMA}")
        self._verdict.publish(String(data=line))
        self._contacts.publish(String(data=json.dumps(message["contacts"])))
        self._danger.publish(Bool(data=message["alarm"]))
        self._unknown.publish(Bool(data=message["state"] == "unknown"))
        self._stale.publish(Bool(data=message["stale"]))


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    node = SkinNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

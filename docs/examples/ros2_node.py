"""ROS 2 node that publishes the verdicts of ``skin live ... live.verdicts=7777``.

Topics: ~/verdict (std_msgs/String, the JSON line), ~/danger, ~/unknown and ~/stale (std_msgs/Bool).
Without danger, the skin is safe only where ~/unknown is false. Parameters: host, port. A lost connection
makes the data stale and unknown. It does not clear an alarm.
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
        self._verdict = self.create_publisher(String, "~/verdict", 10)
        self._danger = self.create_publisher(Bool, "~/danger", 10)
        self._unknown = self.create_publisher(Bool, "~/unknown", 10)
        self._stale = self.create_publisher(Bool, "~/stale", 10)
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
            self.get_logger().warning(f"no verdicts from {self._address}: {reason}")
            self._over.wait(SILENCE)

    def _publish(self, message: dict, line: str) -> None:
        if message["schema"] != SCHEMA:
            raise ValueError(f"schema {message['schema']}, this node reads {SCHEMA}")
        self._verdict.publish(String(data=line))
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

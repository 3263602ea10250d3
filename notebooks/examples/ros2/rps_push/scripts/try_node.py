#!/usr/bin/env python3
"""Try push_node: inputs at 50 Hz, then one falls silent or is not finite; how soon is it zero?

ros2 run rps_push try_node.py 51   # taxels of the law's skin
"""

import math
import sys
import time

import rclpy
from geometry_msgs.msg import PointStamped, TwistStamped
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import Float32MultiArray


class Driver(Node):
    """What a robot would send, and what it is told."""

    def __init__(self, taxels: int) -> None:
        super().__init__("driver")
        self._heard = []  # (time [s], greatest of the twist)
        self.create_subscription(TwistStamped, "cmd_vel", self._hear, 10)
        self._odometry = self.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self._taxels = self.create_publisher(Float32MultiArray, "taxels", qos_profile_sensor_data)
        self._target = self.create_publisher(PointStamped, "target", qos_profile_sensor_data)
        self._state = self.create_client(ChangeState, "/push/change_state")
        pressed = {taxels // 2 - 1, taxels // 2}
        self._signal = [0.5 * (i in pressed) for i in range(taxels)]

    def _hear(self, message: TwistStamped) -> None:
        twist = message.twist
        parts = (twist.linear.x, twist.linear.y, twist.angular.z)
        self._heard.append((time.monotonic(), max(map(abs, parts))))

    def change(self, name: str, number: int) -> None:
        """Ask the node for a transition."""
        if not self._state.wait_for_service(10.0):
            sys.exit("no node `push` answers")
        asked = ChangeState.Request(transition=Transition(id=number))
        answer = self._state.call_async(asked)
        rclpy.spin_until_future_complete(self, answer, timeout_sec=5)
        print(f"{name}: {answer.result() and answer.result().success}")

    def send(self, what: str, seconds: float, *, skin: bool = True, x: float = 0.0) -> None:
        """Send inputs for some seconds, and say what was commanded."""
        begun = time.monotonic()
        while time.monotonic() < begun + seconds:
            pose, target = Odometry(), PointStamped()
            pose.pose.pose.orientation.w, pose.pose.pose.position.x = 1.0, x
            target.point.x, target.point.y = 2.0, 0.5
            self._odometry.publish(pose)
            self._target.publish(target)
            if skin:
                self._taxels.publish(Float32MultiArray(data=self._signal))
            until = time.monotonic() + 0.02
            while time.monotonic() < until:
                rclpy.spin_once(self, timeout_sec=0.002)
        since = [(when, size) for when, size in self._heard if when >= begun]
        moving = [when - begun for when, size in since if size > 0]
        last = f", the last that moved after {1000 * moving[-1]:.0f} ms" if moving else ""
        print(f"{what}: {len(since)} commands, {len(moving)} of them moved{last}")


def main() -> None:
    """Configure and activate the node, and try it."""
    rclpy.init()
    driver = Driver(int(sys.argv[1]))
    driver.change("configured", Transition.TRANSITION_CONFIGURE)
    driver.change("activated", Transition.TRANSITION_ACTIVATE)
    driver.send("all inputs", 3.0)
    driver.send("the skin is silent", 1.0, skin=False)
    driver.send("the skin is back", 1.0)
    driver.send("odometry is not a number", 1.0, x=math.nan)
    driver.change("deactivated", Transition.TRANSITION_DEACTIVATE)
    driver.send("inactive", 0.5)


if __name__ == "__main__":
    main()

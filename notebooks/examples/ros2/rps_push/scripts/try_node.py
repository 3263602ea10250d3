#!/usr/bin/env python3
"""Test the watchdog of push_node: inputs at 50 Hz, of which one stops or is not finite.

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
    """Simulated robot that publishes inputs and records commands."""

    def __init__(self, taxels: int) -> None:
        super().__init__("driver")
        self._commands = []  # (time [s], largest component)
        self.create_subscription(TwistStamped, "cmd_vel", self._record, 10)
        self._odometry = self.create_publisher(Odometry, "odom", qos_profile_sensor_data)
        self._taxels = self.create_publisher(Float32MultiArray, "taxels", qos_profile_sensor_data)
        self._target = self.create_publisher(PointStamped, "target", qos_profile_sensor_data)
        self._state = self.create_client(ChangeState, "/push/change_state")
        pressed = {taxels // 2 - 1, taxels // 2}
        self._signal = [0.5 * (i in pressed) for i in range(taxels)]

    def _record(self, message: TwistStamped) -> None:
        twist = message.twist
        parts = (twist.linear.x, twist.linear.y, twist.angular.z)
        self._commands.append((time.monotonic(), max(map(abs, parts))))

    def change(self, name: str, transition: int) -> None:
        """Request a transition of the node."""
        if not self._state.wait_for_service(10.0):
            sys.exit("no node `push` is running")
        request = ChangeState.Request(transition=Transition(id=transition))
        answer = self._state.call_async(request)
        rclpy.spin_until_future_complete(self, answer, timeout_sec=5)
        print(f"{name}: {answer.result() and answer.result().success}")

    def send(self, label: str, seconds: float, *, skin: bool = True, x: float = 0.0) -> None:
        """Send inputs for some seconds, and print the commands."""
        start = time.monotonic()
        while time.monotonic() < start + seconds:
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
        commands = [(when, size) for when, size in self._commands if when >= start]
        moving = [when - start for when, size in commands if size > 0]
        last = f", the last of them after {1000 * moving[-1]:.0f} ms" if moving else ""
        print(f"{label}: {len(commands)} commands, {len(moving)} of them move the base{last}")


def main() -> None:
    """Configure and activate the node, and test it."""
    rclpy.init()
    driver = Driver(int(sys.argv[1]))
    driver.change("configured", Transition.TRANSITION_CONFIGURE)
    driver.change("activated", Transition.TRANSITION_ACTIVATE)
    driver.send("all inputs", 3.0)
    driver.send("no taxels", 1.0, skin=False)
    driver.send("taxels again", 1.0)
    driver.send("odometry is not a number", 1.0, x=math.nan)
    driver.change("deactivated", Transition.TRANSITION_DEACTIVATE)
    driver.send("inactive", 0.5)


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""Lifecycle node around the controller in Python: odometry, taxels and target in, twist out."""

import dataclasses
import math
import time

import rclpy
from geometry_msgs.msg import PointStamped, TwistStamped
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rps_push.controller import Command, Controller, Limits
from std_msgs.msg import Float32MultiArray

# Meaning with unit, and range, of each parameter.
PARAMETERS = {
    "v_max": ("greatest speed in any direction [m/s]", 0.0, 1.0),
    "omega_max": ("greatest turning rate [rad/s]", 0.0, 3.0),
    "a_max": ("greatest change of the velocity in a second [m/s^2]", 0.01, 10.0),
    "alpha_max": ("greatest change of the turning rate [rad/s^2]", 0.01, 30.0),
    "odometry_age": ("silence of odometry that stops the base [s]", 0.01, 0.08),
    "taxels_age": ("silence of the skin that stops the base [s]", 0.01, 0.08),
    "target_age": ("silence of the target that stops the base [s]", 0.01, 0.08),
}


class PushNode(LifecycleNode):
    def __init__(self) -> None:
        super().__init__("push")
        usual = Limits()
        for name, (about, least, most) in PARAMETERS.items():
            allowed = FloatingPointRange(from_value=least, to_value=most)
            described = ParameterDescriptor(description=about, floating_point_range=[allowed])
            self.declare_parameter(name, getattr(usual, name), described)
        self._timer, self._status, self._heard = None, "", []

    def on_configure(self, state):
        names = [field.name for field in dataclasses.fields(Limits)]
        limits = Limits(**{name: self.get_parameter(name).value for name in names})
        self._controller = Controller(limits)
        self._twists = self.create_lifecycle_publisher(TwistStamped, "cmd_vel", 1)
        for kind, topic, heard in (
            (Odometry, "odom", self._odometry),
            (Float32MultiArray, "taxels", self._taxels),
            (PointStamped, "target", self._target),
        ):
            made = self.create_subscription(kind, topic, heard, qos_profile_sensor_data)
            self._heard.append(made)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        self._controller.reset()
        self._timer = self.create_timer(0.02, lambda: self._send(self._controller.tick(now())))
        return super().on_activate(state)

    def on_deactivate(self, state):
        self.destroy_timer(self._timer)
        self._send(Command())
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        for made in self._heard:
            self.destroy_subscription(made)
        self._heard = []
        self.destroy_publisher(self._twists)
        return TransitionCallbackReturn.SUCCESS

    def _odometry(self, message):
        pose, q = message.pose.pose, message.pose.pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        self._controller.odometry(now(), pose.position.x, pose.position.y, yaw)

    def _taxels(self, message):
        expected = self._controller.taxels
        if len(message.data) != expected:
            said = f"{len(message.data)} taxels instead of {expected}"
            self.get_logger().error(said, throttle_duration_sec=1.0)
        self._controller.skin(now(), message.data)

    def _target(self, message):
        self._controller.target(now(), message.point.x, message.point.y)

    def _send(self, command):
        message = TwistStamped()
        message.header.stamp = self.get_clock().now().to_msg()
        message.header.frame_id = "base_link"
        message.twist.linear.x, message.twist.linear.y = command.v_x, command.v_y
        message.twist.angular.z = command.omega
        self._twists.publish(message)
        if command.status != self._status:
            self.get_logger().info(command.status)
        self._status = command.status


def now() -> float:
    return time.monotonic()


def main() -> None:
    rclpy.init()
    node = PushNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

#!/usr/bin/env python3
"""Lifecycle node around the controller in Python: inputs of a robot in, twist out."""

import dataclasses
import math
import time

import rclpy
from geometry_msgs.msg import PointStamped, PoseStamped, TwistStamped
from nav_msgs.msg import Odometry, Path
from rcl_interfaces.msg import FloatingPointRange, ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from rps_push.controller import Command, Controller, Limits
from std_msgs.msg import Float32MultiArray

from rps_jax import Robot
from rps_jax.worlds import CapacitiveSkin

# Meaning with unit, and range, of each parameter.
PARAMETERS = {
    "v_max": ("largest speed in any direction [m/s]", 0.0, 1.0),
    "omega_max": ("largest turning rate [rad/s]", 0.0, 3.0),
    "a_max": ("largest change of the velocity in a second [m/s^2]", 0.01, 10.0),
    "alpha_max": ("largest change of the turning rate [rad/s^2]", 0.01, 30.0),
    "odometry_age": ("time without odometry that stops the base [s]", 0.01, 0.08),
    "taxels_age": ("time without taxels that stops the base [s]", 0.01, 0.08),
    "target_age": ("time without target that stops the base [s]", 0.01, 0.08),
    "path_age": ("time without path that stops the base [s]", 0.01, 10.0),
    "lookahead": ("lookahead on the path [m]", 0.05, 5.0),
}


class PushNode(LifecycleNode):
    def __init__(self) -> None:
        super().__init__("push")
        defaults = Limits()
        for name, (description, low, high) in PARAMETERS.items():
            allowed = FloatingPointRange(from_value=low, to_value=high)
            descriptor = ParameterDescriptor(
                description=description, floating_point_range=[allowed]
            )
            self.declare_parameter(name, getattr(defaults, name), descriptor)
        self.declare_parameter("law", "rps_plus", ParameterDescriptor(description="the law"))
        self.declare_parameter("robot", "ideal", ParameterDescriptor(description="name or file"))
        self._timer, self._status, self._subscriptions = None, "", []

    def on_configure(self, state):
        names = [field.name for field in dataclasses.fields(Limits)]
        limits = Limits(**{name: self.get_parameter(name).value for name in names})
        law, robot = (self.get_parameter(name).value for name in ("law", "robot"))
        skin = CapacitiveSkin()._replace(shell=Robot.parse(robot).shell)
        self._controller = Controller(limits, law, skin, robot)
        if Robot.parse(robot).drive != "omni":
            self.get_logger().warning(
                "the base also drives in reverse, where the skin senses nothing: "
                "stop it there by a scanner or a bumper"
            )
        self._twists = self.create_lifecycle_publisher(TwistStamped, "cmd_vel", 1)
        for kind, topic, callback in (
            (Odometry, "odom", self._odometry),
            (Float32MultiArray, "taxels", self._taxels),
            (PointStamped, "target", self._target),
            (PoseStamped, "goal", self._goal),
            (Path, "path", self._path),
        ):
            subscription = self.create_subscription(kind, topic, callback, qos_profile_sensor_data)
            self._subscriptions.append(subscription)
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state):
        self._controller.reset()
        self._timer = self.create_timer(0.02, lambda: self._send(self._controller.tick(clock())))
        return super().on_activate(state)

    def on_deactivate(self, state):
        self.destroy_timer(self._timer)
        self._send(Command())
        return super().on_deactivate(state)

    def on_cleanup(self, state):
        for subscription in self._subscriptions:
            self.destroy_subscription(subscription)
        self._subscriptions = []
        self.destroy_publisher(self._twists)
        return TransitionCallbackReturn.SUCCESS

    def _odometry(self, message):
        pose, q = message.pose.pose, message.pose.pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        self._controller.odometry(clock(), pose.position.x, pose.position.y, yaw)

    def _taxels(self, message):
        expected = self._controller.taxels
        if len(message.data) != expected:
            error = f"{len(message.data)} taxels instead of {expected}"
            self.get_logger().error(error, throttle_duration_sec=1.0)
        self._controller.skin(clock(), message.data)

    def _target(self, message):
        self._controller.target(clock(), message.point.x, message.point.y)

    def _goal(self, message):
        p, q = message.pose.position, message.pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z))
        self._controller.goal(clock(), p.x, p.y, yaw)

    def _path(self, message):
        points = [(pose.pose.position.x, pose.pose.position.y) for pose in message.poses]
        self._controller.path(clock(), points)

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


def clock() -> float:
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

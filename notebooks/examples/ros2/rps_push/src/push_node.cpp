// Lifecycle node around the controller: from odometry, taxels and a target or path to a twist.
#include <chrono>
#include <cmath>
#include <memory>
#include <string>
#include <vector>

#include "geometry_msgs/msg/point_stamped.hpp"
#include "geometry_msgs/msg/pose_stamped.hpp"
#include "geometry_msgs/msg/twist_stamped.hpp"
#include "nav_msgs/msg/odometry.hpp"
#include "nav_msgs/msg/path.hpp"
#include "rclcpp/rclcpp.hpp"
#include "rclcpp_lifecycle/lifecycle_node.hpp"
#include "rps_push/controller.hpp"
#include "std_msgs/msg/float32_multi_array.hpp"

using CallbackReturn = rclcpp_lifecycle::node_interfaces::LifecycleNodeInterface::CallbackReturn;

class PushNode : public rclcpp_lifecycle::LifecycleNode {
 public:
  PushNode() : LifecycleNode("push") {
    number("v_max", "largest speed in any direction [m/s]", 0.05, 0.0, 1.0);
    number("omega_max", "largest turning rate [rad/s]", 0.15, 0.0, 3.0);
    number("a_max", "largest change of the velocity in a second [m/s^2]", 0.5, 0.01, 10.0);
    number("alpha_max", "largest change of the turning rate [rad/s^2]", 1.0, 0.01, 30.0);
    number("odometry_age", "time without odometry that stops the base [s]", 0.08, 0.01, 0.08);
    number("taxels_age", "time without taxels that stops the base [s]", 0.08, 0.01, 0.08);
    number("target_age", "time without target that stops the base [s]", 0.08, 0.01, 0.08);
    number("path_age", "time without path that stops the base [s]", 2.0, 0.01, 10.0);
    number("lookahead", "lookahead on the path [m]", 1.0, 0.05, 5.0);
    number("rate", "commands in a second [Hz]", 50.0, 50.0, 1000.0);
  }

  CallbackReturn on_configure(const rclcpp_lifecycle::State &) override {
    rps_push::Limits limits;
    limits.v_max = get_parameter("v_max").as_double();
    limits.omega_max = get_parameter("omega_max").as_double();
    limits.a_max = get_parameter("a_max").as_double();
    limits.alpha_max = get_parameter("alpha_max").as_double();
    limits.odometry_age = get_parameter("odometry_age").as_double();
    limits.taxels_age = get_parameter("taxels_age").as_double();
    limits.target_age = get_parameter("target_age").as_double();
    limits.path_age = get_parameter("path_age").as_double();
    limits.lookahead = get_parameter("lookahead").as_double();
    controller_ = std::make_unique<rps_push::Controller>(limits);
    if (rps_push::has_axle)
      RCLCPP_WARN(get_logger(), "the base also drives in reverse, where the skin senses nothing: "
                                "stop it there by a scanner or a bumper");
    twists_ = create_publisher<geometry_msgs::msg::TwistStamped>("cmd_vel", 1);
    const auto latest = rclcpp::SensorDataQoS().keep_last(1);
    odometry_ = create_subscription<nav_msgs::msg::Odometry>(
        "odom", latest, [this](nav_msgs::msg::Odometry::ConstSharedPtr message) {
          const auto &pose = message->pose.pose;
          const auto &q = pose.orientation;
          const double yaw = std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
          controller_->odometry(seconds(), pose.position.x, pose.position.y, yaw);
        });
    taxels_ = create_subscription<std_msgs::msg::Float32MultiArray>(
        "taxels", latest, [this](std_msgs::msg::Float32MultiArray::ConstSharedPtr message) {
          if (message->data.size() != controller_->taxels())
            RCLCPP_ERROR_THROTTLE(get_logger(), *get_clock(), 1000, "%zu taxels instead of %zu",
                                  message->data.size(), controller_->taxels());
          controller_->skin(seconds(), message->data);
        });
    goal_ = create_subscription<geometry_msgs::msg::PoseStamped>(
        "goal", latest, [this](geometry_msgs::msg::PoseStamped::ConstSharedPtr message) {
          const auto &p = message->pose.position;
          const auto &q = message->pose.orientation;
          const double yaw =
              std::atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y * q.y + q.z * q.z));
          controller_->goal(seconds(), p.x, p.y, yaw);
        });
    target_ = create_subscription<geometry_msgs::msg::PointStamped>(
        "target", latest, [this](geometry_msgs::msg::PointStamped::ConstSharedPtr message) {
          controller_->target(seconds(), message->point.x, message->point.y);
        });
    path_ = create_subscription<nav_msgs::msg::Path>(
        "path", latest, [this](nav_msgs::msg::Path::ConstSharedPtr message) {
          std::vector<rps_push::Point> points;
          for (const auto &pose : message->poses)
            points.push_back({pose.pose.position.x, pose.pose.position.y});
          controller_->path(seconds(), points);
        });
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_activate(const rclcpp_lifecycle::State &state) override {
    LifecycleNode::on_activate(state);
    controller_->reset();
    const std::chrono::duration<double> period(1.0 / get_parameter("rate").as_double());
    timer_ = create_wall_timer(period, [this] { send(controller_->tick(seconds())); });
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_deactivate(const rclcpp_lifecycle::State &state) override {
    timer_.reset();
    send(rps_push::Command());
    LifecycleNode::on_deactivate(state);
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_cleanup(const rclcpp_lifecycle::State &) override {
    timer_.reset();
    odometry_.reset();
    taxels_.reset();
    goal_.reset();
    target_.reset();
    path_.reset();
    twists_.reset();
    controller_.reset();
    return CallbackReturn::SUCCESS;
  }

  CallbackReturn on_shutdown(const rclcpp_lifecycle::State &state) override {
    if (twists_ && twists_->is_activated()) send(rps_push::Command());
    return on_cleanup(state);
  }

 private:
  void number(const std::string &name, const std::string &about, double usual, double least,
              double most) {
    rcl_interfaces::msg::ParameterDescriptor described;
    described.description = about;
    described.floating_point_range.resize(1);
    described.floating_point_range[0].from_value = least;
    described.floating_point_range[0].to_value = most;
    declare_parameter(name, usual, described);
  }

  static double seconds() {
    const auto now = std::chrono::steady_clock::now().time_since_epoch();
    return std::chrono::duration<double>(now).count();
  }

  void send(const rps_push::Command &command) {
    geometry_msgs::msg::TwistStamped message;
    message.header.stamp = this->now();
    message.header.frame_id = "base_link";
    message.twist.linear.x = command.v_x;
    message.twist.linear.y = command.v_y;
    message.twist.angular.z = command.omega;
    twists_->publish(message);
    if (command.status != status_) RCLCPP_INFO(get_logger(), "%s", command.status.c_str());
    status_ = command.status;
  }

  std::unique_ptr<rps_push::Controller> controller_;
  rclcpp_lifecycle::LifecyclePublisher<geometry_msgs::msg::TwistStamped>::SharedPtr twists_;
  rclcpp::Subscription<nav_msgs::msg::Odometry>::SharedPtr odometry_;
  rclcpp::Subscription<std_msgs::msg::Float32MultiArray>::SharedPtr taxels_;
  rclcpp::Subscription<geometry_msgs::msg::PoseStamped>::SharedPtr goal_;
  rclcpp::Subscription<geometry_msgs::msg::PointStamped>::SharedPtr target_;
  rclcpp::Subscription<nav_msgs::msg::Path>::SharedPtr path_;
  rclcpp::TimerBase::SharedPtr timer_;
  std::string status_;
};

int main(int argc, char **argv) {
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<PushNode>()->get_node_base_interface());
  rclcpp::shutdown();
  return 0;
}

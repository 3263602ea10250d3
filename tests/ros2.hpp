// The parts of rclcpp and of the messages that `push_node.cpp` uses, as ROS 2 declares them.
#pragma once
#include <chrono>
#include <cstdint>
#include <functional>
#include <memory>
#include <string>
#include <vector>

#define MESSAGE(name) struct name { using ConstSharedPtr = std::shared_ptr<const name>;

namespace std_msgs::msg {
struct Header { std::int64_t stamp = 0; std::string frame_id; };
MESSAGE(Float32MultiArray) std::vector<float> data; };
}
namespace geometry_msgs::msg {
struct Point { double x, y, z; };
struct Quaternion { double x, y, z, w; };
struct Pose { Point position; Quaternion orientation; };
struct Twist { Point linear, angular; };
struct PoseWithCovariance { Pose pose; };
MESSAGE(PointStamped) std_msgs::msg::Header header; Point point; };
MESSAGE(PoseStamped) std_msgs::msg::Header header; Pose pose; };
MESSAGE(TwistStamped) std_msgs::msg::Header header; Twist twist; };
}
namespace nav_msgs::msg {
MESSAGE(Odometry) std_msgs::msg::Header header; geometry_msgs::msg::PoseWithCovariance pose; };
MESSAGE(Path) std_msgs::msg::Header header; std::vector<geometry_msgs::msg::PoseStamped> poses; };
}
namespace rcl_interfaces::msg {
struct FloatingPointRange { double from_value, to_value, step; };
struct ParameterDescriptor {
  std::string description;
  std::vector<FloatingPointRange> floating_point_range;
};
}
namespace rclcpp {
struct Logger {};
struct Clock {};
struct QoS { QoS(std::size_t); QoS &keep_last(std::size_t); };
struct SensorDataQoS : QoS { SensorDataQoS(); };
struct Parameter { double as_double() const; };
struct TimerBase { using SharedPtr = std::shared_ptr<TimerBase>; };
template <class M> struct Subscription { using SharedPtr = std::shared_ptr<Subscription>; };
void init(int, char **);
void shutdown();
void spin(std::shared_ptr<int> base);
}
namespace rclcpp_lifecycle {
struct State {};
namespace node_interfaces {
struct LifecycleNodeInterface {
  enum class CallbackReturn : std::uint8_t { SUCCESS = 97, FAILURE = 98, ERROR = 99 };
  virtual ~LifecycleNodeInterface() = default;
  virtual CallbackReturn on_configure(const State &);
  virtual CallbackReturn on_cleanup(const State &);
  virtual CallbackReturn on_shutdown(const State &);
  virtual CallbackReturn on_activate(const State &);
  virtual CallbackReturn on_deactivate(const State &);
};
}
template <class M> struct LifecyclePublisher {
  using SharedPtr = std::shared_ptr<LifecyclePublisher>;
  void publish(const M &);
  bool is_activated() const;
};
struct LifecycleNode : node_interfaces::LifecycleNodeInterface {
  using CallbackReturn = LifecycleNodeInterface::CallbackReturn;
  explicit LifecycleNode(const std::string &);
  double declare_parameter(
      const std::string &, const double &, const rcl_interfaces::msg::ParameterDescriptor &);
  rclcpp::Parameter get_parameter(const std::string &) const;
  rclcpp::Logger get_logger() const;
  std::shared_ptr<rclcpp::Clock> get_clock();
  std::int64_t now() const;
  std::shared_ptr<int> get_node_base_interface();
  template <class M>
  std::shared_ptr<LifecyclePublisher<M>> create_publisher(const std::string &, const rclcpp::QoS &);
  template <class M>
  std::shared_ptr<rclcpp::Subscription<M>> create_subscription(
      const std::string &, const rclcpp::QoS &, std::function<void(std::shared_ptr<const M>)>);
  template <class R, class P>
  rclcpp::TimerBase::SharedPtr create_wall_timer(
      std::chrono::duration<R, P>, std::function<void()>);
};
}
int log_line(const rclcpp::Logger &, const char *, ...) __attribute__((format(printf, 2, 3)));
#define RCLCPP_WARN(logger, ...) log_line(logger, __VA_ARGS__)
#define RCLCPP_INFO(logger, ...) log_line(logger, __VA_ARGS__)
#define RCLCPP_ERROR_THROTTLE(logger, clock, period, ...) \
  ((void)(clock), (void)(period), log_line(logger, __VA_ARGS__))

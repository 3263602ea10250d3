// Controller of a robot without ROS: from inputs with their times to a bounded twist.
//
// Times are seconds of one steady clock. The command is zero until odometry, taxels and target have
// arrived, when one of them stops or is not finite, and when the law returns an error; `status` has
// the reason. A stop is immediate: the limit of acceleration does not delay it.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "rps_push/law.h"

namespace rps_push {

// Of a base that cannot move sideways: the odometry is that of its axle, and so is the command.
#ifdef LAW_AXLE
constexpr bool has_axle = true;
constexpr double axle = LAW_AXLE;  // [m] behind the middle, whose pose the law gets
#else
constexpr bool has_axle = false;
constexpr double axle = 0;
#endif

struct Limits {
  double v_max = 0.05;         // [m/s] speed in any direction
  double omega_max = 0.15;     // [rad/s]
  double a_max = 0.5;          // [m/s^2] change of the velocity
  double alpha_max = 1.0;      // [rad/s^2]
  double odometry_age = 0.08;  // [s] after which an input counts as missing
  double taxels_age = 0.08;
  double target_age = 0.08;
  double path_age = 2.0;
  double lookahead = 1.0;  // [m] on the path, from the contact to the law's target
};

struct Point {
  double x = 0, y = 0;  // [m] in the frame of the odometry
};

struct Command {
  double v_x = 0, v_y = 0, omega = 0;  // [m/s], [m/s], [rad/s] in the robot frame
  std::string status = "waiting for odometry";
};

class Controller {
 public:
  explicit Controller(const Limits &limits) : limits_(limits) { reset(); }

  // Reset all states and inputs.
  void reset() {
    law_init(&params_, &memory_);
    law_skin_init(&skin_);
    odometry_ = taxels_ = target_ = path_time_ = -1e300;
    path_.clear();
    arc_ = 0;
    last_ = scanned_ = -1e300;
    sent_ = Command();
  }

  static constexpr std::size_t taxels() { return LAW_TAXELS; }

  void odometry(double time, double x, double y, double yaw) {
    if (!(std::isfinite(x) && std::isfinite(y) && std::isfinite(yaw))) return;
    obs_.p_world_robot[0] = static_cast<law_real>(x + axle * std::cos(yaw));
    obs_.p_world_robot[1] = static_cast<law_real>(y + axle * std::sin(yaw));
    obs_.yaw = static_cast<law_real>(yaw);
    odometry_ = time;
  }

  void target(double time, double x, double y) {
    if (!(std::isfinite(x) && std::isfinite(y))) return;
    obs_.p_world_target[0] = static_cast<law_real>(x);
    obs_.p_world_target[1] = static_cast<law_real>(y);
    target_ = time;
  }

  // Store a target [m] with the heading of the goal [rad], for a law that observes it.
  void goal(double time, double x, double y, double yaw) {
    if (!std::isfinite(yaw)) return;
    set_heading(obs_, yaw, 0);
    target(time, x, y);
  }

  // Store a path [m], which replaces the target; no point ends it. The same path again goes on, and
  // another one starts anew.
  void path(double time, const std::vector<Point> &points) {
    for (const Point &p : points)
      if (!(std::isfinite(p.x) && std::isfinite(p.y))) return;
    const auto same = [](const Point &a, const Point &b) { return a.x == b.x && a.y == b.y; };
    if (!std::equal(points.begin(), points.end(), path_.begin(), path_.end(), same)) arc_ = 0;
    path_ = points;
    path_time_ = time;
  }

  // Process one scan: relative changes of capacitance [1], along the strip.
  void skin(double time, const std::vector<float> &values) {
    if (values.size() != taxels()) return;
    law_real scan[LAW_TAXELS];
    for (std::size_t i = 0; i < taxels(); i++) scan[i] = static_cast<law_real>(values[i]);
    const double period = scanned_ > -1e299 ? time - scanned_ : 0.02;
    law_contact contact;
    const auto step = static_cast<law_real>(period);
    if (!(period > 0) || law_skin_step(&skin_params_, &skin_, scan, step, &contact) != LAW_OK)
      return;
    obs_.in_contact = contact.in_contact;
    obs_.p_robot_contact[0] = contact.p_robot_contact[0];
    obs_.p_robot_contact[1] = contact.p_robot_contact[1];
    set_taxels(obs_, contact, 0);
    set_ends(obs_, contact, 0);
    scanned_ = taxels_ = time;
  }

  // Return the command at a time [s].
  Command tick(double time) {
    const double period = last_ > -1e299 ? time - last_ : 0.02;
    last_ = time;
    Command command;
    command.status = missing_input(time);
    if (command.status.empty() && !(period > 0)) command.status = "the clock does not advance";
    if (!command.status.empty()) return sent_ = command;
    if (!path_.empty()) pursue();
    law_twist twist;
    obs_.period = static_cast<law_real>(period);
    if (const int code = law_step(&params_, &memory_, &obs_, &twist); code != LAW_OK) {
      command.status = "the law returns error " + std::to_string(code);
      return sent_ = command;
    }
    if (has_axle) twist.v_y = 0;
    const double speed = std::hypot(double(twist.v_x), double(twist.v_y));
    const double share = speed > limits_.v_max ? limits_.v_max / speed : 1.0;
    const double room = limits_.a_max * period, turn = limits_.alpha_max * period;
    const double x = share * twist.v_x - sent_.v_x, y = share * twist.v_y - sent_.v_y;
    const double change = std::hypot(x, y);
    const double part = change > room ? room / change : 1.0;
    const double omega = std::clamp(double(twist.omega), -limits_.omega_max, limits_.omega_max);
    command.v_x = sent_.v_x + part * x;
    command.v_y = sent_.v_y + part * y;
    command.omega = sent_.omega + std::clamp(omega - sent_.omega, -turn, turn);
    command.status = "pushing";
    return sent_ = command;
  }

 private:
  // For laws that observe taxels; other observations lack these fields.
  template <class Observation>
  static auto set_taxels(Observation &obs, const law_contact &contact, int)
      -> decltype(obs.signal[0], obs.line, void()) {
    std::copy(contact.signal, contact.signal + LAW_TAXELS, obs.signal);
    obs.line = contact.line;
  }
  template <class Observation>
  static void set_taxels(Observation &, const law_contact &, long) {}

  // For laws that observe the ends of contacts.
  template <class Observation, class Contact>
  static auto set_ends(Observation &obs, const Contact &contact, int)
      -> decltype(obs.ends[0], contact.ends[0], void()) {
    std::copy(contact.signal, contact.signal + LAW_TAXELS, obs.signal);
    std::copy(contact.alive, contact.alive + LAW_TAXELS, obs.alive);
    std::copy(contact.ends, contact.ends + 2, obs.ends);
    std::copy(contact.seen, contact.seen + 2, obs.seen);
    obs.even = contact.even;
    obs.front = contact.front;
  }
  template <class Observation, class Contact>
  static void set_ends(Observation &, const Contact &, long) {}

  // For laws that observe the heading of the goal.
  template <class Observation>
  static auto set_heading(Observation &obs, double yaw, int) -> decltype(obs.yaw_target, void()) {
    obs.yaw_target = static_cast<law_real>(yaw);
  }
  template <class Observation>
  static void set_heading(Observation &, double, long) {}

  // Set the target a lookahead ahead on the path, as `PathCourse.follow` of rps_jax does: from the
  // point nearest to the contact, within 1 m of the last one along the path.
  void pursue() {
    const double c = std::cos(double(obs_.yaw)), s = std::sin(double(obs_.yaw));
    const double x = obs_.p_world_robot[0] + c * obs_.p_robot_contact[0] - s * obs_.p_robot_contact[1];
    const double y = obs_.p_world_robot[1] + s * obs_.p_robot_contact[0] + c * obs_.p_robot_contact[1];
    const double low = arc_ - 1, high = arc_ + 1;
    double first = 0, least = 1e300, nearest = arc_;
    for (std::size_t i = 0; obs_.in_contact && i + 1 < path_.size(); i++) {
      const Point &a = path_[i], &b = path_[i + 1];
      const double length = std::hypot(b.x - a.x, b.y - a.y), last = first + length;
      if (first <= high && last >= low) {
        const double u = length > 0 ? (b.x - a.x) / length : 0, v = length > 0 ? (b.y - a.y) / length : 0;
        const double ahead = std::clamp((x - a.x) * u + (y - a.y) * v, std::max(low - first, 0.0),
                                        std::min(high - first, length));
        const double off = std::hypot(x - a.x - ahead * u, y - a.y - ahead * v);
        if (off < least) least = off, nearest = first + ahead;
      }
      first = last;
    }
    arc_ = nearest;
    double rest = arc_ + limits_.lookahead;
    Point target = path_.front();
    for (std::size_t i = 0; i + 1 < path_.size() && rest > 0; i++) {
      const Point &a = path_[i], &b = path_[i + 1];
      const double length = std::hypot(b.x - a.x, b.y - a.y);
      const double share = length > 0 ? std::min(rest / length, 1.0) : 0;
      target = {a.x + share * (b.x - a.x), a.y + share * (b.y - a.y)};
      rest -= length;
    }
    obs_.p_world_target[0] = static_cast<law_real>(target.x);
    obs_.p_world_target[1] = static_cast<law_real>(target.y);
  }

  std::string missing_input(double time) const {
    if (time - odometry_ > limits_.odometry_age) return "waiting for odometry";
    if (time - taxels_ > limits_.taxels_age) return "waiting for taxels";
    if (!path_.empty() && time - path_time_ > limits_.path_age) return "waiting for a path";
    if (path_.empty() && time - target_ > limits_.target_age) return "waiting for a target";
    return "";
  }

  Limits limits_;
  law_params params_ = LAW_PARAMS;
  law_skin_params skin_params_ = LAW_SKIN_PARAMS;
  law_memory memory_;
  law_skin skin_;
  law_observation obs_{};
  Command sent_;
  std::vector<Point> path_;
  double odometry_, taxels_, target_, path_time_, last_, scanned_;
  double arc_ = 0;  // [m] of the point of the path nearest to the contact
};

}  // namespace rps_push

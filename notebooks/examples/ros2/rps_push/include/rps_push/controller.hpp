// The law on a robot, without ROS: inputs with their times in, a bounded twist out.
//
// Times are seconds of one steady clock. What is commanded is zero until odometry, taxels and target
// were heard, whenever one of them falls silent or is not finite, and when the law has no answer;
// `status` says why. It is zero at once: a stop does not wait for the limit of acceleration.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <string>
#include <vector>

#include "rps_push/law.h"

namespace rps_push {

struct Limits {
  double v_max = 0.05;         // [m/s] of the speed in any direction
  double omega_max = 0.15;     // [rad/s]
  double a_max = 0.5;          // [m/s^2] of the change of the velocity
  double alpha_max = 1.0;      // [rad/s^2]
  double odometry_age = 0.08;  // [s] after which an input counts as silent
  double taxels_age = 0.08;
  double target_age = 0.08;
};

struct Command {
  double v_x = 0, v_y = 0, omega = 0;  // [m/s], [m/s], [rad/s] in the robot's frame
  std::string status = "waiting for odometry";
};

class Controller {
 public:
  explicit Controller(const Limits &limits) : limits_(limits) { reset(); }

  // Forget all that was felt and heard.
  void reset() {
    law_init(&params_, &memory_);
    law_skin_init(&skin_);
    odometry_ = taxels_ = target_ = -1e300;
    last_ = scanned_ = -1e300;
    sent_ = Command();
  }

  static constexpr std::size_t taxels() { return LAW_TAXELS; }

  void odometry(double now, double x, double y, double yaw) {
    if (!(std::isfinite(x) && std::isfinite(y) && std::isfinite(yaw))) return;
    seen_.p_world_robot[0] = static_cast<law_real>(x);
    seen_.p_world_robot[1] = static_cast<law_real>(y);
    seen_.yaw = static_cast<law_real>(yaw);
    odometry_ = now;
  }

  void target(double now, double x, double y) {
    if (!(std::isfinite(x) && std::isfinite(y))) return;
    seen_.p_world_target[0] = static_cast<law_real>(x);
    seen_.p_world_target[1] = static_cast<law_real>(y);
    target_ = now;
  }

  // One scan: relative changes of capacitance [1], along the strip.
  void skin(double now, const std::vector<float> &values) {
    if (values.size() != taxels()) return;
    law_real scan[LAW_TAXELS];
    for (std::size_t i = 0; i < taxels(); i++) scan[i] = static_cast<law_real>(values[i]);
    const double period = scanned_ > -1e299 ? now - scanned_ : 0.02;
    law_contact contact;
    const auto step = static_cast<law_real>(period);
    if (!(period > 0) || law_skin_step(&skin_params_, &skin_, scan, step, &contact) != LAW_OK)
      return;
    seen_.in_contact = contact.in_contact;
    seen_.p_robot_contact[0] = contact.p_robot_contact[0];
    seen_.p_robot_contact[1] = contact.p_robot_contact[1];
    tell(seen_, contact, 0);
    scanned_ = taxels_ = now;
  }

  // What to command now.
  Command tick(double now) {
    const double period = last_ > -1e299 ? now - last_ : 0.02;
    last_ = now;
    Command found;
    found.status = silent(now);
    if (found.status.empty() && !(period > 0)) found.status = "the clock stands still";
    if (!found.status.empty()) return sent_ = found;
    law_twist twist;
    seen_.period = static_cast<law_real>(period);
    if (const int code = law_step(&params_, &memory_, &seen_, &twist); code != LAW_OK) {
      found.status = "the law has no answer, code " + std::to_string(code);
      return sent_ = found;
    }
    const double speed = std::hypot(double(twist.v_x), double(twist.v_y));
    const double share = speed > limits_.v_max ? limits_.v_max / speed : 1.0;
    const double room = limits_.a_max * period, turn = limits_.alpha_max * period;
    const double x = share * twist.v_x - sent_.v_x, y = share * twist.v_y - sent_.v_y;
    const double change = std::hypot(x, y);
    const double part = change > room ? room / change : 1.0;
    const double omega = std::clamp(double(twist.omega), -limits_.omega_max, limits_.omega_max);
    found.v_x = sent_.v_x + part * x;
    found.v_y = sent_.v_y + part * y;
    found.omega = sent_.omega + std::clamp(omega - sent_.omega, -turn, turn);
    found.status = "pushing";
    return sent_ = found;
  }

 private:
  // Of laws that observe taxels themselves; others have no such fields.
  template <class Seen>
  static auto tell(Seen &seen, const law_contact &contact, int)
      -> decltype(seen.signal[0], seen.line, void()) {
    std::copy(contact.signal, contact.signal + LAW_TAXELS, seen.signal);
    seen.line = contact.line;
  }
  template <class Seen>
  static void tell(Seen &, const law_contact &, long) {}

  std::string silent(double now) const {
    if (now - odometry_ > limits_.odometry_age) return "waiting for odometry";
    if (now - taxels_ > limits_.taxels_age) return "waiting for taxels";
    if (now - target_ > limits_.target_age) return "waiting for a target";
    return "";
  }

  Limits limits_;
  law_params params_ = LAW_PARAMS;
  law_skin_params skin_params_ = LAW_SKIN_PARAMS;
  law_memory memory_;
  law_skin skin_;
  law_observation seen_{};
  Command sent_;
  double odometry_, taxels_, target_, last_, scanned_;
};

}  // namespace rps_push

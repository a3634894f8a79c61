// Prints the left elbow of the person as a controller would take it: only while it is certain enough.
//
// Angles and standard deviations are two messages with the same stamp, names and order. The deviations come second, so
// the angles wait for them.
#include <cstddef>
#include <cstdint>
#include <cstdio>
#include <map>
#include <memory>
#include <string>

#include <rclcpp/rclcpp.hpp>
#include <sensor_msgs/msg/joint_state.hpp>

using sensor_msgs::msg::JointState;

class Elbow : public rclcpp::Node
{
public:
  Elbow() : Node("elbow")
  {
    const std::string topic = "/humans/bodies/body1/joint_states";
    std::fprintf(stderr, "elbow: waits for %s and %s_stddev\n", topic.c_str(), topic.c_str());
    angles_subscription_ = create_subscription<JointState>(
      topic, 10, [this](const JointState::ConstSharedPtr message) {on_angles(message);});
    stddev_subscription_ = create_subscription<JointState>(
      topic + "_stddev", 10, [this](const JointState::ConstSharedPtr message) {on_stddev(*message);});
  }

private:
  static std::int64_t stamp(const JointState & message)
  {
    return rclcpp::Time(message.header.stamp).nanoseconds();
  }

  void on_angles(const JointState::ConstSharedPtr & message)
  {
    waiting_[stamp(*message)] = message;
    if (waiting_.size() > 10) {
      waiting_.erase(waiting_.begin());
    }
  }

  void on_stddev(const JointState & stddev)
  {
    const auto found = waiting_.find(stamp(stddev));
    if (found == waiting_.end()) {
      return;
    }
    const JointState::ConstSharedPtr angles = found->second;
    waiting_.erase(found);
    const std::size_t count = angles->name.size();
    if (stddev.name != angles->name || angles->position.size() != count || stddev.position.size() != count) {
      return;  // malformed: no message may end a controller
    }
    for (std::size_t i = 0; i < count; ++i) {
      // false for infinity and NaN: then there is no estimate
      if (angles->name[i] == "elbow_flexion_left_body1" && stddev.position[i] < 0.35) {
        std::printf("%.2f +- %.2f rad\n", angles->position[i], stddev.position[i]);
        std::fflush(stdout);
      }
    }
  }

  std::map<std::int64_t, JointState::ConstSharedPtr> waiting_;  // by stamp
  rclcpp::Subscription<JointState>::SharedPtr angles_subscription_;
  rclcpp::Subscription<JointState>::SharedPtr stddev_subscription_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Elbow>());
  rclcpp::shutdown();
  return 0;
}

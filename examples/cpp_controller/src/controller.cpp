// ros2 run quadid_cpp_controller controller: a gain that follows the roll inertia.
#include <chrono>
#include <memory>

#include "rclcpp/rclcpp.hpp"

#include "checks.hpp"

class Controller : public rclcpp::Node
{
public:
  Controller()
  : Node("controller")
  {
    // The lease tells a dead or hanging identification from a quiet one.
    auto qos = rclcpp::QoS(1).reliable().transient_local();
    qos.liveliness(rclcpp::LivelinessPolicy::ManualByTopic);
    qos.liveliness_lease_duration(std::chrono::seconds(8));
    rclcpp::SubscriptionOptions options;
    options.event_callbacks.liveliness_callback = [this](rclcpp::QOSLivelinessChangedInfo & event) {
        const auto * state = event.alive_count > 0 ? "alive" : "dead, or hangs";
        RCLCPP_INFO(get_logger(), "identification is %s", state);
      };
    subscription_ = create_subscription<quadid_example::Set>(
      "quadid/parameters", qos, [this](const quadid_example::Set & set) {on_set(set);}, options);
  }

private:
  void on_set(const quadid_example::Set & set)
  {
    double value{};
    const auto why = quadid_example::objection(set, model_, value);
    if (!why.empty()) {
      const auto number = std::to_string(set.sequence);
      RCLCPP_WARN(get_logger(), "set %s not applied: %s", number.c_str(), why.c_str());
      return;
    }
    model_.value = value;
    model_.sequence = set.sequence;
    const auto * name = model_.name.c_str();
    RCLCPP_INFO(get_logger(), "%s = %.4g, roll rate gain = %.4g", name, value, 20.0 * value);
  }

  quadid_example::Model model_;
  rclcpp::Subscription<quadid_example::Set>::SharedPtr subscription_;
};

int main(int argc, char ** argv)
{
  rclcpp::init(argc, argv);
  rclcpp::spin(std::make_shared<Controller>());
  rclcpp::shutdown();
  return 0;
}

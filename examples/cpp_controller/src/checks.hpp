// Which parameter sets a controller may apply: the checks of docs/using-with-ros.md,
// without ROS' client library.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <string>

#include "quadid_msgs/msg/parameter_set.hpp"

namespace quadid_example
{

using Set = quadid_msgs::msg::ParameterSet;

/// One parameter of the controller's model, with the number of the set it came from.
struct Model
{
  std::string name{"J_xx"};
  std::string unit{"kg m^2"};
  double value{0.010};         // [unit] first guess
  double mass{1.3};            // [kg] of this vehicle
  double largest_step{0.5};    // [1] relative change that one set may bring
  std::uint64_t sequence{0};
};

/// Why a set is not applied; empty where it may be, and `value` then holds the parameter.
inline std::string objection(const Set & set, const Model & model, double & value)
{
  if (set.schema_version != Set::SCHEMA_VERSION) {return "another schema";}
  if (set.state != Set::STATE_ACCEPTED && set.state != Set::STATE_ROLLED_BACK) {
    return "not in force: " + set.reason;
  }
  if (set.sequence <= model.sequence) {return "not newer than the set in use";}
  if (set.out_of_date) {
    return "out of date (" + set.out_of_date_code + "): " + set.out_of_date_reason;
  }
  if (!(std::abs(set.mass / model.mass - 1.0) <= 0.02)) {return "rests on another mass";}
  const auto size = set.names.size();
  if (set.values.size() != size || set.units.size() != size || set.status.size() != size) {
    return "its arrays differ in length";
  }
  for (std::size_t i = 0; i < size; ++i) {
    if (set.names[i] != model.name) {continue;}
    if (set.status[i] != Set::STATUS_IDENTIFIED) {return model.name + " is not identified";}
    if (set.units[i] != model.unit) {return model.name + " is in " + set.units[i];}
    value = set.values[i];
    if (!(value > 0.0 && std::abs(value / model.value - 1.0) <= model.largest_step)) {
      return model.name + " changes too much";
    }
    return "";
  }
  return "has no " + model.name;
}

}  // namespace quadid_example

#!/usr/bin/env bash
# Run the command with ROS 2 and our packages in the environment.
set -eo pipefail # ROS's setup files read unset variables
# shellcheck disable=SC1091 # both files exist only in the image
{
  source /opt/ros/jazzy/setup.bash
  source /opt/quadid/install/local_setup.bash
}
exec "$@"

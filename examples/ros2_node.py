"""A ROS 2 node that runs a delayed policy: JointState in, Float64MultiArray out.

python examples/ros2_node.py --ros-args -p policy:=BUNDLE -p on_overrun:=raise -p idle:="[0.0, 0.0]"

Further parameters: `action_delay`, `min_age` and `dt`; a value below 0 (the default) stands for the policy's own.
`idle` is what the drives do in a period without a command; by default they go on with the command before. While the
newest observation is too old for the policy, no command is published (`on_overrun`: `raise`; or `hold`, `clip`). If the
clock steps back, a new episode begins, whose history assumes that the drives were idle: stop the robot before you set
its clock.

The observation is [position…, velocity…] of the JointState, in the order of the policy's task. Its age comes from
`header.stamp`, which must be the time of the measurement on the clock of this node (`use_sim_time` works). rclpy comes
with ROS and not from PyPI, so it is imported only when the node is made.
"""

import math
import sys
from typing import Any

import numpy as np

from delayrl.deploy import ClockError, Controller, ControlPolicy, OverrunError
from delayrl.errors import DelayRLError

REPORT_EVERY = 10.0  # seconds


def make_node(policy: ControlPolicy, **settings: Any) -> Any:
    """Make the node; `settings` go to the controller: on_overrun, action_delay, min_age, dt, idle."""
    from rclpy.node import Node
    from rclpy.qos import qos_profile_sensor_data
    from sensor_msgs.msg import JointState
    from std_msgs.msg import Float64MultiArray

    class DelayedPolicy(Node):
        """Observe whenever a message arrives, and act on a timer."""

        def __init__(self) -> None:
            super().__init__("delayed_policy")
            self.controller = Controller(policy, stamps="seconds", clock=self.seconds, **settings)
            self.output = self.create_publisher(Float64MultiArray, "commands", 1)
            # best effort, because only the newest observation matters and lost ones do no harm
            self.create_subscription(JointState, "joint_states", self.observe, qos_profile_sensor_data)
            self.create_timer(self.controller.dt, self.act)
            self.create_timer(REPORT_EVERY, self.report)

        def seconds(self) -> float:
            return self.get_clock().now().nanoseconds * 1e-9

        def observe(self, message: Any) -> None:
            stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
            try:
                self.controller.observe(np.concatenate([message.position, message.velocity]), stamp)
            except DelayRLError as error:  # another robot's message
                self.get_logger().warning(str(error))

        def act(self) -> None:
            if not self.controller.ready:
                return
            try:
                action = self.controller.act()
            except OverrunError as error:  # without a command, the drive's own watchdog stops it
                self.get_logger().error(str(error))
                if settings.get("idle") is not None:
                    self.controller.override(settings["idle"])
                return
            except ClockError as error:  # the clock stepped back, or a simulation began again
                self.get_logger().error(f"{error}; a new episode begins, as if the drives had been idle")
                self.controller.reset()
                return
            except DelayRLError as error:
                self.get_logger().warning(str(error))
                return
            self.output.publish(Float64MultiArray(data=action.astype(float).tolist()))

        def report(self) -> None:
            s = self.controller.statistics
            self.get_logger().info(
                f"effective delay {s.age_mean:.2f} ± {s.age_std:.2f} steps ({s.delay_mean * 1e3:.1f} ± "
                f"{s.delay_std * 1e3:.1f} ms), period {s.period_mean * 1e3:.1f} ± {s.period_std * 1e3:.1f} ms; "
                f"{s.held} held back, {s.overruns} overruns, {s.missed} missed, of {s.decisions}"
            )

    return DelayedPolicy()


def settings_of(node: Any) -> dict[str, Any]:
    """Return the parameters as `make_node` takes them, and `policy`."""
    # ROS infers the types of parameters from their defaults, and an empty list has none: NaN stands for no idle action
    defaults = {"policy": "", "on_overrun": "raise", "action_delay": -1, "min_age": -1, "dt": -1.0}
    defaults["idle"] = [math.nan]
    values = {name: node.declare_parameter(name, default).value for name, default in defaults.items()}
    for name in ("action_delay", "min_age", "dt"):
        values[name] = None if values[name] < 0 else values[name]
    values["idle"] = None if np.isnan(values["idle"]).any() else list(values["idle"])
    return values


def main() -> None:
    try:
        import rclpy
        from rclpy.node import Node
    except ImportError:
        sys.exit("delayed_policy: needs ROS 2 and its Python package rclpy: source /opt/ros/DISTRO/setup.bash first")

    from delayrl.deploy import load_bundle

    rclpy.init()
    parameters = Node("delayed_policy_parameters")
    values = settings_of(parameters)
    try:
        node = make_node(load_bundle(values.pop("policy")), **values)
    except DelayRLError as error:
        sys.exit(f"delayed_policy: {error}")
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        node.report()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

"""The exported controller as a ROS 2 node. Needs rclpy, numpy, and `rtcd_controller.py` beside it.

    python rtcd_ros2.py --ros-args -p joints:="[shoulder, elbow]" -p commands:=/effort_controller/commands
    ros2 service call /rtcd_controller/start std_srvs/srv/Trigger

    /joint_states (sensor_msgs/JointState)   positions [rad, m] and velocities of the joints, by name
    /effort_controller/commands              efforts of the driven joints [N m, N] (std_msgs/Float64MultiArray), as
                                             ros2_control's JointGroupEffortController takes them
    ~/ratio (std_msgs/Float64)               V/rho while the motion runs
    ~/start, ~/stop (std_srvs/Trigger)

Hand-over: it publishes nothing before ~/start, which is refused unless a fresh state lies inside the funnel of t = 0.
Stop: an advice to abort, a state that is older than `timeout`, or ~/stop publish zero efforts, and go on with them
until the next start. After the motion the goal is held until it is stopped, or, if it ends in a catch set, it stops
by itself. The node is no safety function.

Parameters: `joints`, their names in the order of the states; `states` and `commands`, the topics; `rate` [Hz] of the
control, by default that of the export; `timeout` [s], by default five periods; `wrapped` and `abort_ratio` as
`Controller` has them.
"""

from __future__ import annotations

import json
import math
import xml.etree.ElementTree as Xml
from pathlib import Path

import numpy as np
import rclpy
from rclpy.node import Node
from rtcd_controller import Controller
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

HERE = Path(__file__).parent
CALLS = 4
"""Calls of the controller an interval where no measured rate suffices."""
PERIODS = 5
"""After which a state is too old."""


def joint_names(folder: Path = HERE) -> list[str]:
    """Of `robot.xml`, in the order of the states."""
    return [joint.get("name", "") for joint in Xml.parse(folder / "robot.xml").iter("joint") if joint.get("name")]


def control_rate(folder: Path = HERE) -> float:
    """The export's least rate [Hz], a whole number of calls an interval."""
    described = json.loads((folder / "rtcd_controller.json").read_text(encoding="utf-8"))
    return (described["control_rate"]["calls_an_interval"] or CALLS) / described["time"]["dt"]


class ControllerNode(Node):
    """Idle until it is started, then the motion and the goal, then stopped; see the module's text."""

    def __init__(self):
        super().__init__("rtcd_controller")
        joints = self._parameter("joints", joint_names())
        rate = self._parameter("rate", control_rate())
        self.timeout = self._parameter("timeout", PERIODS / rate)
        wrapped, abort_ratio = self._parameter("wrapped", False), self._parameter("abort_ratio", 4.0)
        self.controller = Controller(HERE, abort_ratio=abort_ratio, wrapped=wrapped)
        if len(joints) != len(self.controller.x_goal) // 2:
            raise ValueError(f"joints = {joints}: must be {len(self.controller.x_goal) // 2} names")
        self.joints = list(joints)
        self.state, self.heard = None, -math.inf
        self.begun: float | None = None
        self.stopped = False
        self._commands = self.create_publisher(
            Float64MultiArray, self._parameter("commands", "/effort_controller/commands"), 1
        )
        self._ratio = self.create_publisher(Float64, "~/ratio", 1)
        self.create_subscription(JointState, self._parameter("states", "/joint_states"), self.hear, 1)
        self.create_service(Trigger, "~/start", self.start)
        self.create_service(Trigger, "~/stop", self.stop)
        self.create_timer(1.0 / rate, self.step)

    def _parameter(self, name, default):
        return self.declare_parameter(name, default).value

    def now(self) -> float:
        """The node's time [s]."""
        return self.get_clock().now().nanoseconds / 1e9

    def hear(self, message) -> None:
        """Keeps the joints' state; a message that lacks a joint, its position or its velocity is none."""
        try:
            places = [message.name.index(joint) for joint in self.joints]
            state = [values[place] for values in (message.position, message.velocity) for place in places]
        except (ValueError, IndexError):
            return
        self.state, self.heard = np.array(state, float), self.now()

    def start(self, request, response):
        """Begins the motion, if a fresh state is inside the funnel of t = 0."""
        if self.begun is not None:
            response.success, response.message = False, "it runs"
        elif self._stale():
            response.success, response.message = (
                False,
                f"no state of {', '.join(self.joints)} within {self.timeout:g} s",
            )
        else:
            watch = self.controller.monitor(0.0, self.state)
            response.success, response.message = watch.inside, f"V/rho = {watch.ratio:.3g} at the start"
            if watch.inside:
                self.begun, self.stopped = self.now(), False
        return response

    def stop(self, request, response):
        """Zero efforts until the next start."""
        self._stop("it was asked to")
        response.success, response.message = True, "stopped"
        return response

    def step(self) -> None:
        """One period: the input of the motion, zero once it is stopped, nothing before it is started."""
        if self.begun is not None:
            if self._stale():
                self._stop(f"the last state is older than {self.timeout:g} s")
            else:
                self._follow(self.now() - self.begun)
        if self.stopped:
            self._publish(np.zeros_like(self.controller.u_max))

    def _follow(self, t: float) -> None:
        """The input at t of the motion, unless it is over or the monitor advises to stop."""
        if self.controller.over(t):
            return self._stop(f"the motion ended in its catch set at {self.controller.duration:.3f} s")
        watch = self.controller.monitor(t, self.state)
        self._ratio.publish(Float64(data=watch.ratio))
        if watch.abort:
            return self._stop(f"V/rho = {watch.ratio:.3g} at {t:.3f} s")
        return self._publish(self.controller.control(t, self.state))

    def _stale(self) -> bool:
        return self.state is None or self.now() - self.heard > self.timeout

    def _stop(self, why: str) -> None:
        self.begun, self.stopped = None, True
        self.get_logger().warning(f"stopped: {why}")

    def _publish(self, efforts) -> None:
        self._commands.publish(Float64MultiArray(data=np.asarray(efforts, float).tolist()))


def main() -> None:
    """Spins the node until it is interrupted; the last word is zero."""
    rclpy.init()
    node = ControllerNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        node.stop(None, Trigger.Response())
        node.step()
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()

"""The ROS 2 example, on a fake rclpy that delivers messages and fires timers by hand."""

import importlib.util
import subprocess
import sys
import types
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from oracle import Counting

EXAMPLE = Path(__file__).parents[3] / "examples" / "ros2_node.py"


class Node:
    """What the example uses of rclpy.node.Node."""

    now = 1_700_000_000_000_000_000  # ns, as on a robot: large enough for rounding to matter

    def __init__(self, name: str) -> None:
        self.name, self.published, self.subscribed, self.timers, self.log = name, [], {}, [], []

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        def publish(message: Any) -> None:
            assert isinstance(message, kind)
            assert all(isinstance(value, float) for value in message.data)
            self.published.append((topic, message.data))

        return SimpleNamespace(publish=publish)

    def create_subscription(self, kind: type, topic: str, callback: Any, qos: Any) -> None:
        assert qos == "best effort"
        self.subscribed[topic] = callback

    def create_timer(self, period: float, callback: Any) -> None:
        self.timers.append((period, callback))

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=Node.now))

    def get_logger(self) -> Any:
        return SimpleNamespace(**{level: lambda text: self.log.append(text) for level in ("info", "warning", "error")})


class Float64MultiArray:
    def __init__(self, data: list) -> None:
        self.data = data


def joint_state(position: list, velocity: list, nanoseconds: int) -> Any:
    stamp = SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return SimpleNamespace(header=SimpleNamespace(stamp=stamp), position=position, velocity=velocity)


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> Any:
    assert "rclpy" not in sys.modules
    spec = importlib.util.spec_from_file_location("ros2_node", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)  # without ROS
    for name, content in {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": "best effort"},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"JointState": object},
        "std_msgs": {},
        "std_msgs.msg": {"Float64MultiArray": Float64MultiArray},
    }.items():
        fake = types.ModuleType(name)
        fake.__dict__.update(content)
        monkeypatch.setitem(sys.modules, name, fake)
    monkeypatch.setattr(Node, "now", Node.now)
    return module


def test_late_messages_meet_the_right_history(example: Any) -> None:
    policy = Counting(2, 4)
    node = example.make_node(policy, dt=0.02)
    period, tick = node.timers[0]
    assert period == 0.02
    tick()
    assert not node.published  # nothing has arrived
    rng = np.random.default_rng(0)
    made: list[int] = []
    for step in range(30):
        Node.now += 20_000_000 + int(rng.integers(-2_000_000, 2_000_000))
        made.append(Node.now - 1_000_000)  # measured just before the tick, but only delivered three ticks later
        newest = max(0, step - 3)
        node.subscribed["joint_states"](joint_state([float(newest)], [0.5], made[newest]))
        node.subscribed["joint_states"](joint_state([float(newest)], [0.5], made[newest]))  # twice
        tick()
        assert policy.calls[-1][0] == newest
        assert policy.calls[-1][2] == step - newest
        given = [data[0] for _, data in node.published]
        assert policy.calls[-1][1] == given[newest:step] + [0.0] * (4 - step + newest)
    assert len(node.published) == 30
    assert {topic for topic, _ in node.published} == {"commands"}
    node.timers[1][1]()
    assert "effective delay 3.00 ± 0.00 steps (61." in node.log[-1]


def test_no_command_on_an_overrun(example: Any) -> None:
    node = example.make_node(Counting(2, 1), dt=0.02, on_overrun="raise")
    node.subscribed["joint_states"](joint_state([0.0], [0.0], Node.now))
    for _ in range(4):
        node.timers[0][1]()
        Node.now += 20_000_000
    assert len(node.published) == 2
    assert "takes ages up to 1" in node.log[-1]


def test_the_drive_is_idle_on_an_overrun(example: Any) -> None:
    policy = Counting(2, 1)
    given = {"dt": 0.02, "idle": [7.0], "action_delay": 0}
    node = Node("parameters")
    node.declare_parameter = lambda name, default: SimpleNamespace(value=given.get(name, default))
    settings = example.settings_of(node)
    assert settings == given | {"policy": "", "on_overrun": "raise", "min_age": None}
    settings.pop("policy")
    node = example.make_node(policy, **settings)
    node.subscribed["joint_states"](joint_state([0.0], [0.0], Node.now))
    for _ in range(4):
        node.timers[0][1]()
        Node.now += 20_000_000
    node.subscribed["joint_states"](joint_state([1.0], [0.0], Node.now - 20_000_000))
    node.timers[0][1]()
    assert len(node.published) == 3
    assert policy.calls[-1] == (1.0, [7.0], 1)
    assert (node.controller.statistics.overridden, node.controller.statistics.overruns) == (2, 2)


def test_a_clock_that_steps_back_begins_an_episode(example: Any) -> None:
    node = example.make_node(Counting(2, 1), dt=0.02)

    def tick() -> int:
        node.subscribed["joint_states"](joint_state([0.0], [0.0], Node.now))
        node.timers[0][1]()
        return len(node.published)

    assert tick() == 1
    Node.now -= 10**9
    assert tick() == 1
    assert "time went backwards" in node.log[-1]
    Node.now += 20_000_000
    assert (tick(), node.controller.episode) == (2, 1)


def test_parameters_left_out_are_the_policys_own(example: Any) -> None:
    node = Node("parameters")
    node.declare_parameter = lambda name, default: SimpleNamespace(value=default)
    assert example.settings_of(node) == {
        **{"policy": "", "on_overrun": "raise"},
        **dict.fromkeys(("action_delay", "min_age", "dt", "idle")),
    }


def test_without_ros_is_one_line() -> None:
    done = subprocess.run([sys.executable, EXAMPLE], capture_output=True, text=True)
    assert done.returncode == 1
    assert done.stderr.startswith("delayed_policy: needs ROS 2 and its Python package rclpy: source ")
    assert done.stderr.count("\n") == 1


def test_a_message_of_another_robot_is_no_end(example: Any) -> None:
    node = example.make_node(Counting(2, 1), dt=0.02)
    node.subscribed["joint_states"](joint_state([0.0, 1.0], [0.0], Node.now))
    assert "observations of size 2" in node.log[-1]
    assert not node.controller.ready

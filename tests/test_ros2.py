"""The controllers of the ROS 2 example, in C++ and in Python, without ROS."""

import ast
import re
import runpy
import shutil
import subprocess
import xml.etree.ElementTree as ET
from functools import partial

import numpy as np
import pytest
from helpers import ROOT, setting_of, slow

from rps_jax.app.export import c, program
from rps_jax.record import bag
from rps_jax.runs.push import push

FOLDER = ROOT / "notebooks" / "examples" / "ros2" / "rps_push"
PYTHON = runpy.run_path(str(FOLDER / "rps_push" / "controller.py"))
DRIVER = """
#include <cstdio>
#include <iostream>
#include <sstream>
#include "rps_push/controller.hpp"
int main() {
  rps_push::Controller controller{rps_push::Limits()};
  for (std::string line; std::getline(std::cin, line);) {
    std::istringstream words(line);
    std::string what, number;
    std::vector<double> x;
    words >> what;
    while (words >> number) x.push_back(std::stod(number));
    if (what == "odometry") controller.odometry(x[0], x[1], x[2], x[3]);
    if (what == "target") controller.target(x[0], x[1], x[2]);
    if (what == "path") {
      std::vector<rps_push::Point> path;
      for (std::size_t i = 1; i + 1 < x.size(); i += 2) path.push_back({x[i], x[i + 1]});
      controller.path(x[0], path);
    }
    if (what == "skin") controller.skin(x[0], std::vector<float>(x.begin() + 1, x.end()));
    if (what != "tick") continue;
    const auto found = controller.tick(x[0]);
    std::printf("%.9g %.9g %.9g %s\\n", found.v_x, found.v_y, found.omega, found.status.c_str());
  }
}
"""
FELT = np.zeros(42)
FELT[16:20] = 0.6


@pytest.fixture(scope="module")
def binary(tmp_path_factory):
    if shutil.which("g++") is None:
        pytest.skip("there is no g++: run `apt-get install -y g++`")
    return built(tmp_path_factory.mktemp("ros2"), program.program("rps_plus"))


def built(folder, exported):
    """Return the controller in C++ with an exported law."""
    (folder / "rps_push").mkdir()
    (folder / "rps_push" / "law.h").write_text(c.header(exported, "law"))
    (folder / "driver.cpp").write_text(DRIVER)
    include = ["-I", str(folder), "-I", str(FOLDER / "include")]
    warned = ["-std=c++17", "-O1", "-Wall", "-Wextra", "-Werror", "-fsanitize=address,undefined"]
    sources = [str(folder / "driver.cpp"), "-o", str(folder / "driver")]
    subprocess.run(["g++", *warned, *include, *sources], check=True)
    return folder / "driver"


@pytest.fixture(scope="module")
def python():
    return PYTHON["Controller"]()


def driven_in_python(controller, events):
    controller.reset()
    commands = []
    for topic, *values in events:
        if topic in ("skin", "path"):
            getattr(controller, topic)(values[0], values[1:])
        elif (command := getattr(controller, topic)(*values)) is not None:
            commands.append(command)
    return np.array([command[:3] for command in commands]), [c.status for c in commands]


def driven_in_cpp(binary, events):
    text = "".join(f"{topic} {' '.join(map(repr, map(float, x)))}\n" for topic, *x in events)
    done = subprocess.run([str(binary)], input=text, capture_output=True, text=True, check=True)
    rows = [line.split(" ", 3) for line in done.stdout.splitlines()]
    return np.array([row[:3] for row in rows], float), [row[3] for row in rows]


DRIVEN = {"binary": driven_in_cpp, "python": driven_in_python}


@pytest.fixture(params=DRIVEN)
def driven(request):
    """Function from events to the commands (n, 3) and statuses of a controller, one per tick."""
    return partial(DRIVEN[request.param], request.getfixturevalue(request.param))


def events(seconds=2.0, silent="", since=1.0, odd=None, taxels=FELT):
    """Yield the inputs of a robot at rest in front of an object, at 50 Hz."""
    for i in range(round(seconds / 0.02)):
        time = 0.02 * (i + 1)
        messages = {"odometry": [0, 0, 0], "target": [-2, 0.5], "skin": list(taxels)}
        for name, values in messages.items():
            if name == silent and time > since:
                if odd is None:
                    continue
                values[0] = odd
            yield (name, time, *values)
        yield ("tick", time + 0.005)


def test_it_pushes_within_the_limits_of_speed_and_acceleration(driven):
    twists, statuses = driven(events())
    assert set(statuses) == {"pushing"}
    assert np.hypot(twists[-1, 0], twists[-1, 1]) == pytest.approx(0.05, rel=1e-3)
    assert np.hypot(*twists[:, :2].T).max() <= 0.05 + 1e-9
    assert np.abs(twists[:, 2]).max() <= 0.15 + 1e-9
    change = np.diff(np.concatenate([np.zeros((1, 3)), twists]), axis=0)
    assert np.hypot(*change[:, :2].T).max() <= 0.5 * 0.02 + 1e-9
    assert np.abs(change[:, 2]).max() <= 1.0 * 0.02 + 1e-9
    assert np.hypot(*change[1, :2]) > 0.009  # limited by the acceleration


@pytest.mark.parametrize("silent", ["odometry", "target", "skin"])
@pytest.mark.parametrize("odd", [None, float("nan"), float("inf")])
def test_silence_of_any_input_commands_zero_within_100_ms(driven, silent, odd):
    twists, statuses = driven(events(silent=silent, odd=odd))
    times = 0.02 * np.arange(1, len(twists) + 1) + 0.005
    assert (np.abs(twists[(times > 0.5) & (times < 1.0)]).sum(-1) > 0.01).all()
    assert not twists[times > 1.0 + 0.1].any()
    words = {"odometry": "odometry", "target": "a target", "skin": "taxels"}[silent]
    assert statuses[-1] == f"waiting for {words}"


def test_it_waits_for_all_inputs_and_resumes_after_silence(driven):
    no_target = [event for event in events(1.0) if event[0] != "target"]
    twists, statuses = driven(no_target)
    assert not twists.any()
    assert set(statuses) == {"waiting for a target"}
    skin_gap = [event for event in events(3.0) if event[0] != "skin" or not 1.0 < event[1] < 2.0]
    twists, statuses = driven(skin_gap)
    assert statuses[60] == "waiting for taxels"
    assert statuses[-1] == "pushing"
    assert np.abs(twists[-1]).sum() > 0.01


def test_a_skin_of_another_size_is_silent(driven):
    assert set(driven(events(0.5, taxels=FELT[:41]))[1]) == {"waiting for taxels"}


def test_a_stopped_clock_commands_zero(driven):
    twists, statuses = driven([*events(0.5), ("tick", 0.505)])
    assert statuses[-1] == "the clock does not advance"
    assert not twists[-1].any()


PUSHES = {
    "target": (10.0, "box", {"target": (-1.0, 0.5)}),
    "path": (80.0, "cylinder", {"task": "corridor,width=1.5,turns=2,length=4"}),
}


@pytest.mark.parametrize("goal", ["target", slow("path")])
def test_cpp_and_python_agree_on_a_recorded_bag(goal, binary, tmp_path, python):
    """On the way to a target, and along a path, which they follow as the task does."""
    pytest.importorskip("mcap_ros2")
    path, (seconds, name, options) = tmp_path / "push.mcap", PUSHES[goal]
    push(
        name,
        law="rps_plus",
        skin="capacitive",
        bag=path,
        setting=setting_of(seconds, "mujoco"),
        **options,
    )
    read = bag.read(path)
    messages = []
    for i, time in enumerate(read["time"]):
        messages += [("odometry", time, *read["pose"][i]), (goal, time, *read[goal][i].ravel())]
        messages += [("skin", time, *read["signal"][i]), ("tick", time)]
    cpp, statuses = driven_in_cpp(binary, messages)
    python_twists, _ = driven_in_python(python, messages)
    assert np.mean(np.abs(cpp - python_twists).max(-1) > 1e-5) < 0.01
    # The bag's law felt contact at once, and these through foam, a filter and bounds.
    near = np.abs(cpp - read["twist"])[:, :2].max(-1)
    assert np.mean(near < 0.02) > 0.8
    if goal == "path":
        assert np.ptp(read["target"], axis=0).min() > 0.2
        assert set(statuses) == {"pushing"}


ROBOT = "ideal,drive=differential,axle=0.2"


def test_a_base_with_an_axle_is_driven_in_the_frame_of_its_axle(tmp_path):
    """Odometry of the axle is moved ahead to the middle; the command has no sideways velocity."""
    controller = PYTHON["Controller"](law="unicycle", robot=ROBOT)
    inputs = list(events(4.0))
    for i, (name, time, *_) in enumerate(inputs):
        if name == "odometry":  # of an axle on a straight way, which turns
            inputs[i] = name, time, 0.1 * time, 0.0, 0.1 * time
        elif name == "target":  # ahead, so that the law pushes
            inputs[i] = name, time, 2.0, 0.5
    twists, statuses = driven_in_python(controller, inputs)
    assert set(statuses) == {"pushing"}
    assert not twists[:, 1].any()
    assert np.abs(twists[:, 2]).max() > 0.05
    middle = [0.4 + 0.2 * np.cos(0.4), 0.2 * np.sin(0.4), 0.4]
    np.testing.assert_allclose(controller._pose, middle, atol=1e-6)
    if shutil.which("g++"):
        exported = program.program("unicycle", ROBOT)
        cpp, _ = driven_in_cpp(built(tmp_path, exported), inputs)
        np.testing.assert_allclose(cpp, twists, atol=1e-5)


def test_a_path_replaces_the_target_until_it_ends(driven):
    ahead = [0.3, 0.0, 3.0, 0.0]
    inputs = [event for event in events(6.0) if event[0] != "target" or event[1] > 4.0]
    twists, statuses = driven([("path", 0.01, *ahead), *inputs])
    times = 0.02 * np.arange(1, len(twists) + 1) + 0.005
    assert {s for s, t in zip(statuses, times, strict=True) if t < 2.0} == {"pushing"}
    assert statuses[-1] == "waiting for a path"
    assert not twists[times > 2.1].any()
    ended = sorted([*inputs, ("path", 4.5)], key=lambda event: event[1])
    assert driven([("path", 0.01, *ahead), *ended])[1][-1] == "pushing"
    assert set(driven([("path", 0.01, np.nan, 0.0), *events(0.5)])[1]) == {"pushing"}


@pytest.mark.parametrize(
    ("law", "robot"),
    [
        ("rps_plus", "ideal"),
        slow("unicycle", "turtlebot4"),
        ("unicycle_car", "f1tenth"),
        ("pose", "ideal"),
    ],
)
def test_the_node_compiles_without_a_warning(law, robot, tmp_path):
    """Declarations of `rclcpp` take the place of ROS."""
    if shutil.which("g++") is None:
        pytest.skip("there is no g++: run `apt-get install -y g++`")
    node = FOLDER / "src" / "push_node.cpp"
    for name in re.findall(r'#include "(.*/.*)"', node.read_text()):
        stub = tmp_path / name
        stub.parent.mkdir(parents=True, exist_ok=True)
        if "rps_push" not in name:
            stub.write_text(f'#include "{ROOT}/tests/ros2.hpp"\n')
    header = tmp_path / "rps_push" / "law.h"
    header.write_text(c.header(program.program(law, robot), "law"))
    include = ["-I", str(tmp_path), "-I", str(FOLDER / "include")]
    warned = ["-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    subprocess.run(["g++", *warned, *include, str(node)], check=True)


# --- consistency of the nodes, which need ROS to run ---------------------------------------


def test_the_nodes_name_the_same_topics_and_parameters():
    cpp, python, config, cmake = (
        (FOLDER / path).read_text()
        for path in (
            "src/push_node.cpp",
            "scripts/push_node.py",
            "config/push.yaml",
            "CMakeLists.txt",
        )
    )
    ast.parse(python)
    for topic in ("odom", "taxels", "target", "path", "cmd_vel"):
        assert f'"{topic}"' in cpp
        assert f'"{topic}"' in python
    limits = vars(PYTHON["Limits"]())
    ranges = dict(re.findall(r'number\("(\w+)", "[^"]*", ([\d., ]+)\)', cpp))
    declared = ast.literal_eval(re.search(r"^PARAMETERS = (\{.*?^\})", python, re.M | re.S)[1])
    for name, (about, smallest, largest) in declared.items():
        assert ranges[name].split(", ") == [str(x) for x in (limits[name], smallest, largest)]
        assert about in cpp
    defaults = dict(re.findall(r"^    (\w+): ([\d.]+)", config, re.M))
    assert {name: float(x) for name, x in defaults.items()} == limits
    assert set(declared) == set(defaults)
    needed = {tag.text for tag in ET.parse(FOLDER / "package.xml").getroot().findall("depend")}
    required = re.findall(r"find_package\((\w+) REQUIRED\)", cmake)
    assert needed == {name for name in required if not name.startswith("ament")}

"""An ament_python package for colcon, and an ordinary one for pip."""

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

from setuptools import find_packages, setup

NAME = "body_tracking"
# Read, not imported: what the package needs is not there while it is built.
SYSTEMS = sorted(Path(NAME).glob("*/system.py"))
NODES = [node for path in SYSTEMS for node in re.findall(r'\bNodeType\(\s*"(\w+)"', path.read_text(encoding="utf-8"))]

MANIFEST = ElementTree.parse("package.xml")

# setup.cfg puts entry points where `ros2 run` looks, so colcon gets the commands once more, for the PATH. In a wheel
# they would collide with pip's entry points, which are on the PATH already.
COMMANDS = [("bin", ["scripts/body_tracking", "scripts/kinect_sender"])] if "bdist_wheel" not in sys.argv else []


def share(folder: str, pattern: str) -> tuple[str, list[str]]:
    """A ``data_files`` entry: the files of a folder of the project, under the package's share."""
    return f"share/{NAME}/{folder}", [path.as_posix() for path in sorted(Path(folder).glob(pattern))]


setup(
    name=NAME,
    version=MANIFEST.findtext("version"),
    description=MANIFEST.findtext("description"),
    license="Apache-2.0",
    author="body_tracking maintainers",
    python_requires=">=3.11",
    packages=find_packages(include=[NAME, f"{NAME}.*"]),
    package_data={NAME: ["py.typed", "ros/fastdds/*.xml", "mesh/data/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *COMMANDS,
        share("config", "*.yaml"),
        share("config/robots", "*.yaml"),
        share("config/marker_setup", "*.yaml"),
        share("config/camera_rig", "*.yaml"),
        share("config/five_systems", "*.yaml"),
        share("launch", "*.launch.py"),
        share("rviz", "*.rviz"),
        share("foxglove", "*.json"),
        *(share(bag.as_posix(), "*.*") for bag in sorted(Path("bags").iterdir()) if bag.is_dir()),
    ],
    install_requires=[
        "numpy>=1.26",
        "scipy>=1.11",
        "pyyaml>=6",
        "matplotlib>=3.8",
        "filterpy>=1.4.5",
        "vqf>=2.1",
        "numba>=0.62",
        "mcap>=1.2",
        "lz4>=4",
        "zstandard>=0.22",
        "rosbags>=0.10,<0.12",
        "opencv-python-headless>=4.6",
    ],
    extras_require={
        "ros": [
            "ros-jazzy-rclpy==7.1.6",
            "ros-jazzy-common-interfaces==5.3.6",
            "ros-jazzy-rmw-fastrtps-cpp==8.4.3",
        ],
        "camera": ["ai-edge-litert>=1.2"],
        "viewer": ["viser>=1.1,<2", "trimesh>=3.21.7", "websockets>=14"],
        "test": [
            "build>=1",
            "pytest>=8",
            "pytest-xdist>=3.6",
            "hypothesis>=6.100",
            "ruff==0.17.5",
            "mypy==2.4.1",
            "types-PyYAML",
            "catkin_pkg>=1.0",
            "colcon-common-extensions",
            "colcon-ros",
            "pin>=3",
            "psutil",
            "setuptools>=77",
            "ezc3d>=1.7",
            "import-linter>=2",
            "mujoco-core>=4",
            "playwright>=1.50",
        ],
        "c3d": ["ezc3d>=1.7"],
        "bench": ["psutil"],
        "examples": ["mujoco-core>=4"],
    },
    entry_points={
        "console_scripts": [
            *(f"{name} = body_tracking.executables:{name}" for name in ("body_tracking", "kinect_sender", *NODES)),
        ]
    },
    # Of the scripts that colcon installs: see body_tracking/executables.py.
    options={"build_scripts": {"executable": f"/usr/bin/env -S --block-signal=INT,TERM {sys.executable}"}},
    zip_safe=True,
)

# body_tracking on ROS 2 Jazzy: plays a shipped recording through the live graph and prints its angles.
#   docker build -t body_tracking .
#   docker run --rm body_tracking               the demo
#   docker run --rm body_tracking test          the tests of the package that need no virtual environment
#   docker run --rm -it body_tracking bash      a shell with the workspace sourced
FROM ros:jazzy

SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /workspace

# The dependencies first, so that a change of the code does not install them again.
COPY package.xml src/body_tracking/package.xml
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3-pip \
    && rosdep update --rosdistro jazzy \
    && PIP_BREAK_SYSTEM_PACKAGES=1 rosdep install --from-paths src --ignore-src --default-yes \
    && rm -rf /var/lib/apt/lists/*
# hadolint ignore=DL3013
RUN pip install --no-cache-dir --break-system-packages \
    "mcap>=1.2" "lz4>=4" "zstandard>=0.22" "vqf>=2.1" "numba>=0.62" "rosbags>=0.10,<0.12" \
    "viser>=1.1,<2" "ai-edge-litert>=1.2" "pytest>=8" "pytest-xdist>=3.6" "hypothesis>=6.100" psutil

COPY . src/body_tracking
# hadolint ignore=SC1091
RUN . /opt/ros/jazzy/setup.bash && colcon build --packages-select body_tracking

ENV ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST MPLBACKEND=Agg
COPY --chmod=755 docker/entrypoint /entrypoint
ENTRYPOINT ["/entrypoint"]
CMD ["demo"]

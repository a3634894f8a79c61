"""Recordings: rosbag2 folders with mcap files, in and out, without any ROS installation.

``rosbag2`` is the reader and writer that everything else uses; ``importer`` turns other formats into bags, ``player``
holds the timing of playback, ``info`` says what is in a bag. May import ``messages``, ``sensors`` and the core; only
nodes and the command line import it.
"""

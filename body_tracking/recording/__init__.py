"""Recordings: rosbag2 folders with mcap files, read and written without any ROS installation.

``rosbag2`` reads and writes bags, ``importer`` converts other formats, ``player`` computes the timing of playback,
``replay`` runs the graph offline, ``info`` lists a bag's content.
"""

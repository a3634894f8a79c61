"""What the graph consists of: stages, the messages between them, and the offline runner; knows no ROS library."""

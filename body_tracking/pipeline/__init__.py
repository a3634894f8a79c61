"""The parts of the graph: stages, their topics and parameters, and the offline runner."""

"""Fusion of any number of sensors' skeletons of one body into one in ``world``, with a covariance on every joint.

It works by stamps alone, so that the live node and the offline replay give the same numbers: frames are brought to the
reference sensor's clock, paired with the lead sensor's, gated, corrected where a sensor sees the body reversed, and
weighted by covariance or as Schlagenhauf (2017) describes or computes. ``alignment`` brings single frames into world
and corrects them, for filters that update with each sensor's frames at their own time. With several people in view,
``association`` assigns bodies to people and ``people`` selects and numbers the tracked ones.
"""

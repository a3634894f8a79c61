"""One skeleton in ``world`` from what any number of sensors say of the same body, with a covariance on every joint.

It works by stamps alone, so that the live node and the offline replay give the same numbers: frames are brought to the
reference sensor's clock, paired with the lead sensor's, gated, repaired where a sensor sees the body turned around, and
weighted: by covariance, or as Schlagenhauf (2017) says or computes. For filters that take each sensor's frames at their
own time, ``alignment`` does the same with single frames, up to the pairing. Where several people are in view,
``association`` says who is whom and ``people`` who of them is tracked, under which number. It knows ``skeleton`` and
``calibration.result``, and neither filters nor ROS. The nodes and the offline replay import it.
"""

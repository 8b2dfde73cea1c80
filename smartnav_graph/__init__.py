"""smartnav_graph: a recorded phone or MEMS session in, a smoothed trajectory with honest covariance out."""

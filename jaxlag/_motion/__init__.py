"""Motion in time: the first-order system, steps and events, `simulate` and `simulate_many`, derivatives of a motion, `Trajectory`."""

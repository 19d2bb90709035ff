"""Pure maths and data: from stamped measurements to a pose and its covariance. No clock, file, socket or thread."""

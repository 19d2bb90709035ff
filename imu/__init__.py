"""Bytes to stamped IMU batches in SI units. Imports only `fusion.measurements` of the other packages."""

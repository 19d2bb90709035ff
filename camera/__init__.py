"""Pixels to pose fixes. Imports only `fusion.measurements` and `fusion.geometry` of the other packages."""

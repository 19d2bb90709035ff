"""Wiring: configuration, sockets, recordings, the command line. Nothing but tests and notebooks imports it."""

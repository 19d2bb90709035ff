"""One sans-I/O parser a file: `feed(bytes) -> samples`, the same however the bytes are split."""

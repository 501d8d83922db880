"""Everything that measures; each file is a command: python -m benchmarks.NAME."""

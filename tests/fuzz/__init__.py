"""Fuzzing: mutations of every input format, judged against independent readers. ``python -m tests.fuzz --help``."""

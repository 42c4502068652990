"""Pure package for the board's serial line: wire time, lines, frames, sample times and the
session."""

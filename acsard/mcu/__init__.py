"""The microcontroller's serial line, pure: wire time, lines, frames and the session."""

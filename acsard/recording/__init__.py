"""The black box: records the inputs and the outputs of every control step, and replays them.

Recording: `recorder` (the thread), `directory` (which files go) and `file` (frames, records).
Reading: `replay` (steps and files), `timeline` (what happened, in sentences), `published` (the
messages of the robot), and from them `export` (MCAP, CSV) and `html_report`.
"""

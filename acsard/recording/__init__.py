"""The black box: records the inputs and the outputs of every control step, and replays them.

Pure: `recorded_steps` (one step), `rows` (batches), `state` and `unpickling` (a `Robot` as bytes),
`replay`, `replay_text`, `timeline`, `published` (messages) and `retention` (which files go). With
I/O: `recorder` and its thread `step_writer`, `directory`, `file` with `mcap_records` and
`end_record`, `series` (the files of one run) and `time_span` (typed times), `recovery` (files that
were cut off), `file_replay`, and `export` with `atomic_output`.
"""

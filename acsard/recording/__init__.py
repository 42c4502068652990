"""The black box: records the inputs and the outputs of every control step, and replays them.

These modules are pure, so they do no I/O:
- `recorded_steps`: one step as a recording stores it.
- `rows`: encodes and decodes batches of steps, and refuses values that no daemon records.
- `replay`: runs recorded inputs through `Robot.step` again and compares the outputs.
- `replay_text`: describes the result of a replay in lines of text.
- `state`: encodes a `Robot` as bytes, decodes it, and applies another configuration to it.
- `unpickling`: rebuilds a `Robot` from bytes that may be forged.
- `timeline`: describes a recording in sentences.
- `retention`: decides which recordings are deleted and which are retained.
- `published`: rebuilds the messages that the robot published.

These modules do I/O:
- `recorder`: queues the steps of the control loop. `step_writer` writes them in a thread.
- `directory`: manages the directory of recordings, and limits its size and the age of its files.
- `file`: writes and reads one MCAP file. `mcap_records` and `end_record` are parts of this code.
- `series`: finds the recordings of a range of time, and joins the files of one run of the daemon.
- `time_span`: parses the times that a person types, and finds them in a recording.
- `recovery`: finishes a file that was cut off.
- `file_replay`: replays a file, and compares the two copies of each event in the file.
- `export`: writes files for other programs. `atomic_output` gives a file its final name when the
  file is complete.
"""

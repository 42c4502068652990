"""The black box: records the inputs and the outputs of every control step, and replays them.

The pure modules:
- `steps`: one step as a recording stores it.
- `rows`: the encoding of many steps; it refuses values that no daemon records.
- `replay`: runs recorded inputs through `Robot.step` again and compares the outputs.
- `merge`: applies another configuration to a recorded robot state.
- `unpickling`: rebuilds a robot from bytes that a stranger may have written.
- `story`: describes a recording in sentences.
- `room`: decides which recordings are deleted and which are retained.
- `published`: rebuilds the messages that were published.
- `table`: writes the lines of a CSV file.
- `bag`: writes the `metadata.yaml` of a ROS bag.

The modules that do I/O:
- `recorder`: takes steps from the control loop; `disk` writes them in a thread.
- `directory`: bounds the directory of recordings.
- `file`, `chunks`, `walk`, `closing`: write and read one MCAP file, its chunks and its end.
- `recovery`: finishes a file that was cut off.
- `state`: encodes a robot as bytes, and decodes it.
- `replayed`: replays a file and describes the result.
- `export`: writes files for other programs; `beside` puts each in its place atomically.
"""

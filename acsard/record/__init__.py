"""Shell, with a pure core: the black box. What came into every step and what went out of it.

`steps` is what a recording says of a step, `batch` and `columns` make bytes of many, `earlier`
reads those of before, `replay` lives it again, `merge` puts another configuration under a state,
`story` tells it in sentences, `published` has the messages that went out, `table` the lines of a
CSV file, `bag` what stands beside a file for ROS: all pure. `state` makes bytes of a robot, `file`
reads and writes MCAP, `again` lives one again, `export` writes it for other programs, `ring` bounds
a directory, `recorder` has the thread.
"""

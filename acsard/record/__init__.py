"""Shell, with a pure core: the black box. What came into every step and what went out of it.

`steps` is what a recording says of a step, `batch` and `columns` make bytes of many, `earlier`
reads those of before, `plausible` refuses what no step got, `replay` lives it again, `merge` puts
another configuration under a state, `unpickling` makes a robot of bytes, whoever wrote them,
`story` tells it in sentences, `room` says which of them go, `published` has the messages that went
out, `table` the lines of a CSV file, `bag` what stands beside a file for ROS: all pure. `state`
makes bytes of a robot, `file` reads and writes MCAP, `closing` its end, `recovery` makes whole what
was cut, `replayed` lives one again, `export` writes it for other programs, `directory` bounds all
of them, `recorder` has the thread.
"""
